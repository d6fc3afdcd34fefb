"""What is printed, noted and assumed of one item while others are on their way in other threads."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from lightfield_gs.base.assumptions import heard

_text: ContextVar[list[str] | None] = ContextVar("text", default=None)


class Router:
    """In place of sys.stdout or sys.stderr: what is written in `kept` is kept, the rest goes its usual way."""

    def __init__(self, usual: Any) -> None:
        self._usual = usual

    def write(self, text: str) -> int:
        """Keeps a text, or passes it on."""
        parts = _text.get()
        if parts is None:
            return self._usual.write(text)
        parts.append(text)
        return len(text)

    def isatty(self) -> bool:
        """Never: a bar of progress would be among the lines."""
        return False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._usual, name)


def route() -> None:
    """Puts routers in the place of stdout and stderr of this process, once."""
    if not isinstance(sys.stdout, Router):
        sys.stdout, sys.stderr = Router(sys.stdout), Router(sys.stderr)


@contextmanager
def kept(lines: list[str]) -> Iterator[None]:
    """Adds to `lines` what this thread prints and assumes meanwhile."""
    parts: list[str] = []
    token = _text.set(parts)
    try:
        with heard() as assumed:
            yield
    finally:
        _text.reset(token)
        lines += [line for line in "".join(parts).splitlines() if line.strip()] + assumed
