"""YAML mappings with known keys."""

from __future__ import annotations

import difflib
import functools
import json
import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.text_file import read_text

MOST_BYTES = 1 << 16  # as many take a second at most


def read_mapping(path: str | Path, required: Collection[str], optional: Collection[str]) -> dict[str, Any]:
    """The mapping in a YAML file (at most 64 KiB).

    Raises InputError when the file cannot be read, is not a mapping, lacks a required key or has an unknown one.
    """
    import yaml

    text = read_text(path, MOST_BYTES, "YAML")
    try:
        data = yaml.load(text, _loader())
    except (ValueError, IndexError, yaml.YAMLError, RecursionError) as error:  # dates raise ValueError
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path} is not YAML: {reason}") from error
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a mapping 'key: value', got {type(data).__name__}")
    check_keys(data, required, optional, str(path))
    return data


@functools.cache
def _loader() -> type:
    """SafeLoader without aliases (a small file could grow without bound), without tags (settings need none, and they
    fail in many ways), without keys that come twice, and with 1e-5 as a number (both as in YAML 1.2); 010 and 1:30,
    which are 8 and 90 before YAML 1.2, are refused."""
    import yaml

    class Loader(yaml.SafeLoader):
        def compose_node(self, parent, index):
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("aliases are not allowed")
            if self.peek_event().tag is not None:
                raise yaml.YAMLError("tags (!...) are not allowed")
            return super().compose_node(parent, index)

        def construct_mapping(self, node, deep=False):
            counts = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
            if twice := [key for key, count in counts.items() if count > 1]:
                raise yaml.YAMLError(f"expected each key once, got '{twice[0][:60]}' twice")
            return super().construct_mapping(node, deep)

    def plain_number(loader: Loader, node: yaml.ScalarNode) -> int | float:
        if re.match(r"[-+]?0[0-9_]|.*[:_]", node.value):
            raise yaml.YAMLError(f"'{node.value[:60]}' is a different number to different programs; write it plain")
        return usual[node.tag](loader, node)

    usual = dict(Loader.yaml_constructors)
    for tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float"):
        Loader.add_constructor(tag, plain_number)
    Loader.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
    )
    return Loader


def check_keys(data: dict[str, Any], required: Collection[str], optional: Collection[str], where: str) -> None:
    """Raises InputError that names unknown keys with the nearest known one, and missing keys."""
    known = [*required, *optional]
    for key in data:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"
            raise InputError(f"{where}: unknown key '{str(key)[:60]}'; {hint}")
    missing = [key for key in required if key not in data]
    if missing:
        raise InputError(f"{where}: missing {', '.join(missing)}")


def write_mapping(path: str | Path, data: dict[str, Any]) -> None:
    """Writes a mapping of JSON-like values, one key a line, atomically; floats keep every digit."""
    with atomic_path(path) as temporary:
        lines = [f"{key}: {json.dumps(value)}\n" for key, value in data.items()]
        temporary.write_text("".join(lines), encoding="utf-8")
