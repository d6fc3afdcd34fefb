"""What the library assumes where nothing says it: a warning to programs, a line of what the command line prints."""

from __future__ import annotations

import warnings


class Assumption(UserWarning):
    """Something that decides what comes out and that had to be assumed, since nothing that was given says it."""

    label = "assumed"  # what the command line puts before it


class Loss(Assumption):
    """Something that was given and that the format of an output cannot hold."""

    label = "lost"


def assume(words: str, category: type[Assumption] = Assumption) -> None:
    """Warns with one line: what is assumed, why, and what follows if that is wrong; or what is lost."""
    warnings.warn(" ".join(words.split()), category, stacklevel=3)
