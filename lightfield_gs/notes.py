"""What the library assumed: a warning to programs, a line on stderr of the command line."""

from __future__ import annotations

import warnings


class Note(UserWarning):
    """Something that what was given does not say and that was assumed, or that looks as if it were not meant."""


def say(words: str) -> None:
    """Warns with one line: what was assumed or looks wrong, and what to do about it."""
    warnings.warn(" ".join(words.split()), Note, stacklevel=3)
