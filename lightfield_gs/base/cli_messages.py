"""Messages of a command on its standard streams: errors and notes on stderr, assumptions and times on stdout."""

from __future__ import annotations

import io
import os
import re
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from typing import Any

from lightfield_gs.base.assumptions import Assumption, collect_assumptions
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import quoted

FOLDER_GONE = "the working folder has been removed: change to one that is there (cd)"
EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130
_NO_MEMORY = ("allocate memory", "out of memory")  # torch's messages for the host and for a device
_captured: ContextVar[list[str] | None] = ContextVar("captured", default=None)
_next: ContextVar[dict[str, str] | None] = ContextVar("next", default=None)


# An argument in a message of the library, `name=` or `name=value`; names of files may look so too, but have a suffix
_ARGUMENT = re.compile(r"""(?<![\w/\\.'"=-])([a-z][a-z0-9_]*)=(?!\S*(?:[/\\]|\.[A-Za-z]))((?:[^\s;()]*[^\s;(),.:])?)""")
# Arguments whose option has another name
_OPTIONS = {
    "batch_size": "views_per_step",
    "cap_max": "gaussians",
    "cone_deg": "cone",
    "folder": "run",
    "one_viewpoint": "one_place",
    "serial": "device_serial",
    "span": "frames",
    "test_names": "test_list",
    "viewing_distance_mm": "viewing_distance",
}


def as_options(message: str) -> str:
    """Return a message with the library's arguments as options: `depth_amount=0.5` becomes `--depth-amount 0.5`."""
    return _ARGUMENT.sub(_as_option, message)


def _as_option(match: re.Match[str]) -> str:
    name, value = _OPTIONS.get(match[1], match[1]).replace("_", "-"), match[2].strip("'\"")
    if value in ("True", ""):
        return f"--{name}"
    return f"--no-{name}" if value == "False" else f"--{name} {value}"


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error says that the host or a device has too little memory."""
    return (
        isinstance(error, MemoryError)
        or isinstance(error, RuntimeError)
        and any(words in str(error) for words in _NO_MEMORY)
    )


def has_working_folder() -> bool:
    """Return whether the working folder exists: torch cannot be imported in a removed one, nor relative paths used."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


def report_error(program: str, error: BaseException, remedy: str) -> int:
    """Print one line on stderr that says why a program ends, and return its exit code.

    Args:
        program: name of the program, which begins the line.
        error: the reason. A fault of the program itself is raised again.
        remedy: advice for a user whose memory runs out.
    """
    code = EXIT_BAD_INPUT
    if isinstance(error, KeyboardInterrupt):
        message, code = "interrupted", EXIT_INTERRUPTED
    elif isinstance(error, (InputError, OSError)):
        message = as_options(str(error)) if isinstance(error, InputError) else str(error)
        if FOLDER_GONE not in message and not has_working_folder():
            message += f"; {FOLDER_GONE}"
    elif is_out_of_memory(error):
        message = f"out of memory; {remedy}"
    else:
        raise error
    print(f"{program}: error: {' '.join(message.split())}", file=sys.stderr)
    return code


def note(message: str) -> None:
    """Print one line on stderr about a result that may disappoint."""
    print(f"note: {as_options(message)}", file=sys.stderr)


def say(*messages: str) -> None:
    """Print lines on stdout."""
    for message in messages:
        print(as_options(message))


def say_now(message: str) -> None:
    """Print a line on stdout at once, of a command that goes on for long."""
    say(message)
    print(end="", flush=True)


def say_next(*words: object) -> None:
    """Let the last line of the command say what to do next: these words after the name of the program."""
    told = _next.get()
    if told is not None:
        told["next"] = quoted("lightfield-gs", *words)


