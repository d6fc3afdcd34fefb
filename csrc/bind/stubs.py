"""Write the stubs of the native module for editors and type checkers, with pybind11-stubgen.

`python csrc/bind/stubs.py OUT` writes OUT/_core/*.pyi. LFGS_CORE=FILE reads another build of the module; only a build
with CUDA has all of it. `make stubs` writes the stubs of the repository.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import pybind11_stubgen

MODULE = "lightfield_gs._core"
# pybind11 converts whatever has __int__ or __float__; callers pass numbers, and addresses as integers.
NUMBERS = {"typing.SupportsInt | typing.SupportsIndex": "int", "typing.SupportsFloat | typing.SupportsIndex": "float"}


def load(path: str) -> None:
    """Load another build of the native module under the name of the installed one."""
    specification = importlib.util.spec_from_file_location(MODULE, path)
    assert specification is not None and specification.loader is not None
    sys.modules[MODULE] = module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)


def write(out: Path) -> list[Path]:
    """Write the stubs of the loaded module to `out`/_core, without values, which differ between builds."""
    with tempfile.TemporaryDirectory() as folder:
        pybind11_stubgen.main([MODULE, "--output-dir", folder, "--exit-code"])
        shutil.copytree(Path(folder, *MODULE.split(".")), out / "_core", dirs_exist_ok=True)
    stubs = sorted((out / "_core").glob("*.pyi"))
    for path in stubs:
        text = path.read_text()
        for verbose, plain in NUMBERS.items():
            text = text.replace(verbose, plain)
        path.write_text(re.sub(r"^((?!__all__)\w+: [\w.\[\]]+) = .*$", r"\1", text, flags=re.MULTILINE))
    return stubs


if __name__ == "__main__":
    if os.environ.get("LFGS_CORE"):
        load(os.environ["LFGS_CORE"])
    for stub in write(Path(sys.argv[1])):
        print(stub)
