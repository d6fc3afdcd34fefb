"""Text files, the JSON values and YAML mappings in them, and the package's own configurations."""

from __future__ import annotations

import functools
import json
import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.suggestions import nearest
from lightfield_gs.io.atomic import atomic_path, checked_path
from lightfield_gs.io.file_kinds import refuse_stand_in

_PACKAGE = Path(__file__).resolve().parents[1]
MOST_BYTES = 1 << 16  # of a YAML file, whose reader takes up to a second for them


def read_text(path: str | Path, limit_bytes: int, kind: str, errors: str = "strict") -> str:
    """Read a text file in UTF-8, UTF-16 or UTF-32, with or without a byte-order mark.

    Args:
        path: file of at most `limit_bytes`.
        limit_bytes: largest size.
        kind: kind of file, for messages.
        errors: treatment of bytes that cannot be decoded, as in bytes.decode.

    Raises:
        InputError: the file cannot be read, is too large or is no text; the message names it.
    """
    path = checked_path(path)
    refuse_stand_in(path)
    try:
        size = path.stat().st_size
        if size > limit_bytes:
            raise InputError(f"{path}: expected at most {limit_bytes} bytes of {kind}, got {size}")
        return decode_text(path.read_bytes(), errors)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path} is not {kind}: {' '.join(str(error).split())[:200]}") from error


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Decode UTF-8, UTF-16 or UTF-32; raise ValueError for anything else.

    Without a byte-order mark, the zeros among the first bytes tell the encoding: JSON and YAML begin with ASCII
    (RFC 4627, section 3).
    """
    return data.decode(json.detect_encoding(data), errors)


# JSON


def parse_json(text: str) -> Any:
    """Return the value; raise ValueError for malformed or too deeply nested text."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError(str(error)) from None


def read_json(path: str | Path, limit_bytes: int) -> Any:
    """Return the value in a JSON file of at most `limit_bytes`; raise InputError with the file's name."""
    text = read_text(path, limit_bytes, "JSON")
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError(f"{path} is not JSON: {' '.join(str(error).split())[:200]}") from error


def read_object(path: str | Path, limit_bytes: int) -> dict[str, Any]:
    """Return the object in a JSON file of at most `limit_bytes`; raise InputError with the file's name."""
    data = read_json(path, limit_bytes)
    if not isinstance(data, dict):
        raise InputError(f'{path}: expected an object {{"key": value}}, got {type(data).__name__}')
    return data


def write_json(data: Any, path: str | Path) -> None:
    """Write data as JSON, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


# YAML


def read_mapping(path: str | Path, required: Collection[str], optional: Collection[str]) -> dict[str, Any]:
    """Read the mapping in a YAML file of at most 64 KiB.

    Args:
        path: the file.
        required: keys that must be present.
        optional: further keys that may be present.

    Raises:
        InputError: the file cannot be read, is no mapping, lacks a required key or has an unknown one.
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
    """Return SafeLoader with stricter rules.

    Aliases are refused, since a small file could grow without bound, and so are tags and repeated keys. 1e-5 is a
    number, as in YAML 1.2. 010 and 1:30 are refused: before YAML 1.2 they are 8 and 90.
    """
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
        return constructors[node.tag](loader, node)

    constructors = dict(Loader.yaml_constructors)
    for tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float"):
        Loader.add_constructor(tag, plain_number)
    Loader.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
    )
    return Loader


def check_keys(data: dict[str, Any], required: Collection[str], optional: Collection[str], where: str) -> None:
    """Raise InputError for missing keys, and for unknown keys with the nearest known one."""
    known = [*required, *optional]
    for key in data:
        if key not in known:
            near = nearest(str(key), known)
            hint = f"did you mean '{near}'?" if near else f"known: {', '.join(known)}"
            raise InputError(f"{where}: unknown key '{str(key)[:60]}'; {hint}")
    missing = [key for key in required if key not in data]
    if missing:
        raise InputError(f"{where}: missing {', '.join(missing)}")


def write_mapping(path: str | Path, data: dict[str, Any]) -> None:
    """Write a mapping of JSON-like values atomically, one key a line; floats keep every digit."""
    with atomic_path(path) as temporary:
        lines = [f"{key}: {json.dumps(value)}\n" for key, value in data.items()]
        temporary.write_text("".join(lines), encoding="utf-8")


# Configurations, installed or in a source checkout


def config_folder(kind: str) -> Path:
    """Return the folder of the configurations of one kind: "panels", "models" or "training".

    Raises:
        InputError: neither the installed package nor a source checkout has it.
    """
    for root in (_PACKAGE / "configs", _PACKAGE.parent / "configs"):
        if (root / kind).is_dir():
            return root / kind
    raise InputError(f"no folder configs/{kind} in {_PACKAGE} or beside it; reinstall lightfield-gs")


def config_names(kind: str) -> list[str]:
    """Return the names of the configurations of one kind, sorted."""
    return sorted(path.stem for path in config_folder(kind).glob("*.yaml"))


def config_path(kind: str, name: str, others: Collection[str] = ()) -> Path:
    """Return the path of configs/<kind>/<name>.yaml; raise InputError with the known names, the nearest first.

    Args:
        kind: See config_names.
        name: name of the configuration.
        others: names that the caller knows without a file.
    """
    names = config_names(kind)
    if name in names:
        return config_folder(kind) / f"{name}.yaml"
    names = [*names, *others]
    near = nearest(name, names)
    hint = f"did you mean '{near}'? " if near else ""
    raise InputError(f"unknown name '{name}' in configs/{kind}; {hint}known: {', '.join(names)}, or give a file")
