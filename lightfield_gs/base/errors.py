"""The exception for invalid input, and a context that adds a file's name to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """A file, value, shape, dtype or device that cannot be used.

    The message is one line: the expected value, the given value, the remedy. The command line prints it to stderr and
    exits with status 2.
    """


@contextmanager
def named(where: object) -> Iterator[None]:
    """Put the source of a value, a file or an option, before the message of an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


@contextmanager
def reading(path: object) -> Iterator[None]:
    """Turn the system's error for an unreadable file into an InputError with the reason."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
