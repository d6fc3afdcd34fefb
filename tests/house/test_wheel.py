"""The wheel: what is in it, how large it is, and that it runs where there is no compiler."""

import re
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from lightfield_gs import _core

pytest.importorskip("scikit_build_core")
ROOT = Path(__file__).parents[2]
pytestmark = [pytest.mark.wheel, pytest.mark.not_sanitized]
# The network that photos need comes along: its weights take 12.2 MB and hardly shrink. All else takes 1.6 MB, the
# module of the CPU stages half of it. More would be what does not belong there: symbols for debuggers, photographs of
# tests, a second network.
MOST_BYTES, MOST_BESIDE_THE_NETWORK = 15_000_000, 2_500_000


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Of the CPU stages, as it is published. It takes the objects of `make setup`; where these have CUDA stages, it is
    compiled in a folder of its own."""
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", out, ROOT]
    if hasattr(_core, "cuda"):
        command += ["-C", "cmake.define.LFGS_CUDA=OFF", "-C", "build-dir=build/wheel"]
    subprocess.run(command, check=True)
    (found,) = out.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def bare(wheel, tmp_path_factory) -> Path:
    """Return the folder of programs of an environment with the wheel.

    Of this environment it sees only packages that are imported by their path: neither its programs nor its install of
    the package.
    """
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder, with_pip=False)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "borrowed.pth").write_text("\n".join(p for p in sys.path if "-packages" in p))
    python = folder / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps", "--no-index", wheel]
    subprocess.run([*install, "--ignore-installed"], check=True)
    return folder / "bin"


def run(bare: Path, *words: object) -> str:
    """Return the output of a program of the bare environment, with nothing else on PATH."""
    environment = {"PATH": str(bare), "HOME": str(bare.parent), "OMP_NUM_THREADS": "1"}
    assert not any(
        shutil.which(name, path=str(bare)) for name in ("cc", "c++", "gcc", "g++", "clang", "cmake", "ninja")
    )
    done = subprocess.run(
        [bare / str(words[0]), *map(str, words[1:])], capture_output=True, text=True, env=environment, cwd=bare.parent
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_holds_the_module_the_panels_and_no_more(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert sum(bool(re.fullmatch(r"lightfield_gs/_core\..*(so|pyd)", name)) for name in names) == 1
    assert any(name.startswith("lightfield_gs/configs/panels/") for name in names) or any(
        "configs/" in n for n in names
    )
    assert not any(re.match(r"(tests|csrc|training|benchmarks|docs|notebooks)/|.*banana", name) for name in names)


def test_its_size(wheel):
    with zipfile.ZipFile(wheel) as archive:
        network = sum(i.compress_size for i in archive.infolist() if i.filename.endswith(".safetensors"))
    size = wheel.stat().st_size
    print(f"{wheel.name}: {size:,} bytes, {network:,} of them the network")
    assert size < MOST_BYTES and size - network < MOST_BESIDE_THE_NETWORK


def test_it_runs_without_a_compiler(bare, tmp_path):
    where = run(bare, "python", "-c", "import lightfield_gs; print(lightfield_gs.__file__)")
    assert Path(where.strip()).is_relative_to(bare.parent)
    assert "encode" in run(bare, "lightfield-gs", "--help")
    out = tmp_path / "cat.png"
    run(bare, "lightfield-gs", "encode", ROOT / "lightfield_gs" / "data" / "cat.png", "-o", out, "--panel", "toy-8v")
    assert "toy-8v" in run(bare, "lightfield-gs", "info", out)
