"""Checks of the data in a file of Gaussians: promised sizes, values without a meaning, and suspicious numbers.

Compressed data are unpacked no further than a file of that size can need, so that no bomb fills the memory. Gaussians
without a meaning are named, or left out and counted. Scenes fitted to photographs never have the suspicious numbers of
these notes, since nobody reads notes that are often wrong.
"""

from __future__ import annotations

import importlib
import math
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from lightfield_gs.base.errors import InputError

MIN_LIMIT_BYTES = 1 << 24  # unpacked from a file of any size: some hundred thousand Gaussians
MAX_RATIO = 64  # scenes shrink by 1.2 to 10; only blank ones by more
_GZIP = 31  # zlib's number for a gzip header and the largest window
# For each field the properties that it is made of, and the error where it is not finite
_REASONS = {
    "means": (("x", "y", "z", "motion_"), "a centre that is not finite"),
    "quaternions": (("rot_0", "rot_1", "rot_2", "rot_3", "omega_"), "a rotation that is not finite"),
    "scales": (("scale_0", "scale_1", "scale_2", "filter_3D"), "a scale that is no number or overflows"),
    "opacities": (("opacity", "trbf_"), "an opacity that is no number"),
    "sh": (("f_dc_", "red", "green", "blue", "f_rest_"), "a colour that is not finite"),
}
_ZERO_ROTATION = "a rotation of zeros"
_LEAST_COUNT = 20  # Gaussians: fewer say nothing about how they were made
_SAMPLE = 4096  # Gaussians of a median
_LARGE = 0.1  # of the scene's extent; no typical Gaussian is as large
_NEAR_ONE = 0.1  # median log scale; with none below 0, half of the Gaussians are between 1 and 1.1 scene units
_LARGEST_LOGIT = 20  # the sigmoid is 1 in float32 from 17.4 on
_NO_SIZE = 1e-37  # scene units; smaller Gaussians are points, whose log scale is -inf
# Properties of motion, also of a kind that is not known here
_OTHER = re.compile(r"(t|t_scale|scale_t|scaling_t|trbf_\w+|motion_\w+|omega_\w+|rot_r_\d|rotation_r_\d|velocity_\w+)")
_DEFORMED_BY = ("deformation.pth", "deformation_table.pth", "deform.pth")  # of 4D Gaussians and their descendants
_STEP = 0.5  # of the typical Gaussian's size; coarser steps of centres tear surfaces


def check_unpacked_size(path: Path, promised_bytes: int, stored_bytes: int) -> None:
    """Raise InputError if the stored bytes cannot hold the stated data, before memory is allocated for the data."""
    if promised_bytes > max(MIN_LIMIT_BYTES, MAX_RATIO * stored_bytes):
        raise InputError(
            f"{path}: {promised_bytes} bytes are promised by {stored_bytes} compressed ones, more than "
            f"{MAX_RATIO} to one; it is cut, or its counts are wrong"
        )


def gunzip(path: Path, data: bytes, most_bytes: int) -> bytes:
    """Unpack at most the first `most_bytes` of gzip data; raise InputError for broken data."""
    try:
        return zlib.decompressobj(_GZIP).decompress(data, most_bytes)
    except zlib.error as error:
        raise InputError(f"{path}: its gzip data are broken ({error}); download or export it again") from None


