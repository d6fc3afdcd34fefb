"""The camera of a photo with depths."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from lightfield_gs.base.errors import InputError

if TYPE_CHECKING:
    pass

_OFF_CENTRE = 0.1  # a principal point that is farther off the middle, in sides of the photo, may be another photo's
# Angles of the longer side that are usual, and those beyond which intrinsics must be in other units
_USUAL_ANGLES_DEG, _ANGLES_DEG = (10.0, 130.0), (1.0, 175.0)


def camera_of_photo(args: argparse.Namespace, height: int, width: int, focal_px: float | None) -> tuple:
    """Focal lengths and principal point for from_depth, words for them, and notes; focal_px: of the depth's file."""
    from lightfield_gs.photo.rgbd import FIELD_OF_VIEW_DEG, focal_length_px

    if args.intrinsics is not None:
        return args.intrinsics[:2], args.intrinsics[2:], *_checked_intrinsics(args.intrinsics, height, width)
    # Angles are those of the photo as it is seen, at the height of its pixels
    wide = args.pixel_aspect or 1.0
    squeezed = "" if args.pixel_aspect is None else f", its pixels {wide:g} times as wide as high"
    if args.fov is not None:
        focal = focal_length_px(args.fov, height, width * wide)
        return (focal / wide, focal), None, f"field of view {args.fov:g} degrees{squeezed}", []
    if focal_px is not None:
        focals = focal_px / wide, focal_px
        _, notes = _checked_intrinsics((*focals, width / 2, height / 2), height, width)
        return focals, None, f"focal length {focal_px:.5g} px, of {args.depth.name}{squeezed}", notes
    description = f"field of view {FIELD_OF_VIEW_DEG:g} degrees (assumed; --fov){squeezed}"
    if args.pixel_aspect is None:
        return None, None, description, []
    focal = focal_length_px(FIELD_OF_VIEW_DEG, height, width * wide)
    return (focal / wide, focal), None, description, []


def _checked_intrinsics(intrinsics: tuple[float, ...], height: int, width: int) -> tuple[str, list[str]]:
    """Words for intrinsics, and notes on what is unusual; raises InputError where they cannot be this photo's."""
    fx, fy, cx, cy = intrinsics
    angle = 2 * math.degrees(math.atan(max(width / fx, height / fy) / 2))
    off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    at = f"{fx:g},{fy:g},{cx:g},{cy:g} of a photo of {width} x {height}"
    if off > 0.5 or not _ANGLES_DEG[0] <= angle <= _ANGLES_DEG[1]:
        why = (
            f"the principal point {cx:g},{cy:g} is outside it"
            if off > 0.5
            else f"the longer side would take {angle:.4g} degrees"
        )
        raise InputError(
            f"--intrinsics: {why} ({at}); expected pixels of this photo, upright: scale them with its "
            "size, or give --fov DEG"
        )
    notes = []
    if off > _OFF_CENTRE:
        notes.append(
            f"--intrinsics {at}: the principal point is far off its middle; are they of another size, or of "
            "the photo before it was turned?"
        )
    if not _USUAL_ANGLES_DEG[0] <= angle <= _USUAL_ANGLES_DEG[1] or not 0.5 <= fx / fy <= 2:
        notes.append(
            f"--intrinsics {at}: the longer side takes {angle:.4g} degrees, fx / fy is {fx / fy:.3g}; are "
            "they of another size?"
        )
    return f"focal lengths {fx:g},{fy:g} px", notes
