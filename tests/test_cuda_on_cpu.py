"""The CUDA stages, compiled for the CPU (tests/cuda_on_cpu): the logic of their kernels is tested without a GPU."""

from __future__ import annotations

import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from cuda_on_cpu import cases

from lightfield_gs import encode

FOLDER = Path(__file__).parent / "cuda_on_cpu"
CSRC = FOLDER.parents[1] / "csrc"

if platform.machine() != "x86_64" or shutil.which("g++") is None or not Path("/usr/include/hwy").exists():
    pytest.skip("needs g++ on x86-64, and the packages of GLM and Highway", allow_module_level=True)
pybind11 = pytest.importorskip("pybind11")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def module(tmp_path_factory) -> str:
    """The native module with emulated CUDA stages."""
    out = tmp_path_factory.mktemp("cuda_on_cpu")
    built = subprocess.run([sys.executable, FOLDER / "build.py", CSRC, out, pybind11.get_include()], check=True,
                           capture_output=True, text=True)
    return built.stdout.strip()


def drawn(module: str, what: str, folder: Path) -> Any:
    run = subprocess.run([sys.executable, FOLDER / "draw.py", module, what, folder / "out.pt"], capture_output=True,
                         text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    return torch.load(folder / "out.pt", weights_only=True)


@pytest.mark.parametrize("kernel, mean_square", [("pixel", 1e-7), ("pixel-quadratic", 1e-8), ("ordinal", 1e-8)])
def test_frames_are_those_of_the_cpu(module, kernel, mean_square, tmp_path):
    for (name, degree, views), found in zip(cases.frames_of(kernel), drawn(module, kernel, tmp_path), strict=True):
        panel = cases.panel_of(name)
        expected = encode(cases.scene_of(degree), panel, cases.rig_of(panel), views=views, background=cases.BACKGROUND,
                          output="float32")
        error = (found["image"] - expected).abs()
        assert found["kernel"] == kernel and (error > 1 / 255).sum() <= 1, name
        assert (error**2).mean() < mean_square, (name, degree, views)


def test_images_and_gradients_are_those_of_float64(module, tmp_path):
    found = drawn(module, "dense", tmp_path)
    for name, expected in cases.dense_step(torch.float64).items():
        error = (found[name].double() - expected).norm() / expected.norm()
        assert error < (1e-5 if name in ("image", "alpha", "depth") else 1e-3), name