def import_zstd() -> Any:
    """Import Python's module for zstd (3.14), or its backport; raise InputError without either."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise InputError(
        "files of SPZ version 4 are compressed by zstd, which this Python lacks; pip install 'lightfield-gs[spz]', or "
        "export the file as SPZ version 3 or .ply"
    )


def unzstd(path: Path, data: bytes, size_bytes: int) -> bytes:
    """Unpack zstd data of exactly `size_bytes`; raise InputError for broken data and for other sizes."""
    zstd = import_zstd()
    try:
        unpacked = zstd.ZstdDecompressor().decompress(data, size_bytes + 1)
    except (zstd.ZstdError, EOFError, ValueError, MemoryError) as error:
        words = " ".join(str(error).split())[:100]
        raise InputError(f"{path}: its zstd data are broken ({words}); download or export it again") from None
    if len(unpacked) != size_bytes:
        raise InputError(
            f"{path}: a stream holds {'more' if len(unpacked) > size_bytes else len(unpacked)} bytes where "
            f"{size_bytes} were expected; it is cut or its header is wrong"
        )
    return unpacked


def check_or_skip(
    path: Path, records: np.ndarray | None, fields: dict[str, np.ndarray], skip: bool
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Check that all values of Gaussians have a meaning, or leave out Gaussians without.

    Args:
        path: the file, for messages.
        records: the file's rows, whose properties the error names; None for formats without names.
        fields: the five fields, after exp and sigmoid.
        skip: leave out Gaussians with values that have no meaning.

    Returns:
        The fields, and a note on Gaussians that were left out.

    Raises:
        InputError: a value has no meaning, without `skip`; or no Gaussian is left.
    """
    wrong = _find_invalid(fields)
    if not wrong:
        return fields, []
    bad = np.logical_or.reduce(list(wrong.values()))
    first, counts, seen = int(bad.argmax()), [], np.zeros(len(bad), bool)
    for reason, flags in wrong.items():  # each Gaussian for the first of its reasons
        if new := int((flags & ~seen).sum()):
            counts.append(f"{new} with {reason}")
        seen |= flags
    summary = f"{int(bad.sum())} of {len(bad)} Gaussians have values without a meaning ({', '.join(counts)})"
    if not skip:
        named = _first_invalid(None if records is None else records[first], first, fields)
        raise InputError(f"{path}: {named}; {summary}; leave them out with skip_invalid=True or export the file again")
    if bad.all():
        raise InputError(f"{path}: {summary}, and nothing is left without them; export the file again")
    return {name: array[~bad] for name, array in fields.items()}, [f"{summary} and were left out"]


