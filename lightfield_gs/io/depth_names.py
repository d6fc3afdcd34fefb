"""Depth maps of photos and videos by their file names: 0001_depth.png of 0001.png."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePath

_DEPTH = re.compile(r"(?<![a-z])z?(depth[ _-]?map|depth|dmap|dpt|disparity|disp)(?![a-z])")
_SIDECAR = re.compile(  # other files that renderers and cameras write beside an image
    r"(?<![a-z])(depths|masks?|matte|alpha|normals?|segmentation|seg|confidence|conf|flow|albedo|mist|objectids?"
    r"|thumb|thumbnail|preview)(?![a-z])"
)
_COLOUR = re.compile(r"(?<![a-z])(rgb|colou?r|image|img|photo)(?![a-z])")
_NUMBERS = (".exr", ".npy", ".npz")  # more precise than an image of the same depths


def depth_maps_beside(names: Iterable[str]) -> dict[str, list[str]]:
    """Find the depth maps of photos among the names of a folder; the most precise map comes first.

    The stem of a map is the photo's stem and the word depth, disparity or the like: 0001_depth.png of 0001.png. The
    photo's stem may contain a word for colour: depth_0001.png of rgb_0001.png.
    """
    names = list(names)
    maps: dict[str, list[str]] = {}
    for name in sorted(names, key=lambda name: (PurePath(name).suffix.lower() not in _NUMBERS, name)):
        stem = _stem(name)
        if (key := _without(_DEPTH, stem)) != _without(None, stem):
            maps.setdefault(key, []).append(name)
    found = {}
    for name in names if maps else ():
        stem = _stem(name)
        if _DEPTH.search(stem):
            continue
        beside = maps.get(_without(None, stem)) or maps.get(_without(_COLOUR, stem))
        if beside:
            found[name] = beside
    return found


def is_sidecar_name(name: str) -> bool:
    """Return whether a name belongs to a file beside an image: a depth map, a mask, a thumbnail or the like."""
    stem = _stem(name)
    return bool(_DEPTH.search(stem) or _SIDECAR.search(stem))


def _stem(name: str) -> str:
    return PurePath(name).stem.lower()


def _without(word: re.Pattern[str] | None, stem: str) -> str:
    """Remove a word and the separators around it from a stem."""
    parts = re.split(r"[^a-z0-9]+", stem if word is None else word.sub("_", stem))
    return "_".join(part for part in parts if part)
