"""The adapter of the tests: a GPU, or Mesa's lavapipe (Debian: mesa-vulkan-drivers), a program of the CPU."""

from collections.abc import Iterator

import pytest

from lightfield_gs.webgpu.adapters import ALLOW_CPU, adapters
from lightfield_gs.webgpu.devices import frames_on
from lightfield_gs.webgpu.frames import Frames


@pytest.fixture(autouse=True)
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ALLOW_CPU, "1")


@pytest.fixture
def frames(allowed) -> Iterator[Frames]:
    """The frames of the first adapter, as they are after the test what they were before."""
    pytest.importorskip("wgpu", reason="needs the package wgpu: pip install 'lightfield-gs[webgpu]'")
    if not adapters():
        pytest.skip("needs an adapter for WebGPU (Debian: mesa-vulkan-drivers)")
    frames = frames_on(0)
    before = dict(vars(frames))
    yield frames
    vars(frames).update(before)
