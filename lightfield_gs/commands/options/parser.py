"""The parser of a command line: one-line errors, the types of values, and options as data."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NoReturn, Protocol, TypeVar, get_type_hints

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEVICES
from lightfield_gs.base.suggestions import did_you_mean
from lightfield_gs.commands.options.help_text import HelpText
from lightfield_gs.panels.display_kinds import DISPLAY_KINDS, kind_name

# Options whose values may begin with a minus sign
_VECTOR_OPTIONS: tuple[str, ...] = ("--eye", "--eyes", "--background", "--depth-range", "--intrinsics", "--up", "--pan")
_VECTOR_OPTIONS += ("--shift", "--corners", "--tracker-at")
_VECTOR_OPTIONS += tuple(f"--{what}-by" for what in ("pitch", "slope", "centre", "line-number", "slant", "phase"))
_UNITS = {"B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}


class _Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Any]]


_Options = TypeVar("_Options", bound=_Dataclass)


class Parser(argparse.ArgumentParser):
    """A parser whose errors are InputErrors of one line, with a short --help and a whole --help-all.

    Attributes:
        fill: Adds the arguments when they are first asked for: commands import only what they take.
        takes_anything: Whether unknown options are left to the command.
        text: What the help is made of.
    """

    def __init__(
        self, prog: str | None = None, *, fill: Callable[[Parser], None] | None = None, **arguments: Any
    ) -> None:
        self.text, self.fill, self.takes_anything = HelpText(), fill, False
        self._exclusive: dict[str, Any] = {}
        super().__init__(prog=prog, add_help=False, **arguments)
        super().add_argument("-h", "--help", action="help", help=argparse.SUPPRESS)
        super().add_argument("--help-all", action=_WholeHelp, nargs=0, help=argparse.SUPPRESS)

    def add_argument(self, *names: Any, **arguments: Any) -> argparse.Action:
        """Add an argument.

        Args:
            names: As argparse takes them.
            arguments: As argparse takes them, and more. short: its line in --help, for what most people need; group:
                its title in --help-all; instead_of: a name that options share of which only one may be given.
        """
        short, group = arguments.pop("short", None), arguments.pop("group", "options")
        shared = arguments.pop("instead_of", None)
        if shared is None:
            action = super().add_argument(*names, **arguments)
        else:
            if shared not in self._exclusive:
                self._exclusive[shared] = self.add_mutually_exclusive_group()
            action = self._exclusive[shared].add_argument(*names, **arguments)
        self.text.groups.setdefault(group, []).append(action)
        if short is not None:
            self.text.shorts[action] = short
        return action

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        self.complete()
        words = list(sys.argv[1:] if args is None else args)
        if self.takes_anything:
            return super().parse_known_args([], namespace)
        self._refuse_unknown(words)
        return super().parse_known_args(words, namespace)

    def complete(self) -> None:
        """Add the arguments that wait for it."""
        fill, self.fill = self.fill, None
        if fill is not None:
            fill(self)

    def typed(self, words: Sequence[str]) -> list[tuple[str, tuple[str, ...]]]:
        """Return the options among the words of a command line: the name of each one's value, and its words."""
        self.complete()
        found, rest = [], iter(words)
        for word in rest:
            name, equals, _ = word.partition("=")
            action = self._option_string_actions.get(name)
            if action is not None:
                takes_next = action.nargs != 0 and not equals
                found.append((action.dest, (word, *([next(rest)] if takes_next else []))))
        return found

    def format_help(self) -> str:
        self.complete()
        return self.text.short(self)

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            hint = did_you_mean(str(value), map(str, action.choices or ()))
            raise argparse.ArgumentError(action, f"{error.message}{hint}") from None

    def _refuse_unknown(self, words: Sequence[str]) -> None:
        """Raise InputError for the first option that there is not: argparse asks for missing ones before."""
        options = [name[2:] for name in self._option_string_actions if name.startswith("--")]
        parents = self._subparsers._group_actions if self._subparsers else []
        commands = [name for action in parents for name in action.choices or ()]
        for word in words:
            if word == "--" or word in commands:
                return
            name = word.partition("=")[0]
            is_known = name in self._option_string_actions or name[:2] in self._option_string_actions
            if re.fullmatch(r"--?[A-Za-z][\w-]+", name) and not is_known:
                self.error(f"unrecognized arguments: {name}{did_you_mean(name.lstrip('-'), options, '--')}")


