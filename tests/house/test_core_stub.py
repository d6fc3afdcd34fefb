"""lightfield_gs/_core/*.pyi are what csrc/bind/stubs.py writes for the native module: `make stubs` writes them anew."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

import lightfield_gs
from lightfield_gs import _core

STUBS = Path(lightfield_gs.__file__).parent / "_core"
GENERATOR = Path(__file__).parents[2] / "csrc/bind/stubs.py"
SUBMODULES = ["float32", "float64", "cuda"]


def without_cuda(text: str) -> str:
    """A stub as a build for the CPU only has it."""
    return text.replace("from . import cuda\n", "").replace("'cuda', ", "")


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, str]:
    pytest.importorskip("pybind11_stubgen", reason="needs pybind11-stubgen, of the extra `test`")
    write = runpy.run_path(str(GENERATOR))["write"]
    return {path.name: path.read_text() for path in write(tmp_path_factory.mktemp("stubs"))}


def test_stubs_are_what_the_generator_writes(written):
    expected = {path.name: path.read_text() for path in STUBS.glob("*.pyi")}
    if not hasattr(_core, "cuda"):
        del expected["cuda.pyi"]
        expected = {name: without_cuda(text) for name, text in expected.items()}
    assert written == expected


@pytest.mark.parametrize("submodule", ["", *SUBMODULES])
def test_every_argument_has_a_name(submodule):
    if submodule and not hasattr(_core, submodule):
        pytest.skip("built for the CPU only")

    def unnamed(owner: Any) -> list[str]:
        found = []
        for name, value in vars(owner).items():
            if isinstance(value, type):
                found += unnamed(value)
            elif re.search(r"\barg\d+: ", getattr(value, "__doc__", None) or ""):
                found.append(name)
        return found

    assert unnamed(getattr(_core, submodule) if submodule else _core) == []
