"""The one exception for everything a user can get wrong."""

from __future__ import annotations


class InputError(ValueError):
    """A file, value, shape, dtype or device that was given and cannot be used.

    The message is one line: what was expected, what came, what to do. The command line prints it to stderr and exits
    with status 2.
    """


def shown(value: object) -> str:
    """A value of any kind in a message: on one line, cut."""
    return "none" if value is None else " ".join(repr(value).split())[:80]


def expect(what: str, value: object, *kinds: type) -> None:
    """Raises InputError unless the value is of one of these types; True and False are no numbers."""
    if not isinstance(value, kinds) or isinstance(value, bool) and bool not in kinds:
        wanted = " or ".join("none" if kind is type(None) else kind.__name__ for kind in kinds)
        raise InputError(f"{what}: expected {wanted}, got {type(value).__name__}")