class _WholeHelp(argparse.Action):
    """Prints all options."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        print(parser.text.whole(parser), end="")
        parser.exit()


def read_options(kind: type[_Options], args: argparse.Namespace) -> _Options:
    """Return parsed arguments as an options dataclass.

    A field takes the argument of its name, or else keeps its default. A field whose type is a dataclass is read from
    the same arguments.
    """
    types = get_type_hints(kind)
    values: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(types[field.name]):
            values[field.name] = read_options(types[field.name], args)
        elif hasattr(args, field.name):
            values[field.name] = getattr(args, field.name)
    return kind(**values)


def join_values(arguments: Iterable[str]) -> list[str]:
    """Write `--eye -5,0,600` as `--eye=-5,0,600`: argparse takes the value for an option otherwise."""
    out: list[str] = []
    for argument in arguments:
        if out and out[-1] in _VECTOR_OPTIONS:
            out[-1] += f"={argument}"
        else:
            out.append(argument)
    return out


def drawing_device(text: str) -> str:
    """Parse auto, cpu, cuda, webgpu or webgpu:N."""
    if text in DEVICES or re.fullmatch(r"webgpu(:\d{1,3})?", text):
        return text
    hint = did_you_mean(text, (*DEVICES, "webgpu"))
    raise argparse.ArgumentTypeError(
        f"invalid choice: '{text}' (choose from {', '.join(DEVICES)}, webgpu, webgpu:N){hint}"
    )


def panel_name(text: str) -> str:
    """Return the path of a panel, or its name if there is one of it."""
    from lightfield_gs.io.text_files import config_path

    is_path = text.lower().endswith((".yaml", ".yml", ".json")) or "/" in text or Path(text).is_file()
    if Path(text).name.lower() == "visual.json" and not Path(text).exists():
        from lightfield_gs.displays.calibrations import WHERE_IT_LIES

        raise argparse.ArgumentTypeError(f"cannot read {text}: No such file or directory; {WHERE_IT_LIES}")
    if not is_path and text not in DISPLAY_KINDS:
        if (name := kind_name(text)) is not None:
            return name
        try:
            config_path("panels", text, tuple(DISPLAY_KINDS))
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
    return text


def numbers(count: int):
    """Return the parser of `count` comma-separated finite numbers."""

    def parse(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count or not all(map(math.isfinite, values)):
            raise argparse.ArgumentTypeError(f"expected {_counted(count)}, got '{text}'")
        return values

    return parse


def _counted(count: int) -> str:
    return "a finite number" if count == 1 else f"{count} numbers separated by commas"


def background(text: str) -> tuple[float, ...]:
    """Parse "1,0.5,0", a name of CSS as "grey", or "#rrggbb" to red, green and blue in 0..1."""
    if "," not in text:
        return _named_colour(text)
    values = numbers(3)(text)
    if not all(0 <= value <= 1 for value in values):
        raise argparse.ArgumentTypeError(f"expected red, green and blue in 0..1, got '{text}'")
    return values


def _named_colour(text: str) -> tuple[float, ...]:
    """Return red, green and blue in 0..1 of a name of CSS or of hexadecimal digits after a #."""
    from PIL import ImageColor

    parts: tuple[int, ...] = ()
    if re.fullmatch(r"#[0-9a-fA-F]{3,6}|[a-zA-Z]{3,32}", text):
        with contextlib.suppress(ValueError):
            parts = ImageColor.getrgb(text)
    if len(parts) != 3:
        raise argparse.ArgumentTypeError(f"expected 3 numbers separated by commas, a name or #rrggbb, got '{text}'")
    return tuple(part / 255 for part in parts)


def background_or_auto(text: str) -> tuple[float, ...] | None:
    """Parse a background; "auto" is None."""
    return None if text == "auto" else background(text)


def within(low: float, high: float, unit: str = ""):
    """Return the parser of a number in low..high, both included.

    Args:
        unit: Unit of both limits, for the error.
    """

    def parse(text: str) -> float:
        value = numbers(1)(text)[0]
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected {low:g}..{high:g}{unit and ' ' + unit}, got '{text}'")
        return value

    return parse


def whole(low: int, high: int):
    """Return the parser of a whole number in low..high; "300,000" and "300_000" are 300000."""

    def parse(text: str) -> int:
        digits = text.replace("_", "").replace(",", "")
        if not digits.isdecimal() or len(digits) > 19 or not low <= int(digits) <= high:
            raise argparse.ArgumentTypeError(f"expected a whole number in {low}..{high}, got '{text}'")
        return int(digits)

    return parse


def whole_numbers(low: int, high: int, separator: str = ",", count: int | None = None):
    """Return the parser of `count` whole numbers in low..high (None: one or more)."""

    def parse(text: str) -> tuple[int, ...]:
        words = text.split(separator)
        if count not in (None, len(words)):
            raise argparse.ArgumentTypeError(f"expected {count} whole numbers with {separator!r} between, got '{text}'")
        return tuple(map(whole(low, high), words))

    return parse


def camera_choice(text: str) -> tuple[Path, int | None]:
    """Parse "FILE" or "FILE:INDEX" to the file and the index of its camera."""
    name, colon, index = text.rpartition(":")
    if colon and name and index.isdecimal() and not Path(text).exists():
        return Path(name), int(index[:9])
    return Path(text), None


def threads(text: str) -> int:
    """Parse "8" to 8."""
    if not text.isdecimal() or not 1 <= int(text[:9]) <= 1024:
        raise argparse.ArgumentTypeError(f"expected 1..1024, got '{text}'")
    return int(text)


def byte_size(text: str) -> int:
    """Parse "256MB" to 256000000."""
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,15})?)(B|[KMG]i?B)", text)
    value = 0 if match is None else int(float(match[1]) * _UNITS[match[2]])
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a size such as 256MB or 1.5GiB, got '{text}'")
    return value
