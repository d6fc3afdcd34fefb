"""The numbers of depth maps, as files hold them: whole numbers or floats, whatever they mean."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_info, read_layer, read_picture
from lightfield_gs.io.npy import open_array, stored_arrays

_IMAGE_TYPES = ("uint8", "uint16", "half", "float")  # others would be read as shares of their largest number
_ALMOST_GREY = 0.04  # how far the channels of a grey map come apart when it is saved as JPEG, as a share of its range
# Names in .npz files; the first of each is Depth Pro's
_DEPTH_KEYS, _DISPARITY_KEYS = (
    ("depth", "depth_map", "z", "depths", "predicted_depth"),
    ("disparity", "disp", "inverse_depth"),
)
_IS_DEPTH = re.compile(r"depth|distance|^zbuffer$")  # in the name of a channel or of its layer
_FOCAL_KEYS = ("focallength_px", "focal_length_px", "focal_px")


@dataclass
class DepthNumbers:
    """The numbers of a depth map as its file holds them.

    values: [H, W], integers or floats. orientation: the Exif orientation that was undone. kind: "distance" or
    "disparity", and focal_px: the focal length in pixels; None where the file does not say it. is_along_ray: whether
    they are, or are made of, distances along the pixels' rays. description: which part of the file they are, in words,
    where it has several; notes: what may not be as it was meant.
    """

    values: np.ndarray
    orientation: int = 1
    kind: str | None = None
    focal_px: float | None = None
    is_along_ray: bool = False
    description: str = ""
    notes: list[str] = field(default_factory=list)


def read_numbers(path: str | Path) -> DepthNumbers:
    """The numbers of a depth map, whatever they mean. Raises InputError that names the file."""
    suffix = Path(path).suffix.lower()
    if suffix == ".npz":
        return _from_npz(path)
    if suffix == ".npy":
        return DepthNumbers(_checked(path, open_array(path)))
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
    """Which channel of an EXR with several holds distances, by their names; None where none does.

    Those are Z, depth.Z, ViewLayer.Depth.Z and the like, or the Z or V alone in its layer: not the Z of a normal or a
    position, the V of texture coordinates, or a mist.
    """
    if len(names) < 2:
        return None
    layers: dict[str, list[str]] = {}
    for name in names:
        layer, _, part = name.rpartition(".")
        layers.setdefault(layer.lower(), []).append(part.lower())
    ranks = []
    for index, name in enumerate(names):
        layer, _, part = (text.lower() for text in name.rpartition("."))
        beside = layers[layer]
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
    raise InputError(f"{path} is in colour; expected a grey depth map, one number a pixel, without a colour map")


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
    flat = {name.lower(): name for name, array in arrays.items() if _is_map(array.shape) and array.dtype.kind in "iuf"}
    named = [flat[name] for name in (*_DEPTH_KEYS, *_DISPARITY_KEYS) if name in flat]
    if not named and len(flat) != 1:
        raise InputError(
            f"{path}: expected a depth map [H, W] named {_DEPTH_KEYS[0]}, or one array alone; it holds "
            f"{ascii(', '.join(arrays))[1:-1][:200] or 'nothing'}; save the map as .npy"
        )
    name = (named or [*flat.values()])[0]
    focal = [
        float(arrays[key].read().ravel()[0])
        for key in _FOCAL_KEYS
        if key in arrays and math.prod(arrays[key].shape) == 1
    ]
    if focal and not 0 < focal[0] < np.inf:
        raise InputError(f"{path}: expected a focal length > 0 px, got {focal[0]:g}")
    return DepthNumbers(
        _checked(path, arrays[name].read()),
        kind="disparity" if name.lower() in _DISPARITY_KEYS else "distance" if named else None,
        focal_px=focal[0] if focal else None,
        description=f"array {ascii(name)[1:-1][:80]}" if len(arrays) > len(focal) + 1 else "",
    )


def _is_map(shape: tuple[int, ...]) -> bool:
    """Whether an array is [H, W] but for axes of length 1, as [1, H, W] of a network or [H, W, 1] of an image."""
    return len(shape) == 2 or len(shape) > 2 and sum(size != 1 for size in shape) == 2


def _checked(path: str | Path, values: np.ndarray) -> np.ndarray:
    if not _is_map(values.shape) or values.size == 0 or values.dtype.kind not in "iuf":
        raise InputError(f"{path}: expected numbers [H, W], got {values.dtype} {list(values.shape)}")
    return np.asarray(values if values.ndim == 2 else values.squeeze())
