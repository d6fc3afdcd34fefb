"""The texts of --help, what most people need on one screen, and of --help-all."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

_MOST_COLUMNS = 100  # longer lines are hard to read
_LABEL_COLUMNS = 26  # a longer label has a line of its own
Rows = Sequence[tuple[str, str]]


@dataclass
class HelpText:
    """What the texts are made of.

    Attributes:
        examples: Commands, and what each does.
        sections: Titles of lists of commands, each with its purpose.
        shorts: The options that most people need, with their short text.
        groups: All options by the title of their group.
        footer: Last line; "": where the rest is, if there is more.
    """

    examples: Rows = ()
    sections: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    shorts: dict[argparse.Action, str] = field(default_factory=dict)
    groups: dict[str, list[argparse.Action]] = field(default_factory=dict)
    footer: str = ""

    def short(self, parser: argparse.ArgumentParser) -> str:
        """Return the text of --help."""
        rows = [(_label(action), words) for action, words in self.shorts.items()]
        hidden = sum(map(len, self.groups.values())) - len(self.shorts)
        footer = self.footer or (f"{hidden} more options: {parser.prog} --help-all" if hidden else "")
        return _joined([*self._beginning(parser), _list("options", rows), footer])

    def whole(self, parser: argparse.ArgumentParser) -> str:
        """Return the text of --help-all."""
        blocks = [*self._beginning(parser), _filled(parser.epilog)]
        for title, actions in self.groups.items():
            formatter = argparse.HelpFormatter(parser.prog, max_help_position=_LABEL_COLUMNS, width=_columns())
            formatter.start_section(title)
            formatter.add_arguments(actions)
            formatter.end_section()
            blocks.append(formatter.format_help().strip("\n"))
        return _joined([*blocks, self.footer])

    def _beginning(self, parser: argparse.ArgumentParser) -> list[str]:
        """Return usage, description, examples and lists of commands."""
        examples = [(f"lightfield-gs {words}", meaning) for words, meaning in self.examples]
        lists = [_list(title, list(commands.items())) for title, commands in self.sections.items()]
        return [_usage(parser, self.groups), _filled(parser.description), _examples(examples), *lists]


def _usage(parser: argparse.ArgumentParser, groups: Mapping[str, Sequence[argparse.Action]]) -> str:
    """Return the line with what is required; options that may be left out are not listed."""
    actions = [action for group in groups.values() for action in group]
    words = [f"{_flag(action)} {_value(action)}" for action in actions if action.option_strings and action.required]
    has_more = any(not action.required for action in actions if action.option_strings)
    words += ["[options]"] if has_more and parser._subparsers is None else []
    places = [_value(action) for action in actions if not action.option_strings]
    if parser._subparsers is not None:
        places += [f"{action.metavar} ..." for action in parser._subparsers._group_actions]
    return " ".join(["usage:", parser.prog, *places, *words])


def _flag(action: argparse.Action) -> str:
    return action.option_strings[0]


def _value(action: argparse.Action) -> str:
    """Return the placeholder of an option's value, "" for one without."""
    if action.nargs == 0:
        return ""
    name = action.metavar or ("WORD" if action.choices else action.dest.upper())
    name = "WORD" if str(name).startswith("{") else name
    return f"{name} ..." if action.nargs in ("+", "*") else f"[{name}]" if action.nargs == "?" else str(name)


def _label(action: argparse.Action) -> str:
    """Return "INPUT", "--stats", "-o, --output FILE", or "--no-stats" of what is done by itself."""
    names = action.option_strings
    if isinstance(action, argparse.BooleanOptionalAction) and action.default:
        names = [name for name in names if name.startswith("--no-")]
    long = [name for name in names if name.startswith("--")][:1]
    return f"{', '.join([*names[:1], *long] if names[:1] != long else long)} {_value(action)}".strip()


def _examples(rows: Rows) -> str:
    """Return examples, each with its meaning beside it, or below where one is too long."""
    if not rows:
        return ""
    width = max(len(command) for command, _ in rows)
    if width + max(len(meaning) for _, meaning in rows) + 6 > _columns():
        return "\n".join(["examples:", *(f"  {command}\n      {meaning}" for command, meaning in rows)])
    return "\n".join(["examples:", *(f"  {command:{width}}  # {meaning}" for command, meaning in rows)])


def _list(title: str, rows: Rows) -> str:
    """Return lines of two columns under a title; "" without rows."""
    if not rows:
        return ""
    labels = [len(label) for label, _ in rows if len(label) <= _LABEL_COLUMNS]
    width = max(labels, default=_LABEL_COLUMNS)
    lines = [f"{title}:"]
    for label, words in rows:
        first = f"  {label:{width}}  "
        if len(label) > width:
            lines.append(f"  {label}")
            first = " " * (width + 4)
        lines += textwrap.wrap(words, _columns(), initial_indent=first, subsequent_indent=" " * (width + 4))
    return "\n".join(lines)


def _filled(text: str | None) -> str:
    return textwrap.fill(text or "", _columns())


def _columns() -> int:
    return max(60, min(_MOST_COLUMNS, shutil.get_terminal_size().columns) - 1)


def _joined(blocks: Sequence[str]) -> str:
    return "\n\n".join(block for block in blocks if block) + "\n"
