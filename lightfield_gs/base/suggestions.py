"""Suggestions for words that were mistyped."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def nearest(word: str, names: Iterable[str]) -> str | None:
    """Return the name that a mistyped word most likely stands for; None where none is near."""
    by_lower = {name.lower(): name for name in names}
    near = difflib.get_close_matches(word.lower(), by_lower, 1)
    return by_lower[near[0]] if near else None


def did_you_mean(word: str, names: Iterable[str], prefix: str = "") -> str:
    """Return "; did you mean `name`?" for the nearest name, with a prefix before it, or "" where none is near."""
    name = nearest(word, names)
    return f"; did you mean `{prefix}{name}`?" if name is not None else ""
