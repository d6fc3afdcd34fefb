"""Depth maps: the numbers in their files, and their meaning as view-space z."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_INVALID, DEPTH_KINDS, DepthInvalid, DepthKind
from lightfield_gs.io.images import read_info, read_layer, read_picture
from lightfield_gs.io.npy import open_array, stored_arrays

_IMAGE_TYPES = ("uint8", "uint16", "half", "float")  # others would be read as fractions of their largest number


@dataclass(frozen=True)
class DepthMapConstants:
    """Tolerances of depth maps.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    almost_grey: float = 0.04  # largest difference of the channels of a grey map, by its range, for example after JPEG
    # numbers that programs store for the sky: the largest half float, the largest 16-bit number, and its thousandth
    stored_sky: tuple[int, int, float] = (65504, 65535, 65.535)
    sky: float = 1e9  # distance from which on everything is sky: Blender stores 1e10
    well_above: float = 1.25  # ratio of the sky to the largest other number, at least
    alone: int = 1000  # ratio of any other number to the next largest from which on it is the sky
    unmeasured: float = -1  # with limits, numbers up to it mark unmeasured pixels, as -9999 does
    # distance of infinitely far things by the farthest measured one: cameras beside see hardly any parallax there
    far_ratio: int = 2


_C = DepthMapConstants()

# Names in .npz files; the first of each is Depth Pro's
_DEPTH_KEYS = ("depth", "depth_map", "z", "depths", "predicted_depth")
_DISPARITY_KEYS = ("disparity", "disp", "inverse_depth")
_IS_DEPTH = re.compile(r"depth|distance|^zbuffer$")  # in the name of a channel or of its layer
_FOCAL_KEYS = ("focallength_px", "focal_length_px", "focal_px")


@dataclass
class DepthNumbers:
    """The numbers of a depth map as its file holds them.

    Attributes:
        values: [H, W], integers or floats.
        orientation: The Exif orientation that was undone.
        kind: "distance" or "disparity"; None where the file does not state it.
        focal_px: The focal length in pixels; None where the file does not state it.
        is_along_ray: Whether they are, or derive from, distances along the pixels' rays.
        description: The part of the file that they come from, where it has several.
        notes: Doubts about the numbers.
    """

    values: np.ndarray
    orientation: int = 1
    kind: str | None = None
    focal_px: float | None = None
    is_along_ray: bool = False
    description: str = ""
    notes: list[str] = field(default_factory=list)


