"""Automatic framing: the rig that shows a scene on a panel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels import visibility
from lightfield_gs.panels.content import Subject, content_bounds, content_extent, find_subject, select, subsample
from lightfield_gs.panels.panel import Panel
from lightfield_gs.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig


@dataclass(frozen=True)
class FramingConstants:
    """Proportions and thresholds of automatic framing.

    All are chosen by hand and not tuned on a data set; tests/panels/test_rig.py and test_subject.py have the scenes
    that they must frame.
    """

    fill: float = 0.92  # fraction of the panel's height or width that the content fills
    fill_all: float = 0.98  # fraction of the width that the content of a photo fills in all views together
    field_of_view_deg: tuple[float, float] = (20.0, 50.0)  # limits of the angle that the panel subtends for its viewer
    unknown_field_of_view_deg: float = 30.0  # angle of a panel without a size or a viewing distance
    visible: float = 0.7  # visible fraction of the content that is enough
    worth: float = 0.1  # gain of the visible fraction for which the camera goes nearer
    # factors of the usual distance that it tries
    nearer: tuple[float, ...] = (0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.12, 0.06)
    # fraction of the scene up to which the rest counts as floaters, which are left out even if a given camera could
    # show them
    few: float = 0.1


_CONSTANTS = FramingConstants()

_NEAR = _core.NEAR_DEPTH
_WIDEST_RAD = math.radians(90)  # the widest angle of the panel where no focal length was given
_WIDEST_TAN = math.tan(_WIDEST_RAD / 2)


def fit_scene(
    rig: Rig,
    gaussians: Gaussians,
    panel: Panel,
    world_to_camera: np.ndarray | None,
    turn: np.ndarray,
    notes: list[str] | None,
) -> Rig:
    """Return a rig fitted to a scene, as Rig.frame describes it.

    Args:
        rig: Whose cone the result keeps.
        gaussians: As in Rig.frame, and so are the others.
        panel: As in Rig.frame.
        world_to_camera: As in Rig.frame.
        turn: Rotation [3, 3] of a new camera.
        notes: As in Rig.frame.
    """
    gaussians = checked_scene(gaussians, panel)
    if world_to_camera is not None:
        rig = replace(rig, world_to_camera=world_to_camera)
    found = find_subject(gaussians)
    content, rest = _split(gaussians, found)
    if world_to_camera is None:
        rig = _in_front(rig, content, rest, panel, turn)
    else:
        whole = fit_rig(rig, content_extent(gaussians, pose_tensor(rig, gaussians)).tolist(), panel)
        if found.left_out > _CONSTANTS.few and _is_narrow(whole, panel) or not _is_in_front(content, rig):
            content, found = gaussians, Subject()
        rig = _with_something_at_zero(_bounded(rig, content, panel), gaussians, panel)
    if notes is not None and found.reason:
        notes.append(found.reason)
    return rig


def checked_scene(gaussians: Gaussians, panel: Panel) -> Gaussians:
    """Return the Gaussians of a scene without their graph; raise InputError unless it can be framed."""
    expect("gaussians", gaussians, Gaussians)
    expect("panel", panel, Panel)
    gaussians.validate()
    if gaussians.is_batched:
        raise InputError(f"framing takes one set of Gaussians, got a batch of {gaussians.means.shape[0]}; frame one")
    if gaussians.count == 0:
        raise InputError("there are no Gaussians to frame")
    return gaussians.detach()


def focus_on_subject(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig with its zero plane at the nearest subject in the middle of a photo's scene.

    It is unchanged where nothing is there.
    """
    found = visibility.subject_depth(gaussians.detach(), panel, rig, before_wall=True)
    return rig if found is None else replace(rig, zero_depth=found)


