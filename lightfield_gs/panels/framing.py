"""Rigs for scenes: automatic framing, and the camera that a file of Gaussians brings along.

A stored framing is a line of the header, "lightfield-gs rig: {"rig": {...}, "width_px": ..., "height_px": ...}", in the
file's own axes, with the size of the panel that it was made for. SHARP (Mescheder et al., 2025) writes elements of
numbers beside the vertices: extrinsic (16, world to camera, by rows), intrinsic (9, by rows), image_size (2).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

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

_FILL = 0.92  # share of the panel's height or width that the content fills
_NEAR = _core.NEAR_DEPTH
_FIELD_OF_VIEW_DEG = (20.0, 50.0)  # the angle that the panel subtends for its viewer is kept within these
_UNKNOWN_FIELD_OF_VIEW_DEG = 30.0  # of a panel whose size or viewing distance is not known
_WIDEST_RAD = math.radians(90)  # the widest angle of the panel where no focal length was given
_WIDEST_TAN = math.tan(_WIDEST_RAD / 2)
# If the camera sees less than _SEEN of the content past the rest of the scene, it goes nearer, to these shares of its
# usual distance, as long as that shows _WORTH more of the content.
_SEEN, _WORTH = 0.7, 0.1
_NEARER = (0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.12, 0.06)
# Up to this share of the scene what lies outside its subject is floaters, which are left out even if a given camera
# could show them.
_FEW = 0.1
_NOTHING_IN_FRONT = "no Gaussian lies in front of the camera; give another rig"


def frame_scene(
    gaussians: Gaussians,
    panel: Panel,
    world_to_camera: np.ndarray | None = None,
    *,
    up: str = DEFAULT_UP,
    notes: list[str] | None = None,
) -> Rig:
    """A rig that shows the whole scene on the panel, or what it is about, where it surrounds that or floats far off.

    Content is what the visible Gaussians cover, but for the outermost 0.01 % of their opacity on each side, and for up
    to 0.1 % or 1 % where that lies far out. It is centred and fills 92 % of the panel's height, or of the width where
    that is met first; the panel takes 90 degrees at most. The zero plane is at the harmonic mean of near and far, the
    depths beyond which 5 % of the opacity lies.
    Where there is next to nothing for a while around the densest part of the scene, or the scene goes on on most sides
    of a small dense part, or a hull that is closed on all sides has something in it, that is the content
    (lightfield_gs.panels.subject).
    Without a camera, one looks at the content from in front, upright by `up`: the axis that points up, one of
    axes.UP_AXES, or three numbers. With -y, as in OpenCV axes, it looks along +z. It stands so far off that the
    content's height takes the angle that the panel subtends for its viewer (kept within 20..50 degrees; 30 when not
    known), or nearer, where something is in between. With a camera, and nothing to be seen near the harmonic mean, the
    zero plane is at the depth of what is seen in the middle.
    notes: a list to append to, a line for each thing that was assumed.
    Raises InputError on a batch, on no Gaussians, or when none lies in front of the camera.
    """
    gaussians = _checked(gaussians, panel)
    turn = upright_rotation(up)
    if world_to_camera is not None:
        world_to_camera = Rig(world_to_camera, (1.0, 1.0), (0.0, 0.0), 1.0).world_to_camera  # checks the matrix
    found = _subject(gaussians)
    content, rest = _parted(gaussians, found)
    if world_to_camera is None:
        rig = _in_front(content, rest, panel, turn)
    else:
        whole = fit_rig(content_extent(gaussians, _tensor(world_to_camera, gaussians)).tolist(), panel, world_to_camera)
        if found.left_out > _FEW and _is_narrow(whole, panel) or not _is_seen(content, world_to_camera):
            content, found = gaussians, subject.Subject()
        rig = _with_something_at_zero(_bounded(content, panel, world_to_camera), gaussians, panel)
    if notes is not None and found.reason:
        notes.append(found.reason)
    return rig


def frame_photo(gaussians: Gaussians, panel: Panel) -> Rig:
    """The rig of a photo, whose Gaussians are in the axes of its camera: the whole of what it shows, however wide.

    Raises InputError as `frame`.
    """
    return fit_rig(photo_extent(_checked(gaussians, panel)).tolist(), panel, np.eye(4))


def photo_extent(gaussians: Gaussians) -> Tensor:
    """What `fit` needs to know of a photo's Gaussians, see `extent`; of a million an eighth shows it well enough."""
    return content_extent(hashed_subsample(gaussians))


