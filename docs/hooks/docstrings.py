"""Docstrings as Markdown: a line that begins with `name:` says what a parameter or a field is, and becomes an item.

Other lines of a docstring flow on into paragraphs, as everywhere in Markdown.
"""

from __future__ import annotations

import re

import griffe

_ITEM = re.compile(r"([a-z_]\w*(?:, [a-z_]\w*)*(?: \[[^\]]*\])?): +(?=\S)")
_STAYS = ("https", "http")


def listed(text: str) -> str:
    """The text with a list in place of lines that begin with names of parameters."""
    lines: list[str] = []
    in_item = False
    for line in text.splitlines():
        found = _ITEM.match(line)
        if found and found[1] not in _STAYS:
            if not in_item:
                lines.append("")
            lines.append(f"- **`{found[1]}`**: {line[found.end() :]}")
            in_item = True
        elif in_item and line and not line[0].isspace() and _begins_a_sentence(line, lines[-1]):
            lines += ["", line]
            in_item = False
        elif in_item and line:
            lines.append(f"  {line.strip()}")
        else:
            lines.append(line)
            in_item = False
    return "\n".join(lines)


def _begins_a_sentence(line: str, before: str) -> bool:
    """Whether a line that stands at the margin goes on with the docstring's own text, and not with the item before."""
    return line[0].isupper() and before.rstrip().endswith((".", ")"))


class Listed(griffe.Extension):
    """Rewrites every docstring of what is documented."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        if obj.docstring:
            obj.docstring.value = listed(obj.docstring.value)