def focus_on_scene(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig with its zero plane in the subject, or where nothing is in the middle, amid the scene.

    Args:
        rig: A rig with the centre camera, at the panel's resolution.
        gaussians: One set.
        panel: The panel.

    Raises:
        InputError: An argument is invalid, or no Gaussian lies in front of the camera.
    """
    gaussians = checked_scene(gaussians, panel)
    if (found := visibility.subject_depth(gaussians, panel, rig)) is not None:
        return replace(rig, zero_depth=found)
    extent = content_extent(gaussians, pose_tensor(rig, gaussians))
    return replace(rig, zero_depth=middle_depth(extent.tolist()))


def _split(gaussians: Gaussians, found: Subject) -> tuple[Gaussians, Gaussians | None]:
    """Return the Gaussians to frame, and the rest of the scene."""
    if found.inside is None:
        return gaussians, None
    return select(gaussians, found.inside), select(gaussians, ~found.inside)


def _is_in_front(gaussians: Gaussians, rig: Rig) -> bool:
    """Return whether any Gaussian lies in a view of 90 degrees."""
    return bool(_in_view(gaussians, rig, _WIDEST_TAN, _WIDEST_TAN).any())


def _in_view(gaussians: Gaussians, rig: Rig, tan_x: float, tan_y: float) -> Tensor:
    """Return which Gaussians lie before the rig's camera, within slopes tan_x of x/z and tan_y of y/z: bool [N]."""
    matrix = pose_tensor(rig, gaussians)
    x, y, z = (gaussians.means @ matrix[:3, :3].T + matrix[:3, 3]).unbind(1)
    return (z > _NEAR) & (x.abs() <= tan_x * z) & (y.abs() <= tan_y * z)


def _bounded(rig: Rig, gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig fitted to the content within 90 degrees of the longer side; the rest is left out."""
    rig = fit_rig(rig, content_extent(gaussians, pose_tensor(rig, gaussians)).tolist(), panel)
    if _is_narrow(rig, panel):
        return rig
    widest = max(panel.width_px, panel.height_px) / 2 / _WIDEST_TAN
    kept = _in_view(gaussians, rig, panel.width_px / 2 / widest, panel.height_px / 2 / widest)
    if bool(kept.any()):
        visible = select(gaussians, kept)
        numbers = content_extent(visible, pose_tensor(rig, visible)).tolist()
        if numbers[-1] > 0:
            rig = fit_rig(rig, numbers, panel)
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


def pose_tensor(rig: Rig, like: Gaussians) -> Tensor:
    """Return the pose [4, 4] of the rig's camera in the type and on the device of the Gaussians."""
    return torch.from_numpy(rig.world_to_camera).to(like.means)


def fit_rig(rig: Rig, extent: Sequence[float], panel: Panel) -> Rig:
    """Return the rig with focal length, principal point and zero plane that show the content of this extent.

    Args:
        rig: A rig with the camera's pose.
        extent: As content_extent returns it.
        panel: The panel.

    Raises:
        InputError: The extent has no weight.
    """
    depth = middle_depth(extent)
    left, right, top, bottom = extent[:4]
    focal = _CONSTANTS.fill * min(panel.height_px / max(bottom - top, 1e-9), panel.width_px / max(right - left, 1e-9))
    centre = panel.width_px / 2 - focal * (left + right) / 2, panel.height_px / 2 - focal * (top + bottom) / 2
    return replace(rig, focal_px=(focal, focal), principal_point_px=centre, zero_depth=depth)


def fit_all_views(rig: Rig, extent: Sequence[float], panel: Panel) -> Rig:
    """Return fit_rig, made smaller where the outermost views of the panel would cut the content off at the sides.

    A view moves what is at Z by at most fx tan(cone/2) |1 - Z0/Z|. Raises InputError if the extent has no weight.
    """
    fitted = fit_rig(rig, extent, panel)
    left, right, _, _, near, far = extent[:6]
    farthest = max(abs(1 - fitted.zero_depth / depth) for depth in (near, far))
    reach = right - left + 2 * math.tan(math.radians(panel.cone_deg) / 2) * farthest
    smaller = _CONSTANTS.fill_all * panel.width_px / max(reach, 1e-9) / fitted.focal_px[0]
    if smaller >= 1:
        return fitted
    focal = fitted.focal_px[0] * smaller
    sizes = panel.width_px, panel.height_px
    centre = [size / 2 + smaller * (c - size / 2) for size, c in zip(sizes, fitted.principal_point_px)]
    return replace(fitted, focal_px=(focal, focal), principal_point_px=(centre[0], centre[1]))


def middle_depth(extent: Sequence[float]) -> float:
    """Return the harmonic mean of near and far of a content_extent; raise InputError if it has no weight."""
    near, far, weight = extent[4:]
    if not weight > 0:
        raise InputError("no Gaussian lies in front of the camera; give another rig")
    return 2 / (1 / near + 1 / far)


def _in_front(rig: Rig, content: Gaussians, rest: Gaussians | None, panel: Panel, turn: np.ndarray) -> Rig:
    """Return the rig of a camera with rotation `turn` [3, 3], where it sees the most of the content."""
    chosen = 1.0 if rest is None else _clear_distance(rig, content, rest, panel, turn)
    return _bounded(_camera_in_front(rig, content, panel, turn, chosen), content, panel)


def _clear_distance(rig: Rig, content: Gaussians, rest: Gaussians, panel: Panel, turn: np.ndarray) -> float:
    """Return the factor of the usual distance from which the camera sees enough of the content."""
    depths = torch.from_numpy(turn[2]).to(content.means)
    before = select(rest, rest.means @ depths < (content.means @ depths).max())
    few, chosen, best = subsample(content), 1.0, -_CONSTANTS.worth
    for nearer in (1.0, *_CONSTANTS.nearer):
        tried = _bounded(_camera_in_front(rig, few, panel, turn, nearer), few, panel)
        visible = visibility.visible_fraction(content, before, panel, tried) * _fraction_in_frame(few, panel, tried)
        if visible > best + _CONSTANTS.worth:
            chosen, best = nearer, visible
        if best >= _CONSTANTS.visible:
            break
    return chosen


def _fraction_in_frame(gaussians: Gaussians, panel: Panel, rig: Rig) -> float:
    """Return the fraction 0..1 of the Gaussians with their centres on the panel."""
    matrix = pose_tensor(rig, gaussians)
    x, y, z = (gaussians.means @ matrix[:3, :3].T + matrix[:3, 3]).unbind(1)
    inside = z > _NEAR
    for slope, focal, centre, size in zip(
        (x / z, y / z), rig.focal_px, rig.principal_point_px, (panel.width_px, panel.height_px)
    ):
        inside &= (focal * slope + centre >= 0) & (focal * slope + centre <= size)
    return float(inside.double().mean())


def _camera_in_front(rig: Rig, gaussians: Gaussians, panel: Panel, turn: np.ndarray, factor: float) -> Rig:
    """Return the rig with this rotation, at a factor of the camera's usual distance from the content."""
    axes, field_of_view = torch.from_numpy(turn).to(gaussians.means), _field_of_view_rad(panel)
    bounds = content_bounds(gaussians, axes).cpu().double().numpy()
    width, height, depth = bounds[:, 1] - bounds[:, 0]
    height = max(height, width * panel.height_px / panel.width_px, 1e-6)
    distance = factor * height / _CONSTANTS.fill / 2 / math.tan(field_of_view / 2)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    # The front of the content, not its middle, must fit, and it must stay clear of the near plane.
    matrix[:3, 3] = -bounds.mean(1) + [0, 0, depth / 2 + max(distance, 2 * _NEAR)]
    return replace(rig, world_to_camera=matrix)


def _field_of_view_rad(panel: Panel) -> float:
    """Return the angle that the panel's height takes for its viewer, within the limits of a good picture."""
    if panel.pixel_pitch_mm is None or panel.viewing_distance_mm is None:
        return math.radians(_CONSTANTS.unknown_field_of_view_deg)
    angle = 2 * math.atan(panel.height_px * panel.pixel_pitch_mm / 2 / panel.viewing_distance_mm)
    return min(max(angle, math.radians(_CONSTANTS.field_of_view_deg[0])), math.radians(_CONSTANTS.field_of_view_deg[1]))