def focus_on_subject(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """The rig with its zero plane in the subject, what is nearest of what is seen in the middle of the picture; as it
    is where nothing is seen there."""
    found = visibility.subject_depth(gaussians.detach(), panel, rig)
    return rig if found is None else replace(rig, zero_depth=found)


def frame_from_camera(
    gaussians: Gaussians,
    panel: Panel,
    world_to_camera: np.ndarray,
    focal_px: tuple[float, float],
    principal_point_px: tuple[float, float],
) -> Rig:
    """A rig of this centre camera, at the panel's resolution; its zero plane is in the subject: what is nearest of what
    is seen in the middle of the picture. Raises InputError, also where no Gaussian lies in front of the camera."""
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
    """What the scene is about, by panels/subject.py."""
    low, high = content_bounds(subsample(gaussians)).unbind(1)
    return subject.find_subject(
        gaussians.means, middle_scales(gaussians), content_weights(gaussians), float((high - low).max())
    )


def _parted(gaussians: Gaussians, found: subject.Subject) -> tuple[Gaussians, Gaussians | None]:
    """What is to be framed, and the rest of the scene."""
    if found.inside is None:
        return gaussians, None
    return select(gaussians, found.inside), select(gaussians, ~found.inside)


def _is_seen(gaussians: Gaussians, pose: np.ndarray) -> bool:
    """Whether any lies in a view of 90 degrees."""
    return bool(_within(gaussians, pose, _WIDEST_TAN, _WIDEST_TAN).any())


def _within(gaussians: Gaussians, pose: np.ndarray, tan_x: float, tan_y: float) -> Tensor:
    """Which Gaussians lie in front of a camera and within these slopes x/z and y/z to either side, bool [N]."""
    matrix = _tensor(pose, gaussians)
    x, y, z = (gaussians.means @ matrix[:3, :3].T + matrix[:3, 3]).unbind(1)
    return (z > _NEAR) & (x.abs() <= tan_x * z) & (y.abs() <= tan_y * z)


def _bounded(gaussians: Gaussians, panel: Panel, pose: np.ndarray) -> Rig:
    """The rig that fits the content, the panel's longer side taking 90 degrees at most: what is beyond is left out."""
    rig = fit_rig(content_extent(gaussians, _tensor(pose, gaussians)).tolist(), panel, pose)
    if _is_narrow(rig, panel):
        return rig
    widest = max(panel.width_px, panel.height_px) / 2 / _WIDEST_TAN
    kept = _within(gaussians, pose, panel.width_px / 2 / widest, panel.height_px / 2 / widest)
    if bool(kept.any()):
        seen = select(gaussians, kept)
        numbers = content_extent(seen, _tensor(pose, seen)).tolist()
        if numbers[-1] > 0:
            rig = fit_rig(numbers, panel, pose)
    if _is_narrow(rig, panel):
        return rig
    return replace(rig, focal_px=(widest, widest), principal_point_px=(panel.width_px / 2, panel.height_px / 2))


def _is_narrow(rig: Rig, panel: Panel) -> bool:
    """Whether the panel takes 90 degrees at most."""
    return all(
        math.atan(centre / focal) + math.atan((size - centre) / focal) <= _WIDEST_RAD
        for centre, focal, size in zip(rig.principal_point_px, rig.focal_px, (panel.width_px, panel.height_px))
    )


def _with_something_at_zero(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """The rig, its zero plane moved to the subject if it lies in a wide gap between near and far."""
    found = visibility.depth_beside_a_gap(gaussians, panel, rig)
    return rig if found is None else replace(rig, zero_depth=found)


def _tensor(pose: np.ndarray, like: Gaussians) -> Tensor:
    return torch.from_numpy(pose).to(like.means)


def fit_rig(extent: Sequence[float], panel: Panel, world_to_camera: np.ndarray) -> Rig:
    """The rig at this camera that shows the content of this `extent`. Raises InputError when there is none."""
    left, right, top, bottom, near, far, weight = extent
    if not weight > 0:
        raise InputError(_NOTHING_IN_FRONT)
    focal = _FILL * min(panel.height_px / max(bottom - top, 1e-9), panel.width_px / max(right - left, 1e-9))
    centre = panel.width_px / 2 - focal * (left + right) / 2, panel.height_px / 2 - focal * (top + bottom) / 2
    return Rig(world_to_camera, (focal, focal), centre, 2 / (1 / near + 1 / far))


def _in_front(content: Gaussians, rest: Gaussians | None, panel: Panel, turn: np.ndarray) -> Rig:
    """The rig of a camera with this rotation [3, 3] (world to camera) before the content, where it sees most of it."""
    chosen = 1.0 if rest is None else _clear_distance(content, rest, panel, turn)
    return _bounded(content, panel, _camera_in_front(content, panel, turn, chosen))


def _clear_distance(content: Gaussians, rest: Gaussians, panel: Panel, turn: np.ndarray) -> float:
    """The share of its usual distance from where the camera sees enough of the content past the rest of the scene."""
    depths = torch.from_numpy(turn[2]).to(content.means)
    before = select(rest, rest.means @ depths < (content.means @ depths).max())
    few, chosen, best = subsample(content), 1.0, -_WORTH
    for nearer in (1.0, *_NEARER):
        rig = _bounded(few, panel, _camera_in_front(few, panel, turn, nearer))
        seen = visibility.visible_fraction(content, before, panel, rig) * _share_in_frame(few, panel, rig)
        if seen > best + _WORTH:
            chosen, best = nearer, seen
        if best >= _SEEN:
            break
    return chosen


def _share_in_frame(gaussians: Gaussians, panel: Panel, rig: Rig) -> float:
    """How many of the Gaussians have their centres on the panel, 0..1."""
    matrix = _tensor(rig.world_to_camera, gaussians)
    x, y, z = (gaussians.means @ matrix[:3, :3].T + matrix[:3, 3]).unbind(1)
    inside = z > _NEAR
    for slope, focal, centre, size in zip(
        (x / z, y / z), rig.focal_px, rig.principal_point_px, (panel.width_px, panel.height_px)
    ):
        inside &= (focal * slope + centre >= 0) & (focal * slope + centre <= size)
    return float(inside.double().mean())


def _camera_in_front(gaussians: Gaussians, panel: Panel, turn: np.ndarray, share: float) -> np.ndarray:
    """The pose of a camera with this rotation, at this share of its usual distance from the front of the content."""
    axes = torch.from_numpy(turn).to(gaussians.means)
    bounds = content_bounds(gaussians, axes).cpu().double().numpy()
    width, height, depth = bounds[:, 1] - bounds[:, 0]
    height = max(height, width * panel.height_px / panel.width_px, 1e-6)
    distance = share * height / _FILL / 2 / math.tan(_field_of_view_rad(panel) / 2)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    # The front of the content, not its middle, must fit, and it must stay clear of the near plane.
    matrix[:3, 3] = -bounds.mean(1) + [0, 0, depth / 2 + max(distance, 2 * _NEAR)]
    return matrix


def _field_of_view_rad(panel: Panel) -> float:
    """The angle that the panel's height takes for its viewer, kept within what makes a good picture."""
    if panel.pixel_pitch_mm is None or panel.viewing_distance_mm is None:
        return math.radians(_UNKNOWN_FIELD_OF_VIEW_DEG)
    angle = 2 * math.atan(panel.height_px * panel.pixel_pitch_mm / 2 / panel.viewing_distance_mm)
    return min(max(angle, math.radians(_FIELD_OF_VIEW_DEG[0])), math.radians(_FIELD_OF_VIEW_DEG[1]))


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
