"""Rigs for scenes: automatic framing, and the camera that a file of Gaussians brings along.

A stored framing is a line of the header, "lightfield-gs rig: {"rig": {...}, "width_px": ..., "height_px": ...}", in the
file's own axes, with the size of the panel that it was made for. SHARP (Mescheder et al., 2025) writes elements of
numbers beside the vertices: extrinsic (16, world to camera, by rows), intrinsic (9, by rows), image_size (2).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_files import FileCamera
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels import subject, visibility
from lightfield_gs.panels.extent import (
    content_bounds,
    content_extent,
    content_weights,
    hashed_subsample,
    middle_scales,
    select,
    subsample,
)
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.axes import DEFAULT_UP, upright_rotation
from lightfield_gs.scene.gaussians import Gaussians


@dataclass(frozen=True)
class FramingConstants:
    """Proportions and thresholds of automatic framing.

    All are chosen by hand and not tuned on a data set; tests/panels/test_rig.py and test_subject.py have the scenes
    that they must frame.
    """

    fill: float = 0.92  # fraction of the panel's height or width that the content fills
    field_of_view_deg: tuple[float, float] = (20.0, 50.0)  # limits of the angle that the panel subtends for its viewer
    unknown_field_of_view_deg: float = 30.0  # angle of a panel without a size or a viewing distance
    visible: float = 0.7  # visible fraction of the content that is enough
    worth: float = 0.1  # gain of the visible fraction for which the camera goes nearer
    # factors of the usual distance that it tries
    nearer: tuple[float, float, float, float, float, float, float, float, float] = (
        0.85,
        0.7,
        0.6,
        0.5,
        0.4,
        0.3,
        0.2,
        0.12,
        0.06,
    )
    # fraction of the scene up to which the rest counts as floaters, which are left out even if a given camera could
    # show them
    few: float = 0.1


_CONSTANTS = FramingConstants()

_NEAR = _core.NEAR_DEPTH
_WIDEST_RAD = math.radians(90)  # the widest angle of the panel where no focal length was given
_WIDEST_TAN = math.tan(_WIDEST_RAD / 2)
_NOTHING_IN_FRONT = "no Gaussian lies in front of the camera; give another rig"


def frame_scene(
    gaussians: Gaussians,
    panel: Panel,
    world_to_camera: np.ndarray | None = None,
    *,
    up: str = DEFAULT_UP,
    notes: list[str] | None = None,
) -> Rig:
    """Return a rig that shows a scene on the panel: the whole scene, or its subject.

    Content is the area that the visible Gaussians cover, without the outermost 0.01 % of their opacity on each side,
    and without up to 0.1 % or 1 % where that lies far out. It is centred and fills 92 % of the panel's height, or of
    its width where that is met first; the panel takes 90 degrees at most. The zero plane is at the harmonic mean of
    near and far, the depths beyond which 5 % of the opacity lies.

    The content is only the subject (lightfield_gs.panels.subject) in three cases: a gap surrounds the densest part of
    the scene; the scene surrounds a small dense part; or a hull that is closed on all sides has something in it.

    A new camera looks at the content from in front. The content's height takes the angle that the panel subtends for
    its viewer, kept within 20..50 degrees, or 30 when unknown; the camera goes nearer where something is in between.
    With a given camera and nothing visible near the harmonic mean, the zero plane is at the depth in the middle of the
    picture.

    Args:
        gaussians: One set.
        panel: The panel.
        world_to_camera: [4, 4], the camera's pose; None: a new camera.
        up: The axis that points up for a new camera, one of axes.UP_AXES, or three numbers. With -y, as in OpenCV axes,
            the camera looks along +z.
        notes: A list to append a line to for each assumption.

    Raises:
        InputError: `gaussians` is a batch or empty, or none lies in front of the camera.
    """
    gaussians = _checked(gaussians, panel)
    turn = upright_rotation(up)
    if world_to_camera is not None:
        world_to_camera = Rig(world_to_camera, (1.0, 1.0), (0.0, 0.0), 1.0).world_to_camera  # checks the matrix
    found = _subject(gaussians)
    content, rest = _split(gaussians, found)
    if world_to_camera is None:
        rig = _in_front(content, rest, panel, turn)
    else:
        whole = fit_rig(content_extent(gaussians, _tensor(world_to_camera, gaussians)).tolist(), panel, world_to_camera)
        if found.left_out > _CONSTANTS.few and _is_narrow(whole, panel) or not _is_in_front(content, world_to_camera):
            content, found = gaussians, subject.Subject()
        rig = _with_something_at_zero(_bounded(content, panel, world_to_camera), gaussians, panel)
    if notes is not None and found.reason:
        notes.append(found.reason)
    return rig


def frame_photo(gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig of a photo's Gaussians, which are in the axes of its camera: it shows all of them, however wide.

    Raises:
        InputError: As in frame_scene.
    """
    return fit_rig(photo_extent(_checked(gaussians, panel)).tolist(), panel, np.eye(4))


