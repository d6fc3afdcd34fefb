"""Checks of what users give, and how it is shown to them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import MISSING, field, fields
from numbers import Real
from typing import Any

from lightfield_gs.base.errors import InputError

_OF_ONE = {"are": "is", "have": "has", "were": "was", "their": "its"}  # words of several, of one
_KIND_NAMES = {"NoneType": "none", "Tensor": "torch.Tensor"}


def shown(value: object) -> str:
    """Return a value of any kind as text for a message: one line, 80 characters at most."""
    return "none" if value is None else " ".join(repr(value).split())[:80]


def counted(count: int, what: str = "item", of: int | None = None, does: str = "") -> str:
    """Return a count in words: "1 item", "2 items", "1 of 7 frames has no pose and is left out".

    Args:
        count: how many.
        what: the noun, singular.
        of: of how many in all.
        does: the predicate, plural; for a count of one, are, have, were and their become singular.
    """
    share = f"{count}" if of is None else f"{count} of {of}"
    words = [_OF_ONE.get(word, word) if count == 1 else word for word in does.split()]
    return " ".join([share, f"{what}{'s' * ((count if of is None else of) != 1)}", *words])


def expect(what: str, value: object, *kinds: type) -> None:
    """Raise InputError unless the value is of one of these types; True and False are no numbers."""
    if not isinstance(value, kinds) or isinstance(value, bool) and bool not in kinds:
        raise wrong_type(what, value, *kinds)


def wrong_type(what: str, value: object, *kinds: type) -> InputError:
    """Return the error of a value that has none of the expected types."""
    wanted = [_KIND_NAMES.get(kind.__name__, kind.__name__) for kind in kinds]
    hint = "; use torch.from_numpy" if _is_array(value) and "torch.Tensor" in wanted else ""
    return InputError(f"{what}: expected {' or '.join(wanted)}, got {type(value).__name__}{hint}")


def _is_array(value: object) -> bool:
    numpy = sys.modules.get("numpy")  # without it there is no array; its import takes longer than --help
    return numpy is not None and isinstance(value, numpy.ndarray)


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def whole_number(what: str, value: Any, low: int, high: int) -> int:
    """Return `value` as an int in low..high. Raises InputError."""
    if not _is_number(value) or value != value // 1:
        raise InputError(f"{what} must be a whole number, got {shown(value)}")
    if not low <= value <= high:
        raise InputError(f"{what} must be {low}..{high}, got {shown(value)}")
    return int(value)


def real_number(what: str, value: Any, low: float, high: float) -> float:
    """Return `value` as a float in low..high. Raises InputError."""
    if not _is_number(value):
        raise InputError(f"{what} must be a number, got {shown(value)}")
    if not low <= value <= high:  # false for NaN
        raise InputError(f"{what} must be {low:g}..{high:g}, got {shown(value)}")
    return float(value)


def is_row(values: Any, count: int | None = None) -> bool:
    """Return whether `values` is a sequence or array of `count` elements of any kind (None: any number)."""
    if _is_array(values):
        good = values.ndim == 1
    else:
        good = isinstance(values, Sequence) and not isinstance(values, (str, bytes))
    return good and count in (None, len(values))


def number_pair(what: str, values: Any, low: float, high: float) -> tuple[float, float]:
    """Return `values` as two floats in low..high; raise InputError for others."""
    if not is_row(values, 2):
        raise InputError(f"{what} must be two numbers, got {shown(values)}")
    return real_number(what, values[0], low, high), real_number(what, values[1], low, high)


def checked_field(check: Callable[..., Any], *bounds: Any, default: Any = MISSING) -> Any:
    """Return a dataclass field for check_fields; it may be None where its default is.

    Args:
        check: whole_number or another function that takes the name, the value and the bounds, and returns the value.
        bounds: what `check` takes beside name and value.
        default: of the field; without one the field has to be given.
    """
    return field(default=default, metadata={"check": check, "bounds": bounds})


def check_fields(record: Any, prefix: str = "") -> None:
    """Check the fields of a dataclass that checked_field made, and store the values that the checks return.

    Args:
        record: the instance, frozen or not.
        prefix: what stands before the fields' names in messages.

    Raises:
        InputError: a value is refused.
    """
    for one in fields(record):
        value = getattr(record, one.name)
        if one.metadata and not (value is None and one.default is None):
            checked = one.metadata["check"](f"{prefix}{one.name}", value, *one.metadata["bounds"])
            object.__setattr__(record, one.name, checked)
