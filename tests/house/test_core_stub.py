"""lightfield_gs/_core.pyi says what the native module has: the same names, with the same arguments."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import lightfield_gs
from lightfield_gs import _core

STUB = ast.parse((Path(lightfield_gs.__file__).parent / "_core.pyi").read_text())
OF_THE_STUB = {"Address", "_Stages", "_Cuda"}  # alone
SUBMODULES = {"float32": "_Stages", "float64": "_Stages", "cuda": "_Cuda"}
Names = dict[str, Any]  # of functions: the arguments of each overload; of classes: their own names; of others: None


def in_stub(body: list[ast.stmt]) -> Names:
    """Names that the stub gives to a module or a class."""
    names: Names = {}
    for node in body:
        if isinstance(node, ast.ClassDef):
            names[node.name] = in_stub(node.body)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names[node.target.id] = None
        elif isinstance(node, ast.FunctionDef):
            if any(isinstance(mark, ast.Name) and mark.id == "property" for mark in node.decorator_list):
                names[node.name] = None
            else:
                arguments = [argument.arg for argument in node.args.args + node.args.kwonlyargs]
                names.setdefault(node.name, []).append([name for name in arguments if name != "self"])
    return names


def arguments_of(function: Any) -> list[list[str]]:
    """Names of the arguments of each overload, from the signatures that pybind11 writes."""
    lines = (function.__doc__ or "").strip().splitlines()
    signatures = [line for line in lines if re.match(r"\d+\. ", line)] or lines[:1]
    found = [re.findall(r"[(,] ?(\w+): ", re.sub(r"\[[^\]]*\]", "", line)) for line in signatures]
    return [[name for name in names if name != "self"] for names in found]


def in_module(owner: Any) -> Names:
    """The same of a module, or of a class of it."""
    names: Names = {}
    for name, value in vars(owner).items():
        signed = callable(value) and f"{name}(" in (value.__doc__ or "")
        if isinstance(value, ModuleType) or (name.startswith("_") and not (name == "__init__" and signed)):
            continue
        if isinstance(value, type):
            names[name] = in_module(value)
        else:
            names[name] = arguments_of(value) if signed else None
    return names


def test_the_module_is_as_its_stub_says():
    names = {name: what for name, what in in_stub(STUB.body).items() if name not in OF_THE_STUB | set(SUBMODULES)}
    assert in_module(_core) == names


@pytest.mark.parametrize("submodule", SUBMODULES)
def test_submodules_are_as_the_stub_says(submodule):
    if not hasattr(_core, submodule):
        pytest.skip("built for the CPU only")
    assert in_module(getattr(_core, submodule)) == in_stub(STUB.body)[SUBMODULES[submodule]]


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
