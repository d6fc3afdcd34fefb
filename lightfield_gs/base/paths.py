"""Where the package's own configuration files are, installed or in a source checkout."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError

FOLDER_GONE = "the working folder has been removed: change to one that is there (cd)"
_PACKAGE = Path(__file__).resolve().parents[1]


def config_folder(kind: str) -> Path:
    """Folder of the configurations of one kind ("panels", "models", "training").

    Raises InputError when neither the installed package nor a source checkout has it.
    """
    for root in (_PACKAGE / "configs", _PACKAGE.parent / "configs"):
        if (root / kind).is_dir():
            return root / kind
    raise InputError(f"no folder configs/{kind} in {_PACKAGE} or beside it; reinstall lightfield-gs")


def config_names(kind: str) -> list[str]:
    """Names of the configurations of one kind, sorted."""
    return sorted(path.stem for path in config_folder(kind).glob("*.yaml"))


def config_path(kind: str, name: str) -> Path:
    """Path of configs/<kind>/<name>.yaml.

    Raises InputError that lists the known names, the nearest first.
    """
    names = config_names(kind)
    if name in names:
        return config_folder(kind) / f"{name}.yaml"
    near = difflib.get_close_matches(name, names, 1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    raise InputError(f"unknown name '{name}' in configs/{kind}; {hint}known: {', '.join(names)}, or give a file")


def has_working_folder() -> bool:
    """Whether the working folder is still there: without it no relative path leads anywhere, and torch cannot begin."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


def checked_path(path: str | os.PathLike) -> Path:
    """`path` as a Path; raises InputError where it is none."""
    expect("path", path, str, os.PathLike)
    try:
        bad = b"\0" in os.fsencode(path)
    except UnicodeEncodeError:
        bad = True
    if bad:
        raise InputError(f"path: expected a file name, got one that none can have, {ascii(os.fspath(path))[:80]}")
    return Path(path)