def _find_invalid(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return for each reason that holds for any Gaussian a mask [N] of these Gaussians."""
    wrong = {}
    for name, (_, reason) in _REASONS.items():
        good = np.isfinite(fields[name])
        if not good.all():
            wrong[reason] = ~good.reshape(len(good), -1).all(1)
    zero = cast(np.ndarray, ~fields["quaternions"].any(1))
    return {**wrong, _ZERO_ROTATION: zero} if zero.any() else wrong


def _first_invalid(record: np.void | None, index: int, fields: dict[str, np.ndarray]) -> str:
    """Describe the first property of Gaussian `index` that has no meaning, and its value."""
    for field, (beginnings, reason) in _REASONS.items():
        if np.isfinite(fields[field][index]).all():
            continue
        if record is None:
            return f"Gaussian {index} has {reason}"
        for name in record.dtype.names or ():
            if name.startswith(beginnings) and (words := _describe_invalid(name, float(record[name]))):
                return f"{name} of Gaussian {index} is {words}"
        return f"Gaussian {index} has {reason}"
    where = f"the rotation of Gaussian {index} is" if record is None else f"rot_0..rot_3 of Gaussian {index} are"
    return f"{where} all zero, which is no rotation"


def _describe_invalid(name: str, value: float) -> str | None:
    """Describe a value that has no meaning as this property; return None for others."""
    with np.errstate(over="ignore"):
        if name.startswith("scale_"):
            result, after = np.exp(np.float32(value)), " after exp"
        else:
            result, after = np.float32(value), " in float32"
    if np.isfinite(result) or name == "opacity" and not np.isnan(value):
        return None
    return f"{value:g}, {result}{after}" if np.isfinite(value) else f"{value:g}"


def sample_median(values: np.ndarray) -> np.ndarray | None:
    """Return the medians of the columns of values [N, C], from a sample of the rows; None if none is finite."""
    sample = values[:: max(1, len(values) // _SAMPLE)]
    sample = sample[np.isfinite(sample).all(1)]
    return np.median(sample, 0) if len(sample) else None


def typical_size(scales: np.ndarray) -> float:
    """Return the median of the middle standard deviations of scales [N, 3]; infinity for points.

    Next to points any Gaussian would count as large.
    """
    size = _median_of_medians(np.sort(scales[:: max(1, len(scales) // _SAMPLE)], 1)[:, 1:2])
    return size if size > _NO_SIZE else math.inf


def float32_step(coordinates: np.ndarray) -> float:
    """Return the largest distance from one of these numbers to the next float32."""
    return float(np.spacing(np.abs(coordinates).astype(np.float32)).max())


def unknown_motion_notes(path: Path, names: Sequence[str], moves: bool) -> list[str]:
    """Return a note where properties, or a network beside the file, indicate a motion that is not known here.

    Args:
        path: the file.
        names: its properties.
        moves: whether they are of a known motion, see ply_extensions.py.
    """
    beside = [name for name in _DEFORMED_BY if (path.parent / name).is_file()]
    if path.parent.parent.name == "point_cloud":  # Deformable 3D Gaussians keep it in a separate folder
        beside += [found.name for found in path.parents[2].glob("deform/iteration_*/deform.pth")]
    if beside:
        return [f"{beside[0]} beside it moves its Gaussians: they are drawn as they are stored, without that network"]
    found = [name for name in names if _OTHER.fullmatch(name)]
    if not found or moves:
        return []
    return [
        f"the properties {', '.join(found[:4])}{', ...' if len(found) > 4 else ''} speak of motion, and such motion is "
        "not known here: the Gaussians are drawn as they are stored, of all times at once"
    ]


def value_notes(log_scales: np.ndarray, logits: np.ndarray | None, means: np.ndarray) -> list[str]:
    """Return notes on stored numbers that look like values instead of their logarithms or logits.

    Args:
        log_scales: [N, 3] as stored.
        logits: [N] as stored; None for files without.
        means: [N, 3].
    """
    if len(means) < _LEAST_COUNT:
        return []
    notes = []
    size, extent = _median_of_medians(log_scales), _extent(means)
    if (
        np.nanmin(log_scales) >= 0
        and 0 < size < extent
        and (size < _NEAR_ONE or size > np.log(max(_LARGE * extent, 1)))
    ):
        notes.append(
            f"no scale is below 0 (median {size:.3g}), which as logarithms makes every Gaussian larger than "
            f"one unit, in a scene of {extent:.3g}: they look like standard deviations themselves; export the "
            "file with their logarithms"
        )
    if logits is None:
        return notes
    low, high = np.nanmin(logits), np.nanmax(logits)
    if low >= 0 and _LARGEST_LOGIT < high <= 255 and (logits % 1 == 0).all():
        notes.append(
            f"all opacities are whole numbers within {low:.3g}..{high:.3g}, which as logits makes no Gaussian fainter "
            "than 0.5: they look like opacities of 0..255; export the file with their logits"
        )
    if low >= 0 and 0 < high <= 1:
        notes.append(
            f"all opacities are within {low:.3g}..{high:.3g}, which as logits makes no Gaussian fainter than "
            "0.5 or more opaque than 0.73: they look like opacities themselves; export the file with their "
            "logits"
        )
    return notes


def _median_of_medians(values: np.ndarray) -> float:
    """Return the median of the columns' medians, 0 where no row is finite."""
    medians = sample_median(values)
    return 0.0 if medians is None else float(np.median(medians))


def _extent(means: np.ndarray) -> float:
    """Return the diagonal of the box of centres [N, 3], without the outer twentieth on each side."""
    sample = means[:: max(1, len(means) // _SAMPLE)]
    sample = sample[np.isfinite(sample).all(1)]
    low, high = np.percentile(sample, (5, 95), 0) if len(sample) else np.zeros((2, 3))
    return float(np.linalg.norm(high - low))


def step_notes(records: np.ndarray, scales: np.ndarray) -> list[str]:
    """Return a note where float32 rounded the centres to steps that are not small beside the Gaussians."""
    sample = np.stack([records[name][:: max(1, len(records) // _SAMPLE)] for name in "xyz"], 1)
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.array_equal(sample, sample.astype(np.float32), equal_nan=True):
            return []  # more digits than float32 has
        size, far = typical_size(scales), sample_median(np.abs(sample).astype(np.float32))
        if len(records) < _LEAST_COUNT or far is None or float32_step(far) <= _STEP * size:
            return []
    return [
        f"coordinates near {far.max():.0f} are rounded to steps of {float32_step(far):.3g} (float32), and the usual "
        f"Gaussian's standard deviation is {size:.3g}: the scene is torn; export it with an offset taken off, or "
        "with x, y, z as double"
    ]
