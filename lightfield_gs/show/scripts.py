"""Modules of JavaScript as one script, for pages that are one file and load nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path

from lightfield_gs.base.errors import InputError

_PLACE = re.compile(r"/\* (\w+) \*/")
_IMPORT = re.compile(r'^import \{([^}]*)\} from "(\.[^"]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?function|class|const) (\w+)", re.MULTILINE)


def filled(template: Path, parts: dict[str, str]) -> str:
    """Return a page with these texts in the places named `/* name */`, in one pass: texts are not searched."""
    return _PLACE.sub(lambda found: parts.get(found[1], found[0]), template.read_text(encoding="utf-8"))


def json_in_page(data: object) -> str:
    """Return JSON for a script element of a page: within, a "<" of a title could end it."""
    return json.dumps(data).replace("<", "\\u003c")


def joined(entry: Path) -> str:
    """Return a module and all that it imports as one script, for a `<script type="module">`.

    Each module becomes a function that runs once, in its turn, and returns what it exports. So names stay its own. The
    entry itself comes last, at the top level, where it may wait. Known are `import { a, b } from "./other.js";` and
    `export` before a declaration, as our files have them.

    Raises:
        InputError: A file is missing, or imports or exports in another way.
    """
    known: dict[Path, str] = {}
    parts: list[str] = []
    body, _ = _read(entry.resolve(), known, parts)
    return _for_html("".join([*parts, body]))


def _for_html(script: str) -> str:
    """Return the script without what would end its element."""
    return script.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _read(path: Path, known: dict[Path, str], parts: list[str]) -> tuple[str, list[str]]:
    """Return the text of a module with its imports bound, and the names it exports; modules before it go to `parts`."""
    if not path.is_file():
        raise InputError(f"no {path}; reinstall lightfield-gs")
    text = path.read_text(encoding="utf-8")
    lines = []
    for names, source in _IMPORT.findall(text):
        other = (path.parent / source).resolve()
        if other not in known:
            body, exported = _read(other, known, parts)
            known[other] = f"module{len(known)}"
            wrapped = f"const {known[other]} = (() => {{\n{body}\nreturn {{ {', '.join(exported)} }};\n}})();\n"
            parts.append(f"// {other.name}\n{wrapped}")
        lines.append(f"const {{ {', '.join(names.split(','))} }} = {known[other]};\n".replace("  ", " "))
    body = _EXPORT.sub(r"\1 \2", _IMPORT.sub("", text))
    if strange := re.search(r"^(import|export)\b.*", body, re.MULTILINE):
        raise InputError(f"{path}: expected imports and exports of names, got {strange.group()!r}")
    return "".join(lines) + body, [name for _, name in _EXPORT.findall(text)]
