"""Modules of JavaScript as one script, for pages that are one file and load nothing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import NamedTuple

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


def joined(entry: Path, exports: bool = False) -> str:
    """Return a module and all that it imports as one script, for a `<script type="module">`.

    Each module becomes a function that runs once, in its turn, and returns what it exports. So names stay its own. The
    entry itself comes last, at the top level, where it may wait. Known are `import { a, b } from "./other.js";` and
    `export` before a declaration of one name, as our files have them.

    Args:
        entry: The module.
        exports: Whether the script exports what the module does, for others to import.

    Raises:
        InputError: A file is missing, imports or exports in another way, or imports what is not exported.
    """
    known: dict[Path, _Module] = {}
    body = _bound(entry.resolve(), known)
    parts = [
        f"// {path.name}\nconst {one.name} = (() => {{\n{one.body}\nreturn {{ {', '.join(one.exported)} }};\n}})();\n"
        for path, one in known.items()
    ]
    if exports:
        body += f"export {{ {', '.join(name for _, name in _EXPORT.findall(_read(entry)))} }};\n"
    # Nothing within may end the script's element
    return "".join([*parts, body]).replace("</script", "<\\/script").replace("<!--", "<\\!--")


class _Module(NamedTuple):
    """A module of a script: the name of what it returns, its text with imports bound, and the names that it exports."""

    name: str
    body: str
    exported: list[str]


def _bound(path: Path, known: dict[Path, _Module]) -> str:
    """Return the text of a module with its imports bound; add the modules that it needs to `known`, in order."""
    text = _read(path)
    lines = []
    for names, source in _IMPORT.findall(text):
        other = (path.parent / source).resolve()
        if other not in known:
            body = _bound(other, known)
            known[other] = _Module(f"module{len(known)}", body, [name for _, name in _EXPORT.findall(_read(other))])
        wanted = [name.strip() for name in names.split(",")]
        if missing := [name for name in wanted if name not in known[other].exported]:
            raise InputError(
                f"{path}: {other.name} exports {', '.join(known[other].exported)}, not {', '.join(missing)}"
            )
        lines.append(f"const {{ {', '.join(wanted)} }} = {known[other].name};\n")
    body = _EXPORT.sub(r"\1 \2", _IMPORT.sub("", text))
    if strange := re.search(r"^(import|export)\b.*", body, re.MULTILINE):
        raise InputError(f"{path}: expected imports and exports of names, got {strange.group()!r}")
    return "".join(lines) + body


def _read(path: Path) -> str:
    if not path.is_file():
        raise InputError(f"no {path}; reinstall lightfield-gs")
    return path.read_text(encoding="utf-8")
