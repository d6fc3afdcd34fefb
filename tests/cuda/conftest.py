"""Fixtures of the tests that run the CUDA sources without a GPU (tests/cuda_on_cpu)."""

from collections.abc import Iterator

import pytest
from cuda_on_cpu.drawings import Drawings, built_once


@pytest.fixture(scope="session")
def emulated(request, tmp_path_factory) -> str:
    """The native module with emulated CUDA stages: one for all processes of pytest-xdist, whose folders are in one."""
    folder = tmp_path_factory.getbasetemp()
    return built_once((folder.parent if hasattr(request.config, "workerinput") else folder) / "cuda_on_cpu")


@pytest.fixture(scope="module")
def drawn(request, emulated, tmp_path_factory) -> Iterator[Drawings]:
    """Return the drawings that the test's file names in DRAWN, by the emulated module."""
    drawings = Drawings(emulated, tmp_path_factory.mktemp("drawn"), request.module.DRAWN)
    yield drawings
    drawings.end()
