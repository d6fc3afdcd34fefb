"""What the commands of this package share."""
from __future__ import annotations

import functools
import sys
from collections.abc import Callable

from lightfield_gs.errors import InputError

Main = Callable[[list[str] | None], int]


def with_line_errors(name: str) -> Callable[[Main], Main]:
    """Decorates a main(arguments): an InputError, or a file that cannot be read or written, is a line on stderr that
    begins with the name, and exit code 2."""
    def decorate(main: Main) -> Main:
        @functools.wraps(main)
        def command(arguments: list[str] | None = None) -> int:
            try:
                return main(arguments)
            except (InputError, OSError) as error:
                print(f"{name}: error: {error}", file=sys.stderr)
                return 2
        return command
    return decorate
