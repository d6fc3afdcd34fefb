"""What the numbers of a depth map mean: distances or disparities, as view-space z."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_INVALID, DEPTH_KINDS, DepthInvalid, DepthKind
from lightfield_gs.photo.depth_files import DepthNumbers, read_numbers

FARTHEST = 1e12  # scene units: what is farther counts as not measured
# Where infinitely far things are put, in distances of the farthest that was measured: there the cameras beside see next
# to no parallax
_FAR_BEYOND = 2


@dataclass
class DepthMap:
    """z: view-space z, float32 [H, W], NaN where nothing was measured. focal_px: the focal length in pixels that its
    file says, or None. said: what was decided, in words; notes: what may not be as it was meant."""

    z: np.ndarray
    focal_px: float | None
    said: str
    notes: list[str]


def read_depth(
    path: str | Path,
    kind: DepthKind = "distance",
    *,
    scale: float | None = None,
    limits: tuple[float, float] | None = None,
    invalid: DepthInvalid = "far",
) -> np.ndarray:
    """View-space z [H, W] of each pixel, float32, scene units; NaN where the file holds no measurement.

    path: a grey image (PNG of 8 or 16 bits, EXR, TIFF), a .npy of numbers [H, W], or a .npz with one.
    kind: the numbers v are "distance", v = z / scale, or "disparity" (inverse distance), v = scale / z. NaN, negative
    numbers, the distance 0 and infinite disparities are no measurement.
    scale: 0.001 for millimetres to metres; for disparities in pixels focal length times baseline. None: 1, for floats.
    limits: (near, far) in place of a scale: z, or with "disparity" 1/z, runs linearly between them over the full
    scale of the file, 0..255, 0..65535 or 0..1 for floats; distance has near at 0, disparity far at 0.
    invalid: infinite distances and the disparity 0 are "far" away, at twice the largest distance that was measured, or
    with limits at the far one; or a "hole", not measured.
    Raises InputError that names the file: no depth map, numbers out of range, or whole numbers that nothing explains.
    """
    return depth_map(path, read_numbers(path), kind, scale=scale, limits=limits, invalid=invalid).z


def depth_map(
    path: str | Path,
    numbers: DepthNumbers,
    kind: str | None = None,
    *,
    scale: float | None = None,
    limits: tuple[float, float] | None = None,
    invalid: str = "far",
    turn: Callable[[DepthNumbers], tuple[np.ndarray, bool]] | None = None,
) -> DepthMap:
    """What read_depth does, of the numbers that were read from `path`.

    kind: None: what the file says, else "distance". turn: a function that returns the numbers as upright as the photo
    is, and whether it turned them.
    """
    kind = kind or numbers.kind or "distance"
    for name, given, choices in (("depth kind", kind, DEPTH_KINDS), ("invalid depths", invalid, DEPTH_INVALID)):
        if given not in choices:
            raise InputError(f"{name}: expected {' or '.join(choices)}, got {given!r}")
    if scale is not None and limits is not None:
        raise InputError("a depth map has a scale, or near and far limits, not both; leave out one of them")
    values, turned = (numbers.values, False) if turn is None else turn(numbers)
    if limits is not None:
        z = _between(path, values, kind, *limits)
        if kind == "disparity" and invalid == "hole":
            z[values == 0] = np.inf
    else:
        if scale is None and values.dtype.kind in "iu":
            raise InputError(
                f"{path} holds whole numbers; say what they mean: near and far (--depth-range NEAR,FAR), "
                "or the length of one (--depth-scale, 0.001 for millimetres to metres)"
            )
        scale = 1.0 if scale is None else _positive("depth scale", scale)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            z = _scaled(values.astype(np.float64), kind, scale)
    measured = np.isfinite(z)
    if not measured.any():
        raise InputError(f"{path}: expected distances or disparities > 0, there is none")
    said = f"{kind} {'as' if kind == 'distance' else 'turned into'} z {z[measured].min():.4g}..{z[measured].max():.4g}"
    said += ", turned with the photo" if turned else ""
    if (far := np.isposinf(z)).any():
        beyond = min(_FAR_BEYOND * z[measured].max(), FARTHEST) if limits is None else limits[1]
        z[far] = beyond if invalid == "far" else np.nan
        said += f", {far.mean():.1%} " + (
            f"infinitely far (put at {beyond:.4g})" if invalid == "far" else "infinitely far and left out"
        )
    if (holes := ~(measured | far)).any():
        said += f", {holes.mean():.1%} not measured"
    with np.errstate(over="ignore"):
        z = z.astype(np.float32)
    return DepthMap(z, numbers.focal_px, said, [f"{path} {words}" for words in numbers.notes])


def _between(path: str | Path, values: np.ndarray, kind: str, near: float, far: float) -> np.ndarray:
    """z [H, W] of numbers whose full scale runs from near to far; see read_depth. Raises InputError."""
    near, far = _positive("depth range: near", near), _positive("depth range: far", far)
    if near >= far:
        raise InputError(f"depth range: expected near < far, got {near:g},{far:g}")
    if values.dtype.kind in "iu":
        if values.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{path}: near and far are for uint8, uint16 or floats in 0..1, got {values.dtype}")
        share = values / np.iinfo(values.dtype).max
    else:
        share = np.where(np.isfinite(values), values, np.nan).astype(np.float64)
        if (share < 0).any() or (share > 1).any():
            raise InputError(
                f"{path}: with near and far expected floats in 0..1, got {np.nanmin(share):g}.."
                f"{np.nanmax(share):g}; divide by the largest, or give a scale"
            )
    if kind == "distance":
        return np.where(np.isposinf(values), np.inf, near + (far - near) * share)
    return 1 / (1 / far + (1 / near - 1 / far) * share)


def _scaled(values: np.ndarray, kind: str, scale: float) -> np.ndarray:
    """z [H, W]: infinite where it is far away, NaN where nothing was measured."""
    if kind == "distance":
        return np.where(values > 0, values * scale, np.nan)
    return np.where((values >= 0) & np.isfinite(values), scale / values, np.nan)


def _positive(name: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise InputError(f"{name}: expected a finite number > 0, got {value}")
    return value
