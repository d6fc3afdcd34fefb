"""The validator's messages on a set with a faulty object, in either layout."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lightfield_gs.base.errors import InputError
from training.data.cache import load_set
from training.data.objects import find_objects
from training.data.validate import main, problems


def assert_fault_is_named(folder: Path, pattern: str, capsys: pytest.CaptureFixture[str]) -> None:
    """folder/set: every line names the object set/bad and matches the pattern; nothing is loaded from the set."""
    found = list(problems(find_objects(folder / "set")))
    assert found and all(re.search(pattern, line) and "set/bad" in line and "\n" not in line for line in found)
    assert main([str(folder / "set")]) == 2
    assert capsys.readouterr().err.splitlines() == found
    with pytest.raises(InputError):
        load_set(folder / "set", folder / "cache", workers=1)
