"""The camera that sees the viewer: from the pixels of two eyes to their positions before the panel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lightfield_gs.panels.panel import Panel

DEFAULT_FOV_DEG = 65.0  # of cameras in laptops
ABOVE_MM = 10.0  # a camera that is built into a screen lies so far above its picture


@dataclass(frozen=True)
class TrackerCamera:
    """A pinhole camera that looks straight away from the panel at the viewer.

    Attributes:
        fov_deg: Full angle that its pictures have from left to right.
        at_mm: Its place (x, y, z) from the panel's centre, x right, y up, z towards the viewer.
        eye_distance_mm: Between the eyes of the viewer.
    """

    fov_deg: float
    at_mm: tuple[float, float, float]
    eye_distance_mm: float

    def eyes_mm(self, eyes_px: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
        """Return the positions [2, 3] of the left and the right eye before the panel, mm.

        Both eyes are f eye_distance/(pixels between them) from the camera, f = (w/2)/tan(fov/2). A face that is turned
        aside seems as much farther away as its eyes seem nearer to each other.

        Args:
            eyes_px: [2, 2], x and y of the viewer's left and right eye in a picture that is not mirrored.
            size_px: Width and height of the picture.
        """
        width, height = size_px
        focal = width / 2 / math.tan(math.radians(self.fov_deg) / 2)
        distance = focal * self.eye_distance_mm / math.dist(*eyes_px)
        aside = (eyes_px - (width / 2, height / 2)) / focal * distance
        # The camera looks the other way than the viewer: its right is his left, and its rows go down
        seen = np.concatenate([-aside, np.full((2, 1), distance)], 1)
        return seen + self.at_mm


def above(panel: Panel) -> tuple[float, float, float]:
    """Return the place of a camera that is built into a screen, above the middle of its picture."""
    assert panel.pixel_pitch_mm is not None
    return 0.0, panel.height_px * panel.pixel_pitch_mm / 2 + ABOVE_MM, 0.0
