"""Assumptions of the library: warnings in a program, lines on stdout in a command."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Assumption(UserWarning):
    """Warns of an assumption: the input does not say something on which the result depends."""

    label = "assumed"  # begins the line that the command line prints


class Loss(Assumption):
    """Warns of a part of the input that the output's format cannot hold."""

    label = "lost"


class Fallback(Assumption):
    """Warns of something that failed, and says what takes its place."""

    label = "instead"


_collected: ContextVar[list[str] | None] = ContextVar("collected", default=None)


@contextmanager
def collect_assumptions() -> Iterator[list[str]]:
    """Collect the assumptions of this thread as lines, in place of warnings.

    Warnings are of a whole process, in which other threads may assume other things at the same time.
    """
    lines: list[str] = []
    token = _collected.set(lines)
    try:
        yield lines
    finally:
        _collected.reset(token)


def assume(message: str, category: type[Assumption] = Assumption) -> None:
    """Warn with one line: an assumption, its reason and its remedy, or a loss."""
    message, lines = " ".join(message.split()), _collected.get()
    if lines is None:
        warnings.warn(message, category, stacklevel=3)
    elif (line := f"{category.label}: {message}") not in lines:
        lines.append(line)
