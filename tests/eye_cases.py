"""A panel for tracked eyes, and the eyes of faces before it."""

import math

import numpy as np

from lightfield_gs import Panel

DISTANCE_MM, ZONE_MM = 600.0, 126.0  # a zone of two eyes, as panels for tracked eyes have
PANEL = Panel(
    360,
    200,
    views=2,
    line_number=8.13,
    slant_tan=0.17,
    phase=3.3,
    cone_deg=2 * math.degrees(math.atan(ZONE_MM / 2 / DISTANCE_MM)),
    viewing_distance_mm=DISTANCE_MM,
    pixel_pitch_mm=0.9,
)


def face(x=0.0, y=0.0, z=DISTANCE_MM, turn_deg=0.0, roll_deg=0.0, apart=63.0) -> np.ndarray:
    """The left and the right eye of a face, which may be turned about its vertical axis and tilted."""
    turn, roll = math.radians(turn_deg), math.radians(roll_deg)
    along = np.array([math.cos(turn) * math.cos(roll), math.sin(roll), math.sin(turn)])
    return np.array([x, y, z]) + apart / 2 * np.array([-along, along])
