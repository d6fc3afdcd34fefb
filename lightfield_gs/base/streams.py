"""Standard streams that do not stop the work: one that is closed, full or that nobody reads takes no more, and whether
something was lost is known at the end."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


def open_closed_streams() -> None:
    """Opens what was closed of standard input, output and error on nothing.

    Their numbers would else be those of the first files that are opened, into which libraries would print.
    """
    while (file := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(file, True)
    os.close(file)
    sys.stdin = sys.stdin or open(0, closefd=False)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


class PatientStream(io.RawIOBase):
    """Writes to an unbuffered stream until that fails, and from then on nowhere. failed: why, None where all went well.

    Args:
        stream: the text stream that writes to it otherwise, which would close it at its end.
    """

    def __init__(self, stream: io.TextIOWrapper) -> None:
        super().__init__()
        buffer: Any = stream.buffer
        self._stream, self._raw = stream, getattr(buffer, "raw", buffer)  # the latter by python -u
        self.name = self._raw.name
        self.failed: OSError | None = None

    @staticmethod
    def of(stream: io.TextIOWrapper, errors: str) -> tuple[io.TextIOWrapper, PatientStream]:
        """A text stream in the place of another, and what it writes to. errors: what becomes of what is no text."""
        patient = PatientStream(stream)
        unbuffered: Any = patient
        return io.TextIOWrapper(
            io.BufferedWriter(patient) if hasattr(stream.buffer, "raw") else unbuffered,
            encoding=stream.encoding,
            errors=errors,
            line_buffering=stream.line_buffering,
            write_through=stream.write_through,
        ), patient

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._raw.fileno()

    def isatty(self) -> bool:
        return self._raw.isatty()

    def write(self, data: Any) -> int | None:
        if self.failed is None:
            try:
                return self._raw.write(data)
            except OSError as error:
                self.failed = error
        return len(data)