def read_numbers(path: str | Path) -> DepthNumbers:
    """Read the numbers of a depth map, whatever their meaning.

    Raises:
        InputError: The file cannot be read; the message names it.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".npz":
        return _read_npz(path)
    if suffix == ".npy":
        return DepthNumbers(_check_numbers(path, open_array(path)))
    if (layer := read_layer(path, depth_channel)) is not None:
        return DepthNumbers(layer.pixels, kind="distance", description=f"channel {layer.name}")
    info = read_info(path)
    if info.sample_type not in _IMAGE_TYPES:
        raise InputError(
            f"{path}: expected a depth map of {', '.join(_IMAGE_TYPES)}, got {info.sample_type}; save it as .npy"
        )
    picture = read_picture(path)
    return grey_numbers(path, picture.pixels, picture.orientation)


def depth_channel(names: Sequence[str]) -> int | None:
    """Return the index of the channel with distances in an EXR with several, by their names; None without one.

    Such are Z, depth.Z, ViewLayer.Depth.Z and the like, or a Z or V alone in its layer. The Z of a normal or a
    position, the V of texture coordinates, and a mist are not.
    """
    if len(names) < 2:
        return None
    parts = [name.lower().rpartition(".")[::2] for name in names]
    ranks = []
    for index, (layer, part) in enumerate(parts):
        beside = [other for place, other in parts if place == layer]
        if _IS_DEPTH.search(part) or part == "z" and not {"x", "y"} & {*beside}:
            rank = 2 if "mist" in layer else 0 if layer == "" or _IS_DEPTH.search(layer) else 1
        elif _IS_DEPTH.search(layer.rpartition(".")[2]) and (part in ("v", "r", "y") or len(beside) == 1):
            rank = 0
        else:
            rank = 1 if part == "v" and (len(beside) == 1 or layer == "" and "u" not in beside) else 2
        ranks.append((rank, index))
    rank, index = min(ranks)
    return index if rank < 2 else None


def grey_numbers(path: str | Path, pixels: np.ndarray, orientation: int = 1) -> DepthNumbers:
    """Return the numbers of an image [H, W, C] that is grey, or almost.

    Raises:
        InputError: The image has colours.
    """
    if pixels.shape[2] < 3:  # grey, or grey and alpha
        return DepthNumbers(pixels[..., 0], orientation)
    apart = {pair: channels_apart(pixels, *pair) for pair in ((0, 1), (0, 2), (1, 2))}
    most = max(apart.values())
    if most == 0:
        return DepthNumbers(pixels[..., 0], orientation)
    if most <= _C.almost_grey:
        note = f"is almost grey: its channels differ by up to {most:.1%} of its range, and the middle one is taken"
        return DepthNumbers(np.median(pixels[..., :3], 2).astype(pixels.dtype), orientation, notes=[note])
    for (one, other), difference in apart.items():
        third = pixels[..., 3 - one - other]
        if difference <= _C.almost_grey and (third == third[0, 0]).all():
            note = (
                f"is no grey image, but channels {one + 1} and {other + 1} are alike and the third says nothing: the "
                "former is taken"
            )
            return DepthNumbers(pixels[..., one], orientation, notes=[note])
    raise InputError(f"{path} is in colour; expected a grey depth map, one number a pixel, without a colour map")


def channels_apart(pixels: np.ndarray, one: int, other: int) -> float:
    """Return the largest difference between two channels of pixels [H, W, C], by the range of both.

    It is infinite where one value is finite and the other is not.
    """
    both = pixels[..., [one, other]].astype(np.float32)
    finite = np.isfinite(both)
    if not np.array_equal(both[..., 0][~finite.all(2)], both[..., 1][~finite.all(2)], equal_nan=True):
        return np.inf
    values = both[finite.all(2)]
    if not len(values):
        return 0.0
    return float(np.abs(values[:, 0] - values[:, 1]).max()) / (float(np.ptp(values)) or 1.0)


def _read_npz(path: str | Path) -> DepthNumbers:
    """Return the depth map in a .npz, by its name or because it is the only array [H, W], and its focal length."""
    arrays = stored_arrays(path)
    flat = {
        name.lower(): name for name, array in arrays.items() if _is_depth_map(array.shape) and array.dtype.kind in "iuf"
    }
    named = [flat[name] for name in (*_DEPTH_KEYS, *_DISPARITY_KEYS) if name in flat]
    if not named and len(flat) != 1:
        raise InputError(
            f"{path}: expected a depth map [H, W] named {_DEPTH_KEYS[0]}, or one array alone; it holds "
            f"{ascii(', '.join(arrays))[1:-1][:200] or 'nothing'}; save the map as .npy"
        )
    name = (named or [*flat.values()])[0]
    single = [arrays[key] for key in _FOCAL_KEYS if key in arrays and math.prod(arrays[key].shape) == 1]
    focal = [float(array.read().ravel()[0]) for array in single]
    if focal and not 0 < focal[0] < np.inf:
        raise InputError(f"{path}: expected a focal length > 0 px, got {focal[0]:g}")
    return DepthNumbers(
        _check_numbers(path, arrays[name].read()),
        kind="disparity" if name.lower() in _DISPARITY_KEYS else "distance" if named else None,
        focal_px=focal[0] if focal else None,
        description=f"array {ascii(name)[1:-1][:80]}" if len(arrays) > len(focal) + 1 else "",
    )


def _is_depth_map(shape: tuple[int, ...]) -> bool:
    """Return whether an array is [H, W] apart from axes of length 1, like [1, H, W] of a network."""
    return len(shape) == 2 or len(shape) > 2 and sum(size != 1 for size in shape) == 2


def _check_numbers(path: str | Path, values: np.ndarray) -> np.ndarray:
    if not _is_depth_map(values.shape) or values.size == 0 or values.dtype.kind not in "iuf":
        raise InputError(f"{path}: expected numbers [H, W], got {values.dtype} {list(values.shape)}")
    return np.asarray(values if values.ndim == 2 else values.squeeze())


FARTHEST = 1e12  # scene units: farther values count as not measured


@dataclass
class DepthMap:
    """A depth map.

    Attributes:
        z: View-space z, float32 [H, W], scene units, NaN where nothing was measured.
        focal_px: The focal length in pixels by its file, or None.
        description: The decisions that were made.
        notes: Doubts about them.
    """

    z: np.ndarray
    focal_px: float | None
    description: str
    notes: list[str]


def far_distance(farthest: float) -> float:
    """Return the distance of infinitely far things, by that of the farthest other one."""
    return min(_C.far_ratio * farthest, FARTHEST)


def read_depth(
    path: str | Path,
    kind: DepthKind = "distance",
    *,
    scale: float | None = None,
    limits: tuple[float, float] | None = None,
    invalid: DepthInvalid = "far",
    rays: Callable[[tuple[int, int]], np.ndarray] | None = None,
) -> np.ndarray:
    """Read view-space z [H, W] of each pixel, float32, scene units; NaN where the file holds no measurement.

    Args:
        path: A grey image (PNG of 8 or 16 bits, EXR, TIFF), an EXR with a depth channel, a .npy [H, W] or a .npz. Axes
            of length 1 are dropped.
        kind: The meaning of the numbers v: "distance", v = z / scale; "ray", the same along the pixel's ray; or
            "disparity" (inverse distance), v = scale / z. NaN, negative numbers, the distance 0 and infinite
            disparities are no measurement.
        scale: 0.001 for millimetres to metres; for disparities in pixels focal length times baseline. None: 1, for
            floats.
        limits: (near, far) in place of a scale. z, or with "disparity" 1/z, runs linearly between them over the file's
            full scale: 0..255, 0..65535, or 0..1 for floats. Distance has near at 0, disparity far at 0. (far, near)
            reverses the scale.
        invalid: The meaning of infinite distances, of numbers for the sky (1e10, 65504, 65535) and of the disparity 0:
            "far" or "hole". A "far" pixel is at twice the largest measured distance, or with limits at the far limit; a
            "hole" is not measured.
        rays: For kind "ray", a function such as `ray_lengths`: the lengths [H, W] of rays up to z = 1, by a map's
            height and width.

    Raises:
        InputError: No depth map, numbers out of range, or whole numbers without a scale; the message names the file.
    """
    return depth_map(path, read_numbers(path), kind, scale=scale, limits=limits, invalid=invalid, rays=rays).z


def depth_map(
    path: str | Path,
    numbers: DepthNumbers,
    kind: str | None = None,
    *,
    scale: float | None = None,
    limits: tuple[float, float] | None = None,
    invalid: str = "far",
    turn: Callable[[DepthNumbers], tuple[np.ndarray, bool]] | None = None,
    rays: Callable[[tuple[int, int]], np.ndarray] | None = None,
) -> DepthMap:
    """Return the depth map of numbers that were read from `path`.

    Args:
        path: For messages.
        numbers: As read_numbers returns them.
        kind: See read_depth; None: as the file states, else "distance".
        scale: See read_depth.
        limits: See read_depth.
        invalid: See read_depth.
        turn: A function that returns the numbers as upright as the photo is, and whether it turned them.
        rays: See read_depth.

    Raises:
        InputError: As read_depth.
    """
    given, kind = kind or numbers.kind, kind or numbers.kind or "distance"
    for name, word, choices in (("depth kind", kind, DEPTH_KINDS), ("invalid depths", invalid, DEPTH_INVALID)):
        if word not in choices:
            raise InputError(f"{name}: expected {' or '.join(choices)}, got {word!r}")
    if scale is not None and limits is not None:
        raise InputError("a depth map has a scale, or near and far limits, not both; leave out one of them")
    if kind == "ray" and rays is None:
        raise InputError("depth kind: ray needs the camera; give the lengths of its rays, or z in place of distances")
    values, turned = (numbers.values, False) if turn is None else turn(numbers)
    sky, stored = _sky(values) if kind != "disparity" and (limits is None or values.dtype.kind == "f") else (None, "")
    if limits is not None:
        z = _scale_between(path, values, sky, kind, *limits, invalid)
    else:
        z = _scale(path, values, sky, kind, scale)
    if rays is not None and (kind == "ray" or numbers.is_along_ray):
        z = z / rays((z.shape[0], z.shape[1]))
    measured = np.isfinite(z)
    if not measured.any():
        raise InputError(f"{path}: expected distances or disparities > 0, there is none")
    means = {"distance": "distance as z", "ray": "distance along the ray as z", "disparity": "disparity turned into z"}
    description = f"{means[kind]} {z[measured].min():.4g}..{z[measured].max():.4g}"
    if limits is not None and _is_reversed(limits):
        description += f", {nearness(kind, limits)}"
    elif given is None:
        description += f", {nearness(kind, limits)} (assumed; depth_kind=)"
    description += ", turned with the photo" if turned else ""
    if (far := np.isposinf(z)).any():
        beyond = far_distance(z[measured].max()) if limits is None else max(limits)
        z[far] = beyond if invalid == "far" else np.nan
        words = [stored, f"put at {beyond:.4g}" if invalid == "far" else "left out"]
        description += f", {far.mean():.1%} {'sky' if stored else 'infinitely far'} ({', '.join(filter(None, words))})"
    if (holes := ~(measured | far)).any():
        description += f", {holes.mean():.1%} not measured"
    with np.errstate(over="ignore"):
        z = z.astype(np.float32)
    description = f"{numbers.description}: {description}" if numbers.description else description
    return DepthMap(z, numbers.focal_px, description, [f"{path} {words}" for words in numbers.notes])


def nearness(kind: str, limits: tuple[float, float] | None = None) -> str:
    """Return which numbers of a map are near, in words; limits: in their given order."""
    disparity = kind == "disparity"
    if limits is None:
        return f"{'large' if disparity else 'small'} numbers are near"
    return f"{'bright' if disparity != _is_reversed(limits) else 'dark'} is near"


def ray_lengths(
    shape: tuple[int, int], size: tuple[int, int], focal_px: tuple[float, float], centre_px: tuple[float, float]
) -> np.ndarray:
    """Return the length of the ray through the middle of each pixel of a map up to z = 1, float64 [h, w].

    Args:
        shape: Height and width of the map.
        size: Height and width of its photo, which may differ.
        focal_px: Focal lengths (x, y), pixels of the photo.
        centre_px: Principal point (x, y), pixels of the photo.
    """
    (height, width), (rows, columns) = size, shape
    x = ((np.arange(columns) + 0.5) * width / columns - centre_px[0]) / focal_px[0]
    y = ((np.arange(rows) + 0.5) * height / rows - centre_px[1]) / focal_px[1]
    return np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)


def _sky(values: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Return the distances [H, W] that stand for the sky, and their number in words; None without any."""
    values = values.astype(np.float32) if values.dtype == np.float16 else values
    there = np.isfinite(values) & (values > 0)
    sky = np.zeros_like(there)
    if values.dtype.kind == "f":
        stored = np.logical_or.reduce([np.abs(values - number) <= 1e-6 * number for number in _C.stored_sky])
    else:
        stored = np.isin(values, [*_C.stored_sky, np.iinfo(values.dtype).max]) & (values.dtype.itemsize > 1)
    for candidates, times in ((values >= _C.sky, _C.well_above), (stored, _C.well_above), (None, _C.alone)):
        left = there & ~sky
        found = left & (values == values.max(initial=0, where=left) if candidates is None else candidates)
        rest = values[left & ~found]
        if found.any() and rest.size and float(rest.max()) * times <= float(values[found].min()):
            sky |= found
    return (sky, f"{values[sky].max():.7g} in the file") if sky.any() else (None, "")


