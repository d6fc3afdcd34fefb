"""What the library assumes where nothing says it: a warning to programs, a line of what the command line prints."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Assumption(UserWarning):
    """Something that decides what comes out and that had to be assumed, since nothing that was given says it."""

    label = "assumed"  # what the command line puts before it


class Loss(Assumption):
    """Something that was given and that the format of an output cannot hold."""

    label = "lost"


_heard: ContextVar[list[str] | None] = ContextVar("heard", default=None)


@contextmanager
def heard() -> Iterator[list[str]]:
    """The lines of what is assumed meanwhile in this thread, in place of warnings: those are of a whole process, in
    which other threads may assume other things at the same time."""
    lines: list[str] = []
    token = _heard.set(lines)
    try:
        yield lines
    finally:
        _heard.reset(token)


def assume(words: str, category: type[Assumption] = Assumption) -> None:
    """Warns with one line: what is assumed, why, and what follows if that is wrong; or what is lost."""
    words, lines = " ".join(words.split()), _heard.get()
    if lines is None:
        warnings.warn(words, category, stacklevel=3)
    elif (line := f"{category.label}: {words}") not in lines:
        lines.append(line)
