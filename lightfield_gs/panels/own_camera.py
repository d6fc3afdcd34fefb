"""The camera that a file of Gaussians brings along: a framing that this program stored, or the photo it was made from.

A stored framing is a line of the header, "lightfield-gs rig: {"rig": {...}, "width_px": ..., "height_px": ...}", in the
file's own axes, with the size of the panel that it was made for. SHARP (Mescheder et al., 2025) writes elements of
numbers beside the vertices: extrinsic (16, world to camera, by rows), intrinsic (9, by rows), image_size (2).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from lightfield_gs.base.checks import real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_files import FileCamera
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

_KEY = "lightfield-gs rig:"
_PHOTO = {"extrinsic": 16, "intrinsic": 9, "image_size": 2}  # elements of SHARP, and how many numbers each has

_WAY_OUT = "give --up, --camera or --rig, which go before it"


def framing_comment(rig: Rig, panel: Panel) -> str:
    """The line of a header that keeps the framing; rig: in the file's coordinates."""
    return f"{_KEY} " + json.dumps({"rig": rig.to_dict(), "width_px": panel.width_px, "height_px": panel.height_px})


def stored_framing(comments: Iterable[str], panel: Panel) -> tuple[Rig, str] | None:
    """The framing that the header keeps, fitted to the panel, and what to say of it; None where there is none.

    Raises InputError where it cannot be read.
    """
    if (stored := _stored(comments)) is None:
        return None
    rig, (width, height) = stored
    if (width, height) == (panel.width_px, panel.height_px):
        return rig, "the framing stored in the file"
    camera = FileCamera("", rig.world_to_camera, rig.focal_px, rig.principal_point_px, width, height)
    focal, centre = camera.fitted(panel.width_px, panel.height_px)
    return (
        replace(rig, focal_px=focal, principal_point_px=centre),
        f"the framing stored in the file, made for {width} x {height}",
    )


def stored_size(comments: Iterable[str]) -> tuple[int, int] | None:
    """Width and height of the panel that a stored framing was made for; None where there is none. Raises InputError."""
    stored = _stored(comments)
    return None if stored is None else stored[1]


def _stored(comments: Iterable[str]) -> tuple[Rig, tuple[int, int]] | None:
    lines = [comment.strip() for comment in comments if comment.strip().startswith(_KEY)]
    if not lines:
        return None
    try:
        data = parse_json(lines[-1][len(_KEY) :])
        width, height = (whole_number(f"{_KEY} {name}", data[name], 1, 1 << 20) for name in ("width_px", "height_px"))
        return Rig(**data["rig"]), (width, height)
    except (InputError, ValueError, TypeError, KeyError) as error:
        raise InputError(f"its stored framing is none ({' '.join(str(error).split())[:100]}); {_WAY_OUT}") from None


def photo_camera(elements: Mapping[str, np.ndarray]) -> FileCamera | None:
    """The camera of the photo that the Gaussians were made from; None where the file has none.

    Raises InputError where it is no pinhole camera.
    """
    if not all(name in elements for name in _PHOTO):
        return None
    numbers = {}
    for name, count in _PHOTO.items():
        array = elements[name]
        numbers[name] = np.concatenate([np.ravel(array[field]) for field in array.dtype.names or ()] or [np.empty(0)])
        if len(numbers[name]) != count or not np.isfinite(numbers[name].astype(np.float64)).all():
            raise InputError(
                f"its element {name} is none of a camera: expected {count} finite numbers, got "
                f"{len(numbers[name])}; {_WAY_OUT}"
            )
    pose, k = (
        numbers[name].astype(np.float64).reshape(size, size) for name, size in (("extrinsic", 4), ("intrinsic", 3))
    )
    try:
        width, height = (real_number("image_size", float(side), 1, 1 << 20) for side in numbers["image_size"])
        rig = Rig(pose, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), 1.0)
    except InputError as error:
        raise InputError(
            f"its elements extrinsic, intrinsic and image_size are no camera ({error}); {_WAY_OUT}"
        ) from None
    return FileCamera("", rig.world_to_camera, rig.focal_px, rig.principal_point_px, width, height)
