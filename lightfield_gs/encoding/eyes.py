"""Pictures for two eyes whose positions are known: woven for a panel with lenses, or one for a plain screen."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, to_bytes, to_tensor
from lightfield_gs.base.checks import expect
from lightfield_gs.base.device import finished
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.classic import render_cameras
from lightfield_gs.panels.cells import LENS_WIDTH, PERIOD, subpixel_phases
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.tracked_eyes import Eyes, checked_eyes, eye_cameras, panel_for_eyes
from lightfield_gs.scene.gaussians import Gaussians

_NEWEST = 0.3  # weight of the newest time of drawing in their average


@torch.no_grad()
def weave_eyes(left: np.ndarray | Tensor, right: np.ndarray | Tensor, panel: Panel, eyes_mm: Eyes) -> Tensor:
    """Weave the pictures of two eyes into the image [H, W, 3] of a panel, in their type and on their device.

    Each sub-pixel shows the picture of the eye that its lens lights it for more; lightfield_gs.panels.tracked_eyes has
    the mathematics. (Perlin, Paxia & Kollin, "An autostereoscopic display", SIGGRAPH 2000, switch by tracked eyes.)

    Args:
        left: [H, W, 3], the left eye's picture, of the panel's size.
        right: The right eye's, of the same type.
        panel: With viewing_distance_mm and pixel_pitch_mm.
        eyes_mm: [2, 3], the positions of the left and the right eye in mm from the panel's centre: x right, y up, z > 0
            towards the viewer.

    Raises:
        InputError: The pictures are of other sizes or of two types, the panel lacks a measure, or an eye is no position
            before it.
    """
    expect("panel", panel, Panel)
    pictures = to_tensor("left", left), to_tensor("right", right)
    for name, picture in zip(("left", "right"), pictures):
        if tuple(picture.shape) != (panel.height_px, panel.width_px, 3) or picture.dtype != pictures[0].dtype:
            raise InputError(
                f"{name}: expected a picture of panel {panel.name}, {[panel.height_px, panel.width_px, 3]}, both of "
                f"one type, got {list(picture.shape)} {picture.dtype}"
            )
    upper = _upper_half(panel_for_eyes(panel, eyes_mm), pictures[0].device)
    first, second = reversed(pictures) if panel.invert_views else pictures
    return torch.where(upper, first, second)


@torch.no_grad()
def encode_eyes(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    eyes_mm: Eyes,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    device: str | None = None,
) -> Tensor:
    """Draw a scene for two eyes before a panel and weave both pictures: uint8 [H, W, 3].

    The cameras stand where the eyes are, see eye_cameras.

    Args:
        gaussians: One scene.
        panel: See weave_eyes.
        rig: In the coordinates of the scene.
        eyes_mm: See weave_eyes.
        background: See `encode`, also for antialiased and device.
        antialiased: See there.
        device: See there.

    Raises:
        InputError: For arguments of other types or values.
    """
    cameras = eye_cameras(panel, rig, eyes_mm)
    left, right = to_bytes(
        render_cameras(gaussians, cameras, background=background, antialiased=antialiased, device=device)
    )
    return weave_eyes(left, right, panel, eyes_mm)


@torch.no_grad()
def render_head_coupled(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    eyes_mm: Eyes,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    device: str | None = None,
) -> Tensor:
    """Draw a scene on a plain screen as behind a window, for the middle between two eyes: uint8 [H, W, 3].

    The projection is off-axis: the screen's plane stays where it is as the head moves. (Ware, Arthur & Booth, "Fish
    tank virtual reality", INTERCHI 1993.)

    Args:
        gaussians: See encode_eyes, also for all others.
        panel: Of the screen, whose lens does not count.
        rig: See there.
        eyes_mm: See there.
        background: See there.
        antialiased: See there.
        device: See there.

    Raises:
        InputError: For arguments of other types or values.
    """
    cameras = eye_cameras(panel, rig, [np.mean(checked_eyes(eyes_mm, 2), 0)])
    picture = render_cameras(gaussians, cameras, background=background, antialiased=antialiased, device=device)
    return to_bytes(picture[0])


class EyesDrawing:
    """Draws scenes for two eyes, on a panel with lenses or on a plain screen, and measures its time.

    Args:
        panel: Of the screen.
        is_plain: Whether it has no lenses.

    Attributes:
        seconds: What a picture takes, an average in which newer ones count more; 0 before the first.
    """

    def __init__(self, panel: Panel, is_plain: bool):
        self.seconds = 0.0
        self._panel, self._draw = panel, render_head_coupled if is_plain else encode_eyes

    def __call__(self, gaussians: Gaussians, rig: Rig, eyes_mm: Eyes, **how: Any) -> Tensor:
        """Return the picture uint8 [H, W, 3]; how: see encode_eyes. Raises InputError."""
        began = time.perf_counter()
        image = finished(self._draw(gaussians, self._panel, rig, eyes_mm, **how))
        weight = _NEWEST if self.seconds else 1.0
        self.seconds += weight * (time.perf_counter() - began - self.seconds)
        return image


def _upper_half(panel: Panel, device: torch.device) -> Tensor:
    """Return bool [H, W, 3], where the phase of a panel of two views is in the upper half of its lens: in view 1."""
    # 64 bits that wrap, as everywhere; with a sign, for torch adds no others: the upper half is below 0
    start, across, down = (step - LENS_WIDTH if step >= LENS_WIDTH // 2 else step for step in panel.phase_steps())
    within = torch.from_numpy(subpixel_phases(panel).view(np.int64)).to(device)
    columns, rows = (torch.arange(size, device=device) for size in (panel.width_px, panel.height_px))
    along = (3 * columns * across)[:, None] + within[:, columns % PERIOD]
    below = start + down * rows
    upper = torch.empty(panel.height_px, panel.width_px, 3, dtype=torch.bool, device=device)
    for kind in range(min(PERIOD, panel.height_px)):
        torch.lt(below[kind::PERIOD, None, None] + along[kind], 0, out=upper[kind::PERIOD])
    return upper