def _is_reversed(limits: tuple[float, float]) -> bool:
    return limits[0] > limits[1]


def _scale_between(
    path: str | Path, values: np.ndarray, sky: np.ndarray | None, kind: str, first: float, second: float, invalid: str
) -> np.ndarray:
    """Return z [H, W] of numbers whose full scale runs from near to far; see read_depth."""
    first, second = _positive("depth range: near", first), _positive("depth range: far", second)
    if first == second:
        raise InputError(f"depth range: expected near < far (or far first, where the map is so), got {first:g} twice")
    near, far = sorted((first, second))
    if values.dtype.kind in "iu":
        if values.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{path}: near and far are for uint8, uint16 or floats in 0..1, got {values.dtype}")
        fraction = values / np.iinfo(values.dtype).max
    else:
        fraction = np.where(np.isfinite(values) & (values > _C.unmeasured), values, np.nan).astype(np.float64)
        if sky is not None:
            fraction[sky] = np.nan
        if (fraction < 0).any() or (fraction > 1).any():
            raise InputError(
                f"{path}: with near and far expected floats in 0..1, got {np.nanmin(fraction):g}.."
                f"{np.nanmax(fraction):g}; divide by the largest, or give a scale"
            )
    if _is_reversed((first, second)):
        fraction = 1 - fraction
    if kind == "disparity":
        z = 1 / (1 / far + (1 / near - 1 / far) * fraction)
        return np.where(fraction == 0, np.inf, z) if invalid == "hole" else z
    beyond = np.isposinf(values) if sky is None else np.isposinf(values) | sky
    return np.where(beyond, np.inf, near + (far - near) * fraction)


def _scale(path: str | Path, values: np.ndarray, sky: np.ndarray | None, kind: str, scale: float | None) -> np.ndarray:
    """Return z [H, W]: infinite where it is far away, NaN where nothing was measured."""
    if scale is None and values.dtype.kind in "iu":
        raise InputError(
            f"{path} holds whole numbers; say what they mean: near and far (depth_range=NEAR,FAR, with "
            "depth_kind=disparity where bright is near), or the length of one (depth_scale=, 0.001 for "
            "millimetres to metres)"
        )
    scale, values = 1.0 if scale is None else _positive("depth scale", scale), values.astype(np.float64)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        if kind == "disparity":
            return np.where((values >= 0) & np.isfinite(values), scale / values, np.nan)
        z = np.where(values > 0, values * scale, np.nan)
    return z if sky is None else np.where(sky, np.inf, z)


def _positive(name: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise InputError(f"{name}: expected a finite number > 0, got {value}")
    return value
