"""Checks of what users give, and how it is shown to them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError

_OF_ONE = {"are": "is", "have": "has", "were": "was", "their": "its"}  # words of several, of one
_KIND_NAMES = {"NoneType": "none", "Tensor": "torch.Tensor"}


def shown(value: object) -> str:
    """A value of any kind as a message shows it: on one line, 80 characters at most."""
    return "none" if value is None else " ".join(repr(value).split())[:80]


def counted(count: int, what: str = "item", of: int | None = None, does: str = "") -> str:
    """How many, in words: "1 item", "2 items", "1 of 7 frames has no pose and is left out".

    Args:
        count: how many.
        what: one of them.
        of: of how many in all.
        does: what they do, as it is said of several; are, have, were and their are put as one's where it is one.
    """
    share = f"{count}" if of is None else f"{count} of {of}"
    words = [_OF_ONE.get(word, word) if count == 1 else word for word in does.split()]
    return " ".join([share, f"{what}{'s' * ((count if of is None else of) != 1)}", *words])


def expect(what: str, value: object, *kinds: type) -> None:
    """Raises InputError unless the value is of one of these types; True and False are no numbers."""
    if not isinstance(value, kinds) or isinstance(value, bool) and bool not in kinds:
        wanted = [_KIND_NAMES.get(kind.__name__, kind.__name__) for kind in kinds]
        hint = "; use torch.from_numpy" if isinstance(value, np.ndarray) and "torch.Tensor" in wanted else ""
        raise InputError(f"{what}: expected {' or '.join(wanted)}, got {type(value).__name__}{hint}")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def whole_number(what: str, value: Any, low: int, high: int) -> int:
    """`value` as an int in low..high; raises InputError."""
    if not _is_number(value) or value != value // 1:
        raise InputError(f"{what} must be a whole number, got {shown(value)}")
    if not low <= value <= high:
        raise InputError(f"{what} must be {low}..{high}, got {shown(value)}")
    return int(value)


def real_number(what: str, value: Any, low: float, high: float) -> float:
    """`value` as a float in low..high; raises InputError."""
    if not _is_number(value):
        raise InputError(f"{what} must be a number, got {shown(value)}")
    if not low <= value <= high:  # false for NaN
        raise InputError(f"{what} must be {low:g}..{high:g}, got {shown(value)}")
    return float(value)


def is_row(values: Any, count: int | None = None) -> bool:
    """Whether `values` is a sequence or array of `count` elements (None: any number), whatever they are."""
    if isinstance(values, np.ndarray):
        good = values.ndim == 1
    else:
        good = isinstance(values, Sequence) and not isinstance(values, (str, bytes))
    return good and count in (None, len(values))