def photo_extent(gaussians: Gaussians) -> Tensor:
    """Return the content_extent of a photo's Gaussians for `fit_rig`; of a million an eighth is enough."""
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
    gaussians = _checked(gaussians, panel)
    rig = Rig(world_to_camera, focal_px, principal_point_px, 1.0)
    if (found := visibility.subject_depth(gaussians, panel, rig)) is not None:
        return replace(rig, zero_depth=found)
    near, far, weight = content_extent(gaussians, _tensor(rig.world_to_camera, gaussians)).tolist()[4:]
    if not weight > 0:
        raise InputError(_NOTHING_IN_FRONT)
    return replace(rig, zero_depth=2 / (1 / near + 1 / far))


def _checked(gaussians: Gaussians, panel: Panel) -> Gaussians:
    expect("gaussians", gaussians, Gaussians)
    expect("panel", panel, Panel)
    gaussians.validate()
    if gaussians.is_batched:
        raise InputError(f"framing takes one set of Gaussians, got a batch of {gaussians.means.shape[0]}; frame one")
    if gaussians.count == 0:
        raise InputError("there are no Gaussians to frame")
    return gaussians.detach()


def _subject(gaussians: Gaussians) -> subject.Subject:
    """Return the subject of a scene, see panels/subject.py."""
    low, high = content_bounds(subsample(gaussians)).unbind(1)
    return subject.find_subject(
        gaussians.means, middle_scales(gaussians), content_weights(gaussians), float((high - low).max())
    )


def _split(gaussians: Gaussians, found: subject.Subject) -> tuple[Gaussians, Gaussians | None]:
    """Return the Gaussians to frame, and the rest of the scene."""
    if found.inside is None:
        return gaussians, None
    return select(gaussians, found.inside), select(gaussians, ~found.inside)


def _is_in_front(gaussians: Gaussians, pose: np.ndarray) -> bool:
    """Return whether any Gaussian lies in a view of 90 degrees."""
    return bool(_in_view(gaussians, pose, _WIDEST_TAN, _WIDEST_TAN).any())


def _in_view(gaussians: Gaussians, pose: np.ndarray, tan_x: float, tan_y: float) -> Tensor:
    """Return which Gaussians lie in front of a camera, within slopes tan_x of x/z and tan_y of y/z: bool [N]."""
    matrix = _tensor(pose, gaussians)
    x, y, z = (gaussians.means @ matrix[:3, :3].T + matrix[:3, 3]).unbind(1)
    return (z > _NEAR) & (x.abs() <= tan_x * z) & (y.abs() <= tan_y * z)


def _bounded(gaussians: Gaussians, panel: Panel, pose: np.ndarray) -> Rig:
    """Return the rig that fits the content within 90 degrees of the longer side; the rest is left out."""
    rig = fit_rig(content_extent(gaussians, _tensor(pose, gaussians)).tolist(), panel, pose)
    if _is_narrow(rig, panel):
        return rig
    widest = max(panel.width_px, panel.height_px) / 2 / _WIDEST_TAN
    kept = _in_view(gaussians, pose, panel.width_px / 2 / widest, panel.height_px / 2 / widest)
    if bool(kept.any()):
        visible = select(gaussians, kept)
        numbers = content_extent(visible, _tensor(pose, visible)).tolist()
        if numbers[-1] > 0:
            rig = fit_rig(numbers, panel, pose)
    if _is_narrow(rig, panel):
        return rig
    return replace(rig, focal_px=(widest, widest), principal_point_px=(panel.width_px / 2, panel.height_px / 2))


def _is_narrow(rig: Rig, panel: Panel) -> bool:
    """Return whether the panel takes 90 degrees at most."""
    return all(
        math.atan(centre / focal) + math.atan((size - centre) / focal) <= _WIDEST_RAD
        for centre, focal, size in zip(rig.principal_point_px, rig.focal_px, (panel.width_px, panel.height_px))
    )


