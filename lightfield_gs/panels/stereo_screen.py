"""Screens that show each eye a picture of its own: 3D televisions, headsets, and displays without lenses of views."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lightfield_gs.base.checks import check_fields, checked_field, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.comfort import EYE_SEPARATION_MM
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

LEFT_RIGHT = (1.5, 0.5)  # view coordinates of the left and the right eye on the panel of a stereo screen
_MM_PER_INCH = 25.4
_DISTANCE = 0.875  # default viewing distance by the diagonal: 600 mm before a monitor of 27 inches


@dataclass(frozen=True)
class StereoScreen:
    """A screen, and the eyes before it.

    Attributes:
        width_px: Width of the picture of one eye, even.
        height_px: Its height, even.
        diagonal_in: Diagonal of the screen, inches.
        eye_distance_mm: Distance between the eyes.
        viewing_distance_mm: From the eyes to the screen; None: 0.875 of the diagonal.

    Raises:
        InputError: A value is out of its range.
    """

    width_px: int = checked_field(whole_number, 2, 16384, default=1920)
    height_px: int = checked_field(whole_number, 2, 16384, default=1080)
    diagonal_in: float = checked_field(real_number, 0.5, 2000, default=27.0)
    eye_distance_mm: float = checked_field(real_number, 20, 120, default=EYE_SEPARATION_MM)
    viewing_distance_mm: float | None = checked_field(real_number, 1, 1e6, default=None)

    def __post_init__(self) -> None:
        check_fields(self, "stereo: ")
        if self.width_px % 2 or self.height_px % 2:
            raise InputError(f"stereo: expected an even size of an eye, got {self.width_px} x {self.height_px} pixels")

    @property
    def distance_mm(self) -> float:
        """The viewing distance, or its default."""
        return self.viewing_distance_mm or _DISTANCE * _MM_PER_INCH * self.diagonal_in

    def panel(self) -> Panel:
        """Return a panel of two views whose cameras stand where the eyes are, for framing and for comfort.

        Its lengths are in units in which the eyes are 63 mm apart: that is what the rule of comfort counts with, and
        its angles stay the same.
        """
        scale = EYE_SEPARATION_MM / self.eye_distance_mm
        pitch_mm = _MM_PER_INCH * self.diagonal_in / math.hypot(self.width_px, self.height_px)
        return Panel(
            self.width_px,
            self.height_px,
            views=2,
            line_number=6.0,
            slant_tan=0.0,
            cone_deg=2 * math.degrees(math.atan(self.eye_distance_mm / self.distance_mm)),
            viewing_distance_mm=scale * self.distance_mm,
            pixel_pitch_mm=scale * pitch_mm,
            name="stereo",
        )

    def words(self) -> str:
        """Return the screen and the eyes in words."""
        return (
            f"eyes {self.eye_distance_mm:g} mm apart, {self.distance_mm:.0f} mm before a screen of "
            f"{self.diagonal_in:g} inches"
        )


def eye_geometry(panel: Panel, rig: Rig) -> dict[str, object]:
    """Return how the pictures of two eyes hang together: 1/z = 1/zero_depth + (x_left - x_right)/(fx baseline).

    Args:
        panel: Of a StereoScreen.
        rig: In scene units.

    Returns:
        focal_px, principal_point_px and width_px of the left eye's camera, baseline and zero_depth.
    """
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    left, right = (float(rig.offset(x, panel)) for x in LEFT_RIGHT)
    return {
        "focal_px": [fx, fy],
        "principal_point_px": [cx + fx / rig.zero_depth * left, cy],
        "width_px": panel.width_px,
        "baseline": right - left,
        "zero_depth": rig.zero_depth,
    }
