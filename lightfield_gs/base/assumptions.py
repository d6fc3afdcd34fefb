"""What the library assumes where nothing says it: a warning to programs, a line of what the command line prints."""

from __future__ import annotations

import warnings


class Assumption(UserWarning):
    """Something that decides what comes out and that had to be assumed, since nothing that was given says it."""


def assume(words: str) -> None:
    """Warns with one line: what is assumed, why, and what follows if that is wrong."""
    warnings.warn(" ".join(words.split()), Assumption, stacklevel=3)
