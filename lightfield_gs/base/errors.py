"""The one exception for everything a user can get wrong."""

from __future__ import annotations


class InputError(ValueError):
    """A file, value, shape, dtype or device that was given and cannot be used.

    The message is one line: what was expected, what came, what to do. The command line prints it to stderr and exits
    with status 2.
    """
