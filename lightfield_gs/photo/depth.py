"""Depth maps from files: whole numbers or floats, distances or disparities, as view-space z."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_INVALID, DEPTH_KINDS, DepthInvalid, DepthKind
from lightfield_gs.io.images import read_info, read_picture
from lightfield_gs.io.npy import open_array, stored_arrays

_IMAGE_TYPES = ("uint8", "uint16", "half", "float")  # others would be read as shares of their largest number
FARTHEST = 1e12  # scene units: what is farther counts as not measured
# Where infinitely far things are put, in distances of the farthest that was measured: there the cameras beside see next
# to no parallax
_FAR_BEYOND = 2
_ALMOST_GREY = 0.04  # how far the channels of a grey map come apart when it is saved as JPEG, as a share of its range
# Names in .npz files; the first of each is Depth Pro's
_DEPTH_KEYS, _DISPARITY_KEYS = ("depth", "depth_map", "z"), ("disparity", "disp", "inverse_depth")
_FOCAL_KEYS = ("focallength_px", "focal_length_px", "focal_px")


@dataclass
class DepthNumbers:
    """The numbers of a depth map as its file holds them.

    values: [H, W], integers or floats. orientation: the Exif orientation that was undone. kind: "distance" or
    "disparity", and focal_px: the focal length in pixels; None where the file does not say it. notes: what may not be
    as it was meant.
    """

    values: np.ndarray
    orientation: int = 1
    kind: str | None = None
    focal_px: float | None = None
    notes: list[str] = field(default_factory=list)


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


def read_numbers(path: str | Path) -> DepthNumbers:
    """The numbers of a depth map, whatever they mean. Raises InputError that names the file."""
    suffix = Path(path).suffix.lower()
    if suffix == ".npz":
        return _from_npz(path)
    if suffix == ".npy":
        return DepthNumbers(_checked(path, open_array(path)))
    info = read_info(path)
    if info.sample_type not in _IMAGE_TYPES:
        raise InputError(
            f"{path}: expected a depth map of {', '.join(_IMAGE_TYPES)}, got {info.sample_type}; save it as .npy"
        )
    picture = read_picture(path)
    return grey_numbers(path, picture.pixels, picture.orientation)


def grey_numbers(path: str | Path, pixels: np.ndarray, orientation: int = 1) -> DepthNumbers:
    """The numbers of an image [H, W, C] that is grey, or almost, whatever its channels. Raises InputError."""
    if pixels.shape[2] < 3:  # grey, or grey and alpha
        return DepthNumbers(pixels[..., 0], orientation)
    apart = {pair: channels_apart(pixels, *pair) for pair in ((0, 1), (0, 2), (1, 2))}
    most = max(apart.values())
    if most == 0:
        return DepthNumbers(pixels[..., 0], orientation)
    if most <= _ALMOST_GREY:
        return DepthNumbers(
            np.median(pixels[..., :3], 2).astype(pixels.dtype),
            orientation,
            notes=[
                f"is almost grey: its channels differ by up to {most:.1%} of its range, and the middle one is taken"
            ],
        )
    for (one, other), difference in apart.items():
        third = pixels[..., 3 - one - other]
        if difference <= _ALMOST_GREY and (third == third[0, 0]).all():
            return DepthNumbers(
                pixels[..., one],
                orientation,
                notes=[
                    f"is no grey image, but channels {one + 1} and {other + 1} are alike and the third says nothing: "
                    "the former is taken"
                ],
            )
    raise InputError(f"{path} is in colour; expected a grey depth map, one number a pixel")


def channels_apart(pixels: np.ndarray, one: int, other: int) -> float:
    """The largest difference between two channels of pixels [H, W, C], of the range of both; infinite where one of them
    is finite and the other is not."""
    both = pixels[..., [one, other]].astype(np.float32)
    finite = np.isfinite(both)
    if not np.array_equal(both[..., 0][~finite.all(2)], both[..., 1][~finite.all(2)], equal_nan=True):
        return np.inf
    values = both[finite.all(2)]
    if not len(values):
        return 0.0
    return float(np.abs(values[:, 0] - values[:, 1]).max()) / (float(np.ptp(values)) or 1.0)


def _from_npz(path: str | Path) -> DepthNumbers:
    """The one depth map in a .npz, by its name, or because there is no other array [H, W]; and its focal length."""
    arrays = stored_arrays(path)
    flat = [name for name, array in arrays.items() if len(array.shape) == 2]
    named = [name for name in (*_DEPTH_KEYS, *_DISPARITY_KEYS) if name in flat]
    if not named and len(flat) != 1:
        raise InputError(
            f"{path}: expected a depth map [H, W] named {_DEPTH_KEYS[0]}, or one array alone; it holds "
            f"{ascii(', '.join(arrays))[1:-1][:200] or 'nothing'}; save the map as .npy"
        )
    name = (named or flat)[0]
    focal = [
        float(arrays[key].read().ravel()[0])
        for key in _FOCAL_KEYS
        if key in arrays and math.prod(arrays[key].shape) == 1
    ]
    if focal and not 0 < focal[0] < np.inf:
        raise InputError(f"{path}: expected a focal length > 0 px, got {focal[0]:g}")
    return DepthNumbers(
        _checked(path, arrays[name].read()),
        kind="disparity" if name in _DISPARITY_KEYS else None,
        focal_px=focal[0] if focal else None,
    )


def _checked(path: str | Path, values: np.ndarray) -> np.ndarray:
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "iuf":
        raise InputError(f"{path}: expected numbers [H, W], got {values.dtype} {list(values.shape)}")
    return np.asarray(values)


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
