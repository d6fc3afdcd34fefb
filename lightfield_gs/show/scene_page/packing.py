"""Gaussians in few bytes, for a page: quantised, sorted along a curve through the scene, in planes that compress well.

The planes are one after the other, each of N bytes: centres (x, y, z; the lowest byte of all three, then the next),
scales, the number of a quaternion's largest component with the ninth bits of the other three, their lower eight,
opacity, colour, and further harmonics. Centres
are steps from the Gaussian before, with the sign in the lowest bit. Colours are green, red - green and blue - green.
files/unpack.js is the twin that reads them.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import asdict, dataclass

import numpy as np

from lightfield_gs.io.scenes.plausibility import typical_size

# Chosen on guitar.ply and the fitted scene of the demo, which docs/page.md also reports: finer ones cost more than they
# add to the picture
_CENTRE_STEP = 1 / 16  # of the typical Gaussian's size
_SCALE_STEP = 1 / 16  # of a logarithm
_THINNEST = 6.0  # logarithms of scales below that of the typical size: thinner ones look alike
_BYTE = 255
_ROTATION_STEPS, _ROTATION_ZERO = 255, 256  # of nine bits
_MOST_BITS = 24  # of a centre's coordinate
_CURVE_BITS = 21
_C0 = 0.28209479177387814  # of the harmonic of degree 0
_COLOURS = -0.5, 1.75  # that are kept, of degree 0
_HARMONICS = 2.0  # largest coefficient of further degrees that is kept


@dataclass(frozen=True)
class PackedGaussians:
    """Gaussians as a page has them.

    Attributes:
        count: N.
        degree: Of the harmonics, 0..3.
        low: Least coordinates of the centres, scene units.
        step: Of the centres, scene units.
        bytes_each: Of a coordinate of a centre, 1..4.
        least_scale: Logarithm of the scale 0.
        scale_step: Of logarithms of scales.
        colours: The colours that the bytes 0 and 255 stand for.
        harmonics: The largest coefficient of degree 1 and above.
        data: The planes, gzip.
    """

    count: int
    degree: int
    low: tuple[float, float, float]
    step: float
    bytes_each: int
    least_scale: float
    scale_step: float
    colours: tuple[float, float]
    harmonics: float
    data: bytes

    def header(self) -> dict[str, object]:
        """Return all but the data."""
        return {name: value for name, value in asdict(self).items() if name != "data"}


def pack(fields: dict[str, np.ndarray]) -> PackedGaussians:
    """Pack the five fields of N >= 1 valid Gaussians, float64."""
    means, logs = fields["means"], np.log(fields["scales"])
    low, extent = means.min(0), float(np.ptp(means, axis=0).max())
    size = typical_size(fields["scales"])
    step = max(size * _CENTRE_STEP if math.isfinite(size) else 0.0, extent / ((1 << _MOST_BITS) - 2), 1e-30)
    centres = np.round((means - low) / step).astype(np.int64)
    order = np.argsort(_curve(centres), kind="stable")
    steps = np.diff(centres[order], axis=0, prepend=0)
    folded = steps << 1 ^ steps >> 63
    bytes_each = max(1, -(-int(folded.max()).bit_length() // 8))
    least = max(float(logs.min()), math.log(size) - _THINNEST if math.isfinite(size) else -math.inf)
    scale_step = max((float(logs.max()) - least) / _BYTE, _SCALE_STEP)
    sh = fields["sh"][order]
    colours = 0.5 + _C0 * sh[:, 0]
    ends = max(float(colours.min()), _COLOURS[0]), min(float(colours.max()), _COLOURS[1])
    ends = (min(ends[0], 0.0), max(ends[1], 1.0))
    red, green, blue = _to_bytes((colours - ends[0]) / (ends[1] - ends[0]) * _BYTE).T
    rest = sh[:, 1:].reshape(len(sh), -1)
    most = min(float(np.abs(rest).max(initial=0)), _HARMONICS) or 1.0
    planes = [
        *((folded[:, axis] >> 8 * k & _BYTE).astype(np.uint8) for k in range(bytes_each) for axis in range(3)),
        *_to_bytes((logs[order] - least) / scale_step).T,
        *_rotation_planes(fields["quaternions"][order]),
        np.maximum(_to_bytes(fields["opacities"][order] * _BYTE), 1),
        *(green, red - green, blue - green),
        *_to_bytes(rest / most * 127 + 128).T,
    ]
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)  # no time or name in its header: the same bytes each time
    data = b"".join([*(packer.compress(np.ascontiguousarray(plane).tobytes()) for plane in planes), packer.flush()])
    degree = math.isqrt(sh.shape[1]) - 1
    low_x, low_y, low_z = low.tolist()
    return PackedGaussians(
        len(sh), degree, (low_x, low_y, low_z), step, bytes_each, least, scale_step, ends, most, data
    )


def unpack(packed: PackedGaussians) -> dict[str, np.ndarray]:
    """Return the five fields, float32, as a page unpacks them."""
    planes = np.frombuffer(zlib.decompress(packed.data, 31), np.uint8).reshape(-1, packed.count)
    take = iter(planes)
    parts = [[next(take).astype(np.int64) for _ in range(3)] for _ in range(packed.bytes_each)]
    folded = sum(np.stack(part, 1) << 8 * k for k, part in enumerate(parts))
    centres = np.cumsum(folded >> 1 ^ -(folded & 1), axis=0)
    scales = np.exp(packed.least_scale + packed.scale_step * np.stack([next(take) for _ in range(3)], 1))
    quaternions = _quaternions(next(take), np.stack([next(take) for _ in range(3)], 1))
    opacities = next(take) / _BYTE
    green, red, blue = (next(take) for _ in range(3))
    first, last = packed.colours
    colours = first + np.stack([red + green, green, blue + green], 1) * ((last - first) / _BYTE)
    rest = np.stack(list(take), 1) if packed.degree else np.empty((packed.count, 0), np.uint8)
    higher = (rest - 128.0) * (packed.harmonics / 127)
    sh = np.concatenate([((colours - 0.5) / _C0)[:, None], higher.reshape(packed.count, -1, 3)], 1)
    fields = {
        "means": np.array(packed.low) + centres * packed.step,
        "quaternions": quaternions,
        "scales": scales,
        "opacities": opacities,
        "sh": sh,
    }
    return {name: value.astype(np.float32) for name, value in fields.items()}


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.round(values), 0, _BYTE).astype(np.uint8)


def _curve(centres: np.ndarray) -> np.ndarray:
    """Return places on a Morton curve of whole coordinates [N, 3] >= 0."""
    bits = int(centres.max()).bit_length()
    coordinates = (centres >> max(bits - _CURVE_BITS, 0)).astype(np.uint64)
    places = np.zeros(len(centres), np.uint64)
    for bit in range(min(bits, _CURVE_BITS)):
        for axis in range(3):
            places |= (coordinates[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return places


def _rotation_planes(quaternions: np.ndarray) -> list[np.ndarray]:
    """Return the numbers of the largest components with the ninth bits of the others, and their lower eight."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    largest = np.abs(unit).argmax(1)
    unit = np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -unit, unit)
    three = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    steps = np.round(three * (_ROTATION_STEPS * math.sqrt(2))).astype(np.int64) + _ROTATION_ZERO
    return [(largest | ((steps >> 8) << np.arange(2, 5)).sum(1)).astype(np.uint8), *(steps & _BYTE).astype(np.uint8).T]


def _quaternions(first: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Return quaternions [N, 4] of what _rotation_planes made of them."""
    largest, high = first & 3, first[:, None].astype(np.int64) >> np.arange(2, 5) & 1
    others = (low + (high << 8) - _ROTATION_ZERO) / (_ROTATION_STEPS * math.sqrt(2))
    out = np.empty((len(low), 4))
    out[np.arange(4) != largest[:, None]] = others.reshape(-1)
    out[np.arange(len(out)), largest] = np.sqrt(np.maximum(0.0, 1 - (others**2).sum(1)))
    return out
