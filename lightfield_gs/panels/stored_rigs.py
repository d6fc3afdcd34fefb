"""Rigs in files: beside a scene, in its header, or as the camera of the photo that it was made from.

A stored framing is a line in the header of a file of Gaussians:
"lightfield-gs rig: {"rig": {...}, "width_px": ..., "height_px": ...}". The rig is in the file's own axes; the size is
the panel's. Formats without a header have both in a file beside them: scene.rig.yaml for scene.spz. SHARP (Mescheder et
al., 2025) writes elements of numbers beside the vertices: extrinsic (16, world to camera, by rows), intrinsic (9, by
rows), image_size (2).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import is_row, real_number, shown, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.captures.camera_files import FileCamera
from lightfield_gs.io.scenes.files import keeps_comments
from lightfield_gs.io.text_files import parse_json, read_mapping, write_mapping
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import RIG_KEYS, RIG_OPTIONAL, SCENE_KEYS, SIZE_KEY, Rig, checked_size

_KEY = "lightfield-gs rig:"
_PHOTO = {"extrinsic": 16, "intrinsic": 9, "image_size": 2}  # elements of SHARP, and their numbers of values
_WAY_OUT = "give up=, camera= or rig=, which go before it"


# Files of rigs


@dataclass(frozen=True)
class RigFile:
    """A rig in a file, and what the file says beside it.

    Attributes:
        rig: As stored.
        size_px: Width and height of the panel that it is for; None where the file does not say.
        background: Red, green and blue, 0..1, behind the scene beside it; None: not said.
        antialiased: Whether this scene was drawn so; None: not said.
    """

    rig: Rig
    size_px: tuple[int, int] | None = None
    background: tuple[float, float, float] | None = None
    antialiased: bool | None = None


def rig_path(scene: Path) -> Path:
    """Return the path of a scene's rig: scene.rig.yaml for scene.ply."""
    return scene.with_suffix(".rig.yaml")


def needs_rig_beside(scene: Path) -> bool:
    """Return whether the format of a scene has no place for its framing."""
    return not keeps_comments(scene)


def read_rig_file(path: Path) -> RigFile:
    """Read a file of a rig. Raises InputError."""
    data = read_mapping(path, RIG_KEYS, (*RIG_OPTIONAL, SIZE_KEY, *SCENE_KEYS))
    size, background, antialiased = (data.pop(key, None) for key in (SIZE_KEY, *SCENE_KEYS))
    with named(path):
        if antialiased is not None and not isinstance(antialiased, bool):
            raise InputError(f"antialiased: expected true or false, got {shown(antialiased)}")
        if background is not None:
            if not is_row(background, 3):
                raise InputError(f"background: expected red, green and blue, got {shown(background)}")
            red, green, blue = (real_number("background", part, 0.0, 1.0) for part in background)
            background = (red, green, blue)
        return RigFile(Rig(**data), None if size is None else checked_size(size), background, antialiased)


def write_rig_beside(
    scene: Path, rig: Rig, panel: Panel, background: Sequence[float] | None, antialiased: bool
) -> Path:
    """Write the framing of a scene, and how it was drawn, beside its file; return the path.

    Args:
        scene: Path of the scene.
        rig: Its rig, in the coordinates of the file.
        panel: The panel that the rig is for.
        background: Red, green and blue, 0..1; None: none of its own.
        antialiased: Whether it was drawn so.
    """
    path = rig_path(scene)
    drawn = {"background": None if background is None else list(background), "antialiased": antialiased}
    size = {SIZE_KEY: [panel.width_px, panel.height_px]}
    write_mapping(path, {**rig.to_dict(), **size, **{key: one for key, one in drawn.items() if one is not None}})
    return path


# Rigs in a file of Gaussians


def framing_comment(rig: Rig, panel: Panel) -> str:
    """Return the line of a header that stores a framing; rig: in the file's coordinates."""
    return f"{_KEY} " + json.dumps({"rig": rig.to_dict(), "width_px": panel.width_px, "height_px": panel.height_px})


def stored_framing(comments: Iterable[str]) -> tuple[Rig, tuple[int, int]] | None:
    """Return the framing in a header, and width and height of the panel that it is for; None without one.

    Raises:
        InputError: The framing cannot be read.
    """
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
    """Return the camera of the photo that the Gaussians were made from; None where the file has none.

    Raises:
        InputError: It is no pinhole camera.
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
