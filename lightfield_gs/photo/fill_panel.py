"""Cameras of a picture on a panel of another shape: enlarged until the picture fills it, as far as its subject lets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.visibility import centre_picture
from lightfield_gs.photo.subject import subject_box
from lightfield_gs.scene.gaussians import Gaussians


@dataclass(frozen=True)
class FillConstants:
    """Thresholds of pictures. All are chosen by hand; tests/photo/test_fill_panel.py has the pictures."""

    alike: float = 1.02  # ratio of two shapes up to which they are one
    holes: float = 0.05  # fraction of the picture up to which the scene fills it; an object alone stays whole
    most_cropped: float = 0.34  # of a picture without a whole subject, as of photos


_CONSTANTS = FillConstants()


def fill_panel(rig: Rig, size_px: tuple[int, int], panel: Panel, gaussians: Gaussians) -> Rig:
    """Return the rig of a picture of another size, fitted to the panel.

    Where the scene fills the picture, the rig is enlarged about the subject. It fills the panel then, unless that would
    crop the subject, or a third of a picture without one.

    Args:
        rig: The rig for a picture of this size, in the coordinates of the Gaussians.
        size_px: Width and height of the picture.
        panel: The panel.
        gaussians: One set.
    """
    fitted = rig.fitted(size_px, panel)
    sizes = panel.width_px, panel.height_px
    scales = sizes[0] / size_px[0], sizes[1] / size_px[1]
    most = max(scales) / min(scales)
    if most < _CONSTANTS.alike:
        return fitted
    picture = replace(panel, width_px=size_px[0], height_px=size_px[1])
    covered, depth = centre_picture(gaussians, picture, rig)
    if 1 - covered.mean() > _CONSTANTS.holes:
        return fitted
    axis = int(scales[0] > scales[1])  # along which the picture is cropped
    low, high = _subject(np.where(covered, depth, np.inf), axis)
    zoom = min(most, 1 / (high - low))
    middle = min(max((low + high) / 2, 0.5 / zoom), 1 - 0.5 / zoom)
    centre = [size / 2 + zoom * (c - size / 2) for size, c in zip(sizes, fitted.principal_point_px)]
    centre[axis] -= zoom * (middle - 0.5) * sizes[axis]
    focal = zoom * fitted.focal_px[0], zoom * fitted.focal_px[1]
    return replace(fitted, focal_px=focal, principal_point_px=(centre[0], centre[1]))


def _subject(depth: np.ndarray, axis: int) -> tuple[float, float]:
    """Return the ends 0..1, along x (0) or y (1), of the part of a picture [H, W] that is not cropped."""
    box = subject_box(torch.from_numpy(depth))
    length = depth.shape[1 - axis]
    if box is None or (box[axis] <= 0 and box[axis + 2] >= length):  # cut off by the picture itself
        return _CONSTANTS.most_cropped / 2, 1 - _CONSTANTS.most_cropped / 2
    return box[axis] / length, box[axis + 2] / length
