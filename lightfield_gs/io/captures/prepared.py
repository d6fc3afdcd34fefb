"""From what a layout says to photographs that can be decoded: the sizes of the files, masks, lenses; and which points
are of use."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import Lens
from lightfield_gs.io.captures.capture_masks import masks_for
from lightfield_gs.io.captures.photograph import Photograph
from lightfield_gs.io.captures.resampling import LARGEST_LOSS, share_folded
from lightfield_gs.io.captures.shot import Shot, Shots
from lightfield_gs.io.images import read_info

_FARTHEST = 1e4  # times the points' median distance from their median place: no structure from motion is that sure
_STRETCH = 0.01  # by which the two axes of a resized photograph may differ, beside the rounding of its size


def photographs_of(
    found: Shots, shots: Sequence[Shot], folder: Path, masks: Path | None, share: float, longest_px: int | None
) -> list[Photograph]:
    """The photographs of these shots, made smaller by `share`, and to `longest_px` where they are longer."""
    infos = [read_info(shot.path) for shot in shots]
    alphas = [info.has_alpha for info in infos]
    mask_paths = masks_for(found, shots, folder, masks, alphas)
    photographs, checked = [], set()
    for shot, info, mask, alpha in zip(shots, infos, mask_paths, alphas):
        stored = info.width_px, info.height_px
        _check_size(shot, stored, info.orientation)
        ratio = np.array(stored) / shot.camera_px
        intrinsics = tuple((shot.intrinsics * np.tile(ratio, 2)).tolist())
        if shot.lens is not None and (key := (shot.lens, intrinsics, stored)) not in checked:
            checked.add(key)
            _check_lens(shot, shot.lens, np.array(intrinsics), stored)
        size = _size(stored, share, longest_px)
        photographs.append(Photograph(shot.path, stored, size, intrinsics, shot.lens, mask, alpha, info.orientation))
    _say_sizes(shots, photographs)
    return photographs


def usable_points(found: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] and colours [P,3] without those that are not finite or absurdly far away."""
    points = found.points
    good = np.isfinite(points).all(1) & (np.abs(points).max(1, initial=0) < 1e12)
    if good.any():
        away = np.full(len(points), np.inf)
        away[good] = np.linalg.norm(points[good] - np.median(points[good], 0), axis=1)
        good &= away <= max(_FARTHEST * float(np.median(away[good])), 1e-9)
    if not good.all():
        words = counted(int((~good).sum()), "point", len(good), "are not finite or absurdly far, and left out")
        assume(f"{found.source}: {words}")
    return points[good], found.colours[good]


def _size(stored: tuple[int, int], share: float, longest_px: int | None) -> tuple[int, int]:
    if longest_px is not None:
        share = min(1.0, longest_px / max(stored))
    width, height = (max(1, round(side * share)) for side in stored)
    return width, height


def _check_size(shot: Shot, stored: tuple[int, int], orientation: int) -> None:
    """Raises InputError for a file whose shape is not that of its camera's pictures, up to rounding."""
    (width, height), (camera_width, camera_height) = stored, shot.camera_px
    # The size was rounded up or down by less than a pixel, each way
    slack = 1 / min(width, height) + 1 / min(camera_width, camera_height) + _STRETCH
    if abs(width * camera_height / (height * camera_width) - 1) <= slack:
        return
    turned = orientation >= 5 and abs(height * camera_height / (width * camera_width) - 1) <= slack
    way_out = (
        f": as stored it lies on its side (Exif orientation {orientation}): store photographs turned (ImageMagick: "
        "mogrify -auto-orient), or find the poses with the orientation left alone"
        if turned
        else ": a photograph may be resized, but not cropped or turned, after it was posed"
    )
    raise InputError(
        f"{shot.path}: expected the shape of its camera's pictures, {camera_width} x {camera_height}, got "
        f"{width} x {height}{way_out}"
    )


def _check_lens(shot: Shot, lens: Lens, intrinsics: np.ndarray, stored: tuple[int, int]) -> None:
    """Raises InputError for a lens that makes no picture; says what of a fisheye's is seen."""
    if (lost := share_folded(lens, intrinsics, *stored)) > LARGEST_LOSS:
        raise InputError(
            f"{shot.path}: the lens {lens.words} folds {lost:.0%} of the picture onto the rest: expected "
            "coefficients that straighten it; pose the photographs again with a simpler camera model"
        )
    if lens.fisheye:
        before, after = intrinsics[2:] / intrinsics[:2], (stored - intrinsics[2:]) / intrinsics[:2]
        wide, high = np.degrees(np.arctan(before) + np.arctan(after))
        assume(
            f"fisheye photographs as {shot.name} are seen as a pinhole of their focal length sees the scene, "
            f"{wide:.0f} x {high:.0f} degrees; what they show beyond is not used"
        )


def _say_sizes(shots: Sequence[Shot], photographs: Sequence[Photograph]) -> None:
    resized = [photo for shot, photo in zip(shots, photographs) if photo.stored_px != shot.camera_px]
    if resized:
        first = resized[0]
        was = next(shot.camera_px for shot, photo in zip(shots, photographs) if photo is first)
        assume(
            f"{counted(len(resized), 'photograph', len(shots), 'are not of the posed size and were resized')}: "
            f"{first.path.name} is {first.stored_px[0]} x {first.stored_px[1]}, its camera {was[0]} x {was[1]}; "
            "intrinsics are scaled by the ratio of each axis"
        )