def confirm(question: str, is_meant: bool) -> None:
    """Ask on the terminal whether something unusual is meant; raise InputError where it is not.

    Args:
        question: What is unusual, as a sentence without its stop.
        is_meant: Whether --yes says so already.
    """
    if is_meant:
        return
    if not sys.stdin.isatty():
        raise InputError(f"{question}; nothing was changed: add --yes if it is meant")
    print(f"{question}. Go on? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise InputError("nothing was changed")


def ask_number(question: str, usual: float, low: float, high: float) -> float:
    """Ask for a number in low..high on the terminal until one comes; nothing is the usual one. Raises InputError.

    Args:
        question: It, with its unit.
        usual: The usual number.
        low: The least that is taken.
        high: The most.
    """
    while True:
        print(f"{question} [{usual:g}] ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            raise InputError("no answer came; give the number as an option")
        try:
            number = float(line.strip() or usual)
        except ValueError:
            number = low - 1
        if low <= number <= high:
            return number
        print(f"expected a number in {low:g}..{high:g}", file=sys.stderr)


def can_ask() -> bool:
    """Return whether somebody sits at the terminal, who reads and answers."""
    return sys.stdin.isatty() and sys.stdout.isatty() and sys.stderr.isatty()


@contextmanager
def closing_lines() -> Iterator[None]:
    """Print the library's assumptions on stdout at the end of the block, and last what to do next.

    Other warnings go their usual way.
    """
    lines: dict[str, None] = {}  # each once, in order
    told: dict[str, str] = {}
    token = _next.set(told)
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *rest: Any, **options: Any) -> None:
            if issubclass(category, Assumption):
                lines[f"{category.label}: {message}"] = None
            else:
                usual(message, category, *rest, **options)

        warnings.simplefilter("always", Assumption)
        warnings.showwarning = show
        try:
            yield
        finally:
            _next.reset(token)
    say(*lines)
    for label, command in told.items():
        print(f"{label}: {command}")


@contextmanager
def quiet() -> Iterator[None]:
    """Print nothing on stdout inside the block."""
    with open(os.devnull, "w") as nothing, redirect_stdout(nothing):
        yield


class Stopwatch:
    """Collects named times in seconds; `lap` takes the time since the last lap, or since `began` (perf_counter)."""

    def __init__(self, began: float) -> None:
        self._start = self._last = began
        self.stages: list[tuple[str, float]] = []

    def lap(self, name: str, parts_ms: dict[str, float] | None = None) -> None:
        """End a stage. With `parts_ms` the parts are listed by their own names, and the remaining time as `name`."""
        now = time.perf_counter()
        seconds = now - self._last
        for part, milliseconds in (parts_ms or {}).items():
            self.stages.append((part, milliseconds / 1000))
            seconds -= milliseconds / 1000
        if parts_ms is None or seconds >= 0.005:
            self.stages.append((name, seconds))
        self._last = now

    def line(self) -> str:
        """Return a line such as "load 0.12 s, composite 0.80 s, write 0.21 s, total 1.13 s"."""
        total = ("total", self._last - self._start)
        return ", ".join(f"{name} {seconds:.2f} s" for name, seconds in [*self.stages, total])

    def say_if(self, wanted: bool) -> None:
        """Print the line where --stats asks for it."""
        if wanted:
            print(self.line())


class _CapturableStream:
    """Stands in for stdout or stderr: stores the text of threads inside `capture`, and passes other text on."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        parts = _captured.get()
        if parts is None:
            return self._stream.write(text)
        parts.append(text)
        return len(text)

    def isatty(self) -> bool:
        """Return False: a progress bar would end up among the captured lines."""
        return False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def capturable_streams() -> Iterator[None]:
    """Let `capture` see stdout and stderr of this process inside the block."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _CapturableStream(sys.stdout), _CapturableStream(sys.stderr)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


@contextmanager
def capture(messages: list[str]) -> Iterator[None]:
    """Append to `messages` the lines that this thread prints, and its assumptions, instead of printing them."""
    parts: list[str] = []
    token = _captured.set(parts)
    try:
        with collect_assumptions() as assumptions:
            yield
    finally:
        _captured.reset(token)
        messages += [line for line in "".join(parts).splitlines() if line.strip()]
        messages += map(as_options, assumptions)


def open_closed_streams() -> None:
    """Open the standard streams that are closed on /dev/null.

    Otherwise the first files that are opened would get their numbers, and libraries would print into them.
    """
    while (file := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(file, True)
    os.close(file)
    sys.stdin = sys.stdin or open(0, closefd=False)
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


def print_any_name() -> None:
    """Print characters that the encoding of a standard stream lacks as escapes: names of files may have them."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


class PatientStream(io.RawIOBase):
    """Writes to an unbuffered stream until a write fails, and drops everything after that.

    Attributes:
        failed: the first error; None while there is none.
    """

    def __init__(self, stream: io.TextIOWrapper) -> None:
        super().__init__()
        buffer: Any = stream.buffer
        # Keep the text stream: its end would close the file. python -u has no buffer between the two.
        self._stream, self._raw = stream, getattr(buffer, "raw", buffer)
        self.name = self._raw.name
        self.failed: OSError | None = None

    @staticmethod
    def wrap(stream: io.TextIOWrapper, errors: str) -> tuple[io.TextIOWrapper, PatientStream]:
        """Return a text stream that replaces `stream`, and the patient stream below it.

        Args:
            stream: a standard stream.
            errors: how to write characters that its encoding lacks, as in `open`.
        """
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
