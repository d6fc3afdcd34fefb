"""Which files are depth maps by their names, and of which photo or video: 0001_depth.png of 0001.png."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePath

_DEPTH = re.compile(r"(?<![a-z])z?(depth[ _-]?map|depth|dmap|dpt|disparity|disp)(?![a-z])")
_BESIDE = re.compile(  # what else renderers and cameras write beside a picture
    r"(?<![a-z])(depths|masks?|matte|alpha|normals?|segmentation|seg|confidence|conf|flow|albedo|mist|objectids?"
    r"|thumb|thumbnail|preview)(?![a-z])"
)
_COLOUR = re.compile(r"(?<![a-z])(rgb|colou?r|image|img|photo)(?![a-z])")
_NUMBERS = (".exr", ".npy", ".npz")  # which hold depths more exactly than the picture that may be beside them


def depth_maps_beside(names: Iterable[str]) -> dict[str, list[str]]:
    """The depth maps of photos, by their names, all in one folder; the best comes first.

    A map is what becomes the name of another file without its ending once the word depth is taken out, or disparity
    and the like: 0001_depth.png of 0001.png, depth_0001.png of rgb_0001.png.
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


def is_named_as_beside(name: str) -> bool:
    """Whether a file is named as what lies beside a picture: a depth map, a mask, a thumbnail and the like."""
    stem = _stem(name)
    return bool(_DEPTH.search(stem) or _BESIDE.search(stem))


def _stem(name: str) -> str:
    return PurePath(name).stem.lower()


def _without(word: re.Pattern[str] | None, stem: str) -> str:
    """The stem without a word, and without what stood between it and the rest."""
    parts = re.split(r"[^a-z0-9]+", stem if word is None else word.sub("_", stem))
    return "_".join(part for part in parts if part)