def _with_something_at_zero(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig with its zero plane moved to the subject if it lies in a wide gap."""
    found = visibility.depth_beside_a_gap(gaussians, panel, rig)
    return rig if found is None else replace(rig, zero_depth=found)


def _tensor(pose: np.ndarray, like: Gaussians) -> Tensor:
    return torch.from_numpy(pose).to(like.means)


def fit_rig(extent: Sequence[float], panel: Panel, world_to_camera: np.ndarray) -> Rig:
    """Return the rig of a camera that shows the content of this extent.

    Args:
        extent: As content_extent returns it.
        panel: The panel.
        world_to_camera: [4, 4].

    Raises:
        InputError: The extent has no weight.
    """
    left, right, top, bottom, near, far, weight = extent
    if not weight > 0:
        raise InputError(_NOTHING_IN_FRONT)
    focal = _CONSTANTS.fill * min(panel.height_px / max(bottom - top, 1e-9), panel.width_px / max(right - left, 1e-9))
    centre = panel.width_px / 2 - focal * (left + right) / 2, panel.height_px / 2 - focal * (top + bottom) / 2
    return Rig(world_to_camera, (focal, focal), centre, 2 / (1 / near + 1 / far))


def _in_front(content: Gaussians, rest: Gaussians | None, panel: Panel, turn: np.ndarray) -> Rig:
    """Return the rig of a camera with rotation `turn` [3, 3] before the content, where most of it is visible."""
    chosen = 1.0 if rest is None else _clear_distance(content, rest, panel, turn)
    return _bounded(content, panel, _camera_in_front(content, panel, turn, chosen))


def _clear_distance(content: Gaussians, rest: Gaussians, panel: Panel, turn: np.ndarray) -> float:
    """Return the factor of the usual distance from which the camera sees enough of the content."""
    depths = torch.from_numpy(turn[2]).to(content.means)
    before = select(rest, rest.means @ depths < (content.means @ depths).max())
    few, chosen, best = subsample(content), 1.0, -_CONSTANTS.worth
    for nearer in (1.0, *_CONSTANTS.nearer):
        rig = _bounded(few, panel, _camera_in_front(few, panel, turn, nearer))
        visible = visibility.visible_fraction(content, before, panel, rig) * _fraction_in_frame(few, panel, rig)
        if visible > best + _CONSTANTS.worth:
            chosen, best = nearer, visible
        if best >= _CONSTANTS.visible:
            break
    return chosen


def _fraction_in_frame(gaussians: Gaussians, panel: Panel, rig: Rig) -> float:
    """Return the fraction 0..1 of the Gaussians with their centres on the panel."""
    matrix = _tensor(rig.world_to_camera, gaussians)
    x, y, z = (gaussians.means @ matrix[:3, :3].T + matrix[:3, 3]).unbind(1)
    inside = z > _NEAR
    for slope, focal, centre, size in zip(
        (x / z, y / z), rig.focal_px, rig.principal_point_px, (panel.width_px, panel.height_px)
    ):
        inside &= (focal * slope + centre >= 0) & (focal * slope + centre <= size)
    return float(inside.double().mean())


def _camera_in_front(gaussians: Gaussians, panel: Panel, turn: np.ndarray, factor: float) -> np.ndarray:
    """Return the pose of a camera with this rotation, at a factor of its usual distance from the content."""
    axes = torch.from_numpy(turn).to(gaussians.means)
    bounds = content_bounds(gaussians, axes).cpu().double().numpy()
    width, height, depth = bounds[:, 1] - bounds[:, 0]
    height = max(height, width * panel.height_px / panel.width_px, 1e-6)
    distance = factor * height / _CONSTANTS.fill / 2 / math.tan(_field_of_view_rad(panel) / 2)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    # The front of the content, not its middle, must fit, and it must stay clear of the near plane.
    matrix[:3, 3] = -bounds.mean(1) + [0, 0, depth / 2 + max(distance, 2 * _NEAR)]
    return matrix


def _field_of_view_rad(panel: Panel) -> float:
    """Return the angle that the panel's height takes for its viewer, within the limits of a good picture."""
    if panel.pixel_pitch_mm is None or panel.viewing_distance_mm is None:
        return math.radians(_CONSTANTS.unknown_field_of_view_deg)
    angle = 2 * math.atan(panel.height_px * panel.pixel_pitch_mm / 2 / panel.viewing_distance_mm)
    return min(max(angle, math.radians(_CONSTANTS.field_of_view_deg[0])), math.radians(_CONSTANTS.field_of_view_deg[1]))


_KEY = "lightfield-gs rig:"
_PHOTO = {"extrinsic": 16, "intrinsic": 9, "image_size": 2}  # elements of SHARP, and their numbers of values

_WAY_OUT = "give up=, camera= or rig=, which go before it"


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
