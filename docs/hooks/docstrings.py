"""Docstrings as Markdown: a line that begins with `name:` says what a parameter or a field is, and becomes an item.

Other lines of a docstring flow on into paragraphs, as everywhere in Markdown.
"""

from __future__ import annotations

import re
from collections.abc import Collection

import griffe

_ITEM = re.compile(r"([a-z_]\w*(?:, [a-z_]\w*)*): +(?=\S)")


def listed(text: str, names: Collection[str]) -> str:
    """The text with a list in place of lines that begin with some of the names."""
    lines: list[str] = []
    in_item = False
    for line in text.splitlines():
        found = _ITEM.match(line)
        if found and set(found[1].split(", ")) <= set(names):
            lines += [] if in_item else [""]
            lines.append(f"- **`{found[1]}`**: {line[found.end() :]}")
            in_item = True
        elif in_item and line and not _begins_a_sentence(line, lines[-1]):
            lines.append(f"  {line.strip()}")
        else:
            lines += ["", line] if in_item else [line]
            in_item = False
    return "\n".join(lines)


def _begins_a_sentence(line: str, before: str) -> bool:
    """Whether a line goes on with the docstring's own text, and not with the item before."""
    return line[0].isupper() and before.rstrip().endswith((".", ")"))


def _names(obj: griffe.Object) -> Collection[str]:
    """What a docstring may describe: a function's parameters; a class's fields and what it is made with."""
    if obj.is_function:
        return [parameter.name for parameter in obj.parameters]
    if obj.is_class:
        made_with = obj.members["__init__"].parameters if "__init__" in obj.members else ()
        return [*obj.members, *(parameter.name for parameter in made_with)]
    return ()


class Listed(griffe.Extension):
    """Rewrites the docstrings of what is documented."""

    def on_package(self, *, pkg: griffe.Module, **_: object) -> None:
        self._rewrite(pkg)

    def _rewrite(self, obj: griffe.Object) -> None:
        if obj.docstring:
            obj.docstring.value = listed(obj.docstring.value, _names(obj))
        for member in obj.members.values():
            if not member.is_alias:
                self._rewrite(member)
