"""Gaussians of a file whose values have no meaning: named, or left out and counted."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np

from lightfield_gs.base.errors import InputError

# For each field the properties that it comes from, and what is wrong where it is not finite
_REASONS = {
    "means": (("x", "y", "z", "motion_"), "a centre that is not finite"),
    "quaternions": (("rot_0", "rot_1", "rot_2", "rot_3", "omega_"), "a rotation that is not finite"),
    "scales": (("scale_0", "scale_1", "scale_2", "filter_3D"), "a scale that is no number or overflows"),
    "opacities": (("opacity", "trbf_"), "an opacity that is no number"),
    "sh": (("f_dc_", "red", "green", "blue", "f_rest_"), "a colour that is not finite"),
}
_ZERO_ROTATION = "a rotation of zeros"


def check_or_skip(
    path: Path, records: np.ndarray | None, fields: dict[str, np.ndarray], skip: bool
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The fields (after exp and sigmoid) of the Gaussians that all have a meaning, and a note on those left out.

    records: what the fields were read from, whose properties are named; None where these have no names. Raises
    InputError where some have no meaning and `skip` is not set, or none has one.
    """
    wrong = _wrong(fields)
    if not wrong:
        return fields, []
    bad = np.logical_or.reduce(list(wrong.values()))
    first, counts, seen = int(bad.argmax()), [], np.zeros(len(bad), bool)
    for reason, flags in wrong.items():  # each Gaussian for the first of its reasons
        if new := int((flags & ~seen).sum()):
            counts.append(f"{new} with {reason}")
        seen |= flags
    share = f"{int(bad.sum())} of {len(bad)} Gaussians have values without a meaning ({', '.join(counts)})"
    if not skip:
        raise InputError(
            f"{path}: {_named(None if records is None else records[first], first, fields)}; {share}; leave them out "
            "with --skip-invalid (Python: skip_invalid=True) or export the file again"
        )
    if bad.all():
        raise InputError(f"{path}: {share}, and nothing is left without them; export the file again")
    return {name: array[~bad] for name, array in fields.items()}, [f"{share} and were left out"]


def _wrong(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """For each reason that holds for any Gaussian, which ones it holds for, bool [N]."""
    wrong = {}
    for name, (_, reason) in _REASONS.items():
        good = np.isfinite(fields[name])
        if not good.all():
            wrong[reason] = ~good.reshape(len(good), -1).all(1)
    zero = cast(np.ndarray, ~fields["quaternions"].any(1))
    return {**wrong, _ZERO_ROTATION: zero} if zero.any() else wrong


def _named(record: np.void | None, index: int, fields: dict[str, np.ndarray]) -> str:
    """The first property of Gaussian `index` that has no meaning, and its value."""
    for field, (beginnings, reason) in _REASONS.items():
        if np.isfinite(fields[field][index]).all():
            continue
        if record is None:
            return f"Gaussian {index} has {reason}"
        for name in record.dtype.names or ():
            if name.startswith(beginnings) and (words := _without_meaning(name, float(record[name]))):
                return f"{name} of Gaussian {index} is {words}"
        return f"Gaussian {index} has {reason}"
    where = f"the rotation of Gaussian {index} is" if record is None else f"rot_0..rot_3 of Gaussian {index} are"
    return f"{where} all zero, which is no rotation"


def _without_meaning(name: str, value: float) -> str | None:
    """`value` in words where it has no meaning as this property."""
    with np.errstate(over="ignore"):
        if name.startswith("scale_"):
            result, after = np.exp(np.float32(value)), " after exp"
        else:
            result, after = np.float32(value), " in float32"
    if np.isfinite(result) or name == "opacity" and not np.isnan(value):
        return None
    return f"{value:g}, {result}{after}" if np.isfinite(value) else f"{value:g}"
