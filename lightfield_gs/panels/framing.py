"""A rig for a scene that comes without one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels import reach, subject, visible
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.extent import extent
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.axes import DEFAULT_UP, upright
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


def frame(
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
    turn = upright(up)
    if world_to_camera is not None:
        world_to_camera = Rig(world_to_camera, (1.0, 1.0), (0.0, 0.0), 1.0).world_to_camera  # checks the matrix
    found = _subject(gaussians)
    content, rest = _parted(gaussians, found)
    if world_to_camera is None:
        rig = _in_front(content, rest, panel, turn)
    else:
        whole = fit(extent(gaussians, _tensor(world_to_camera, gaussians)).tolist(), panel, world_to_camera)
        if found.left_out > _FEW and _is_narrow(whole, panel) or not _is_seen(content, world_to_camera):
            content, found = gaussians, subject.Subject()
        rig = _with_something_at_zero(_bounded(content, panel, world_to_camera), gaussians, panel)
    if notes is not None and found.why:
        notes.append(found.why)
    return rig


def frame_photo(gaussians: Gaussians, panel: Panel) -> Rig:
    """The rig of a photo, whose Gaussians are in the axes of its camera: the whole of what it shows, however wide.

    Raises InputError as `frame`.
    """
    return fit(photo_extent(_checked(gaussians, panel)).tolist(), panel, np.eye(4))


def photo_extent(gaussians: Gaussians) -> Tensor:
    """What `fit` needs to know of a photo's Gaussians, see `extent`; of a million an eighth shows it well enough."""
    return extent(reach.spread(gaussians))


def on_subject(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """The rig with its zero plane in the subject, what is nearest of what is seen in the middle of the picture; as it
    is where nothing is seen there."""
    found = visible.subject_depth(gaussians.detach(), panel, rig)
    return rig if found is None else replace(rig, zero_depth=found)


def look_from(
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
    if (found := visible.subject_depth(gaussians, panel, rig)) is not None:
        return replace(rig, zero_depth=found)
    near, far, weight = extent(gaussians, _tensor(rig.world_to_camera, gaussians)).tolist()[4:]
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
    low, high = reach.bounds_of(reach.some(gaussians)).unbind(1)
    return subject.find(
        gaussians.means, reach.sizes_of(gaussians), reach.weights_of(gaussians), float((high - low).max())
    )


def _parted(gaussians: Gaussians, found: subject.Subject) -> tuple[Gaussians, Gaussians | None]:
    """What is to be framed, and the rest of the scene."""
    if found.inside is None:
        return gaussians, None
    return reach.part(gaussians, found.inside), reach.part(gaussians, ~found.inside)


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
    rig = fit(extent(gaussians, _tensor(pose, gaussians)).tolist(), panel, pose)
    if _is_narrow(rig, panel):
        return rig
    widest = max(panel.width_px, panel.height_px) / 2 / _WIDEST_TAN
    kept = _within(gaussians, pose, panel.width_px / 2 / widest, panel.height_px / 2 / widest)
    if bool(kept.any()):
        seen = reach.part(gaussians, kept)
        numbers = extent(seen, _tensor(pose, seen)).tolist()
        if numbers[-1] > 0:
            rig = fit(numbers, panel, pose)
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
    found = visible.depth_beside_a_gap(gaussians, panel, rig)
    return rig if found is None else replace(rig, zero_depth=found)


def _tensor(pose: np.ndarray, like: Gaussians) -> Tensor:
    return torch.from_numpy(pose).to(like.means)


def fit(extent: Sequence[float], panel: Panel, world_to_camera: np.ndarray) -> Rig:
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
    before = reach.part(rest, rest.means @ depths < (content.means @ depths).max())
    few, chosen, best = reach.some(content), 1.0, -_WORTH
    for nearer in (1.0, *_NEARER):
        rig = _bounded(few, panel, _camera_in_front(few, panel, turn, nearer))
        seen = visible.share(content, before, panel, rig) * _share_in_frame(few, panel, rig)
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
    bounds = reach.bounds_of(gaussians, axes).cpu().double().numpy()
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
