"""Rigs of photos, of given cameras, and of the camera that a file of Gaussians brings along.

A stored framing is a line of the header: "lightfield-gs rig: {"rig": {...}, "width_px": ..., "height_px": ...}". The
rig is in the file's own axes; the size is the panel's. SHARP (Mescheder et al., 2025) writes elements of numbers beside
the vertices: extrinsic (16, world to camera, by rows), intrinsic (9, by rows), image_size (2).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from torch import Tensor

from lightfield_gs.base.checks import real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_files import FileCamera
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels import visibility
from lightfield_gs.panels.extent import content_extent, hashed_subsample
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.scene_framing import checked_scene, fit_rig, middle_depth, pose_tensor
from lightfield_gs.scene.gaussians import Gaussians

_KEY = "lightfield-gs rig:"
_PHOTO = {"extrinsic": 16, "intrinsic": 9, "image_size": 2}  # elements of SHARP, and their numbers of values

_WAY_OUT = "give up=, camera= or rig=, which go before it"


def frame_photo(gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig of a photo's Gaussians, which are in the axes of its camera: it shows all of them, however wide.

    Raises:
        InputError: As in Rig.frame.
    """
    return frame_extent(photo_extent(checked_scene(gaussians, panel)).tolist(), panel)


def frame_extent(extent: Sequence[float], panel: Panel) -> Rig:
    """Return the rig that shows the content of a photo_extent; raise InputError if it has no weight."""
    return Rig(**vars(fit_rig(extent, panel, np.eye(4))))


def photo_extent(gaussians: Gaussians) -> Tensor:
    """Return the content_extent of a photo's Gaussians for frame_extent; of a million an eighth is enough."""
    return content_extent(hashed_subsample(gaussians))


def focus_on_subject(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig with its zero plane at the nearest subject in the middle; unchanged where nothing is there."""
    found = visibility.subject_depth(gaussians.detach(), panel, rig)
    return rig if found is None else replace(rig, zero_depth=found)


def frame_from_camera(
    gaussians: Gaussians,
    panel: Panel,
    world_to_camera: np.ndarray,
    focal_px: tuple[float, float],
    principal_point_px: tuple[float, float],
) -> Rig:
    """Return a rig of this centre camera, at the panel's resolution, with its zero plane in the subject.

    Args:
        gaussians: One set.
        panel: The panel.
        world_to_camera: [4, 4].
        focal_px: (fx, fy), pixels of the panel.
        principal_point_px: (cx, cy), pixels of the panel.

    Raises:
        InputError: An argument is invalid, or no Gaussian lies in front of the camera.
    """
    gaussians = checked_scene(gaussians, panel)
    rig = Rig(world_to_camera, focal_px, principal_point_px, 1.0)
    if (found := visibility.subject_depth(gaussians, panel, rig)) is not None:
        return replace(rig, zero_depth=found)
    extent = content_extent(gaussians, pose_tensor(rig.world_to_camera, gaussians))
    return replace(rig, zero_depth=middle_depth(extent.tolist()))


def framing_comment(rig: Rig, panel: Panel) -> str:
    """Return the line of a header that stores a framing; rig: in the file's coordinates."""
    return f"{_KEY} " + json.dumps({"rig": rig.to_dict(), "width_px": panel.width_px, "height_px": panel.height_px})


def stored_framing(comments: Iterable[str], panel: Panel) -> tuple[Rig, str] | None:
    """Return the framing in a header, fitted to the panel, and a description of it; None without one.

    Raises:
        InputError: The framing cannot be read.
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
    """Return width and height of the panel of a stored framing; None without one.

    Raises:
        InputError: The framing cannot be read.
    """
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
