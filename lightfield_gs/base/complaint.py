"""What a command says beside its results: on stderr why it could not do its work, and notes on work that may
disappoint; on stdout what it assumed."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.paths import FOLDER_GONE, has_working_folder

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130
_NO_MEMORY = ("allocate memory", "out of memory")  # torch's words for the host's and the device's


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory did not suffice, of the host or of a device."""
    return (
        isinstance(error, MemoryError)
        or isinstance(error, RuntimeError)
        and any(words in str(error) for words in _NO_MEMORY)
    )


def complain(program: str, error: BaseException, remedy: str) -> int:
    """Says in one line on stderr why a program ends, and returns its exit code. Errors that are a fault of the program
    itself are raised again.

    remedy: what to do where memory does not suffice.
    """
    code = EXIT_BAD_INPUT
    if isinstance(error, KeyboardInterrupt):
        message, code = "interrupted", EXIT_INTERRUPTED
    elif isinstance(error, (InputError, OSError)):
        message = str(error)
        if FOLDER_GONE not in message and not has_working_folder():
            message += f"; {FOLDER_GONE}"
    elif is_out_of_memory(error):
        message = f"out of memory; {remedy}"
    else:
        raise error
    print(f"{program}: error: {' '.join(message.split())}", file=sys.stderr)
    return code


def note(words: str) -> None:
    """Says in one line on stderr what may not be as it was meant."""
    print(f"note: {words}", file=sys.stderr)


@contextmanager
def assumptions_said() -> Iterator[None]:
    """Says on stdout, once the work is done, what the library assumed for it; other warnings go their usual way."""
    lines: dict[str, None] = {}  # each once, in order
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **options: Any) -> None:
            if issubclass(category, Assumption):
                lines[f"{category.label}: {message}"] = None
            else:
                usual(message, category, *rest, **options)

        warnings.simplefilter("always", Assumption)
        warnings.showwarning = show
        yield
    for line in lines:
        print(line)
