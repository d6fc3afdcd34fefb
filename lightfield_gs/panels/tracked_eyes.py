"""Two eyes before a panel whose positions are known: the lens that parts their pictures, and their cameras.

An eye reaches the sub-pixel with the lens coordinate D through the point a(D) on its lens, which `simulate` states. The
lens lights the sub-pixel for this eye where frac(a) = 1/2; a is linear in D. A sub-pixel is to show the picture of the
eye that it lights more: the eye whose a is nearer to 1/2, round the lens. The border lies midway between the eyes. With
a = (a_left + a_right)/2, the right eye has the sub-pixels with frac(a) < 1/2, and the left eye has the others.

That is a panel of two views. Its line number and its phase follow the eyes: 1/slope, and the shift of a.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from lightfield_gs.base.checks import expect, is_row, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import FWHM_TO_SIGMA, EyePath, check_geometry, checked_eye, eye_path

if TYPE_CHECKING:
    from lightfield_gs.scene.cameras import Cameras

Eyes = Sequence[Sequence[float]] | np.ndarray


def panel_for_eyes(panel: Panel, eyes_mm: Eyes) -> Panel:
    """Return the panel as a lens of two views, one for each of two eyes.

    Args:
        panel: With viewing_distance_mm and pixel_pitch_mm.
        eyes_mm: [2, 3], the left eye's position and the right one's, see simulate.

    Raises:
        InputError: The panel lacks a measure, or an eye is no position before it.
    """
    left, right = _paths(panel, eyes_mm)
    slope, shift = (left.slope + right.slope) / 2, (left.shift + right.shift) / 2
    if math.floor(_apart(panel, left, right)) % 2:  # the eyes look through different lenses: their order turns round
        shift += 0.5
    # a = slope (D - middle) + shift, and D less phase is the sub-pixel's place
    phase = shift / slope - (left.middle - panel.phase)
    lens = 1 / slope
    return replace(panel, views=2, line_number=lens, phase=math.remainder(phase, lens))


def eye_crosstalk(panel: Panel, eyes_mm: Eyes, spread_subpixels: float = 1.0) -> float:
    """Return the part of the other eye's picture that each of two eyes sees, 0..1/2, in the middle of the panel.

    The light of a lens is a Gaussian, as in simulate. An eye sees the other picture beyond the borders midway, which
    are P_e f/2 and P_e (1 - f)/2 sub-pixels away, where the eyes are f lenses apart.

    Args:
        panel: See panel_for_eyes.
        eyes_mm: See there.
        spread_subpixels: See simulate.

    Raises:
        InputError: See panel_for_eyes.
    """
    left, right = _paths(panel, eyes_mm)
    apart = _apart(panel, left, right) % 1
    sigma = spread_subpixels * FWHM_TO_SIGMA * left.slope
    parts = (math.erfc(part / (2 * sigma * math.sqrt(2))) / 2 for part in (apart, 1 - apart))
    return min(0.5, sum(parts))


def eye_cameras(panel: Panel, rig: Rig, eyes_mm: Eyes) -> Cameras:
    """Return the cameras at K eyes, each of which sees the panel's plane as its window.

    The rig's centre camera is an eye at (0, 0, L), L the viewing distance. In the axes of that camera the eye (x, y, z)
    stands at c = Z0/L (q x, -q y, L - z), q = tan(rig's cone/2) / tan(panel's cone/2), 1 without a change of depth. Its
    focal lengths are z/L times the rig's and its principal point moves by f c/Z0, so that the plane z = Z0 stays where
    it is. At z = L and y = 0 that is the camera of the view that the eye sees of the panel's fan.

    Args:
        panel: With a viewing distance.
        rig: Its rig.
        eyes_mm: [K, 3], see simulate.

    Raises:
        InputError: The panel has no viewing distance, or an eye is no position before it.
    """
    import torch

    from lightfield_gs.scene.cameras import Cameras

    expect("panel", panel, Panel)
    expect("rig", rig, Rig)
    distance = panel.viewing_distance_mm
    if distance is None:
        raise InputError(f"panel {panel.name} lacks viewing_distance_mm; eyes cannot be placed without")
    eyes = np.array(checked_eyes(eyes_mm))
    amount = rig.half_width(panel) / (rig.zero_depth * math.tan(math.radians(panel.cone_deg) / 2))
    centres = rig.zero_depth / distance * eyes * (amount, -amount, -1) + (0, 0, rig.zero_depth)
    poses = np.repeat(rig.world_to_camera[None], len(eyes), 0)
    poses[:, :3, 3] -= centres
    focals = np.array(rig.focal_px) * eyes[:, 2:] / distance
    principal = np.array(rig.principal_point_px) + np.array(rig.focal_px) / rig.zero_depth * centres[:, :2]
    size = panel.width_px, panel.height_px
    return Cameras(torch.from_numpy(poses), torch.from_numpy(focals), torch.from_numpy(principal), *size)


def _paths(panel: Panel, eyes_mm: Eyes) -> tuple[EyePath, EyePath]:
    """Return the paths of the left and the right eye. Raises InputError."""
    check_geometry(panel)
    lens = panel.line_number, panel.slant_tan, panel.phase, math.tan(math.radians(panel.cone_deg) / 2)
    left, right = (eye_path(panel, eye, *lens) for eye in checked_eyes(eyes_mm, 2))
    return left, right


def checked_eyes(eyes_mm: Eyes, count: int | None = None) -> list[tuple[float, float, float]]:
    """Return the positions of eyes; count: of how many. Raises InputError."""
    rows = eyes_mm.tolist() if isinstance(eyes_mm, np.ndarray) else eyes_mm
    if not is_row(rows, count):
        whose = "the left and the right eye" if count == 2 else "eyes"
        raise InputError(f"eyes_mm: expected the positions of {whose}, x, y, z each, got {shown(eyes_mm)}")
    return [checked_eye(eye) for eye in rows]


def _apart(panel: Panel, left: EyePath, right: EyePath) -> float:
    """Return how far the eyes are apart behind a lens in the middle of the panel, in lens widths; above 0 as faces."""
    return cast(float, right.shift - left.shift) * (-1 if panel.invert_views else 1)
