"""Depth maps from files: whole numbers or floats, distances or disparities, as view-space z."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightfield_gs.errors import InputError
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.io.npy import open_array
from lightfield_gs.options import DEPTH_KINDS, DepthKind

_IMAGE_TYPES = ("uint8", "uint16", "half", "float")  # others would be read as shares of their largest number


def read_depth(path: str | Path, kind: DepthKind = "distance", *, scale: float | None = None,
               limits: tuple[float, float] | None = None) -> np.ndarray:
    """View-space z [H, W] of each pixel, float32, scene units; NaN where the file holds no measurement.

    path: a grey image (PNG of 8 or 16 bits, EXR, TIFF) or a .npy of numbers [H, W].
    kind: the numbers v are "distance", v = z / scale, or "disparity" (inverse distance), v = scale / z; NaN, infinite
    and v <= 0 are no measurement.
    scale: 0.001 for millimetres to metres; for disparities in pixels focal length times baseline. None: 1, for floats.
    limits: (near, far) in place of a scale: z, or with "disparity" 1/z, runs linearly between them over the full
    scale of the file, 0..255, 0..65535 or 0..1 for floats; distance has near at 0, disparity far at 0.
    Raises InputError that names the file: no depth map, numbers out of range, or whole numbers that nothing explains.
    """
    if kind not in DEPTH_KINDS:
        raise InputError(f"depth kind: expected {' or '.join(DEPTH_KINDS)}, got {kind!r}")
    if scale is not None and limits is not None:
        raise InputError("a depth map has a scale, or near and far limits, not both; leave out one of them")
    values = _read_values(path)
    if limits is not None:
        depth = _between(path, values, kind, *limits)
    else:
        if scale is None and values.dtype.kind in "iu":
            raise InputError(f"{path} holds whole numbers; say what they mean: near and far (--depth-range NEAR,FAR), "
                             "or the length of one (--depth-scale, 0.001 for millimetres to metres)")
        scale = 1.0 if scale is None else _positive("depth scale", scale)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            depth = _scaled(values.astype(np.float64), kind, scale)
    if not np.isfinite(depth).any():
        raise InputError(f"{path}: expected distances or disparities > 0, there is none")
    return depth.astype(np.float32)


def _read_values(path: str | Path) -> np.ndarray:
    """The numbers [H, W] as the file holds them, integers or floats."""
    if Path(path).suffix.lower() == ".npy":
        values = open_array(path)
        if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "iuf":
            raise InputError(f"{path}: expected numbers [H, W], got {values.dtype} {list(values.shape)}")
        return np.asarray(values)
    info = read_info(path)
    if info.sample_type not in _IMAGE_TYPES:
        raise InputError(f"{path}: expected a depth map of {', '.join(_IMAGE_TYPES)}, got {info.sample_type}; save it "
                         "as .npy")
    pixels = read_image(path, as_stored=True)
    colours = pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1]
    if not np.array_equal(colours, np.broadcast_to(colours[..., :1], colours.shape), equal_nan=True):
        raise InputError(f"{path} is in colour; expected a grey depth map, one number a pixel")
    return colours[..., 0]


def _between(path: str | Path, values: np.ndarray, kind: str, near: float, far: float) -> np.ndarray:
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
            raise InputError(f"{path}: with near and far expected floats in 0..1, got {np.nanmin(share):g}.."
                             f"{np.nanmax(share):g}; divide by the largest, or give a scale")
    if kind == "distance":
        return near + (far - near) * share
    return 1 / (1 / far + (1 / near - 1 / far) * share)


def _scaled(values: np.ndarray, kind: str, scale: float) -> np.ndarray:
    measured = np.where(np.isfinite(values) & (values > 0), values, np.nan)
    return measured * scale if kind == "distance" else scale / measured


def _positive(name: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise InputError(f"{name}: expected a finite number > 0, got {value}")
    return value
