"""Common parts of the commands of this package."""

from __future__ import annotations

import functools
from collections.abc import Callable

from lightfield_gs.base.cli_messages import report_error

Main = Callable[[list[str] | None], int]


def with_line_errors(name: str) -> Callable[[Main], Main]:
    """Decorate a main(arguments): errors of the user become a line on stderr that begins with the name."""

    def decorate(main: Main) -> Main:
        @functools.wraps(main)
        def command(arguments: list[str] | None = None) -> int:
            try:
                return main(arguments)
            except (Exception, KeyboardInterrupt) as error:
                return report_error(name, error, "take fewer objects or targets a step, or smaller pictures")

        return command

    return decorate
