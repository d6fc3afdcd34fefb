"""Adapters by name, and the commands that draw on them."""

import numpy as np
import pytest
from command_line import complaint, run
from PIL import Image

from lightfield_gs.base.errors import InputError
from lightfield_gs.webgpu import adapters as module
from lightfield_gs.webgpu.adapters import ALLOW_CPU, Adapter, adapter_at
from lightfield_gs.webgpu.buffers import Limits


def adapter(kind: str) -> Adapter:
    return Adapter("X1", kind, "Vulkan", "", Limits(1 << 27, 1 << 28), None)


def test_encode_draws_the_same_picture(frames, folder, capsys):
    run(capsys, "encode s.ply -o cpu.png --panel p.yaml --device cpu")
    run(capsys, "encode s.ply -o gpu.png --panel p.yaml --device webgpu")
    a, b = (np.asarray(Image.open(name)).astype(int) for name in ("cpu.png", "gpu.png"))
    assert np.abs(a - b).max() <= 1


def test_encode_refuses_what_webgpu_cannot_do(folder, capsys):
    line = "encode s.ply -o x.png --panel p.yaml --device"
    assert "--device webgpu draws by --method direct" in complaint(capsys, f"{line} webgpu --method sorted")
    assert "invalid choice: 'metal' (choose from auto, cpu, cuda, webgpu, webgpu:N)" in complaint(
        capsys, f"{line} metal"
    )


def test_adapters_that_are_programs_are_refused(monkeypatch):
    monkeypatch.setattr(module, "missing", lambda: None)
    monkeypatch.setattr(module, "adapters", lambda: (adapter("IntegratedGPU"), adapter("CPU")))
    monkeypatch.delenv(ALLOW_CPU)
    assert adapter_at(0).kind == "IntegratedGPU"
    with pytest.raises(InputError, match=r"X1 \(CPU, Vulkan\) is a program of the CPU"):
        adapter_at(1)
    with pytest.raises(InputError, match=r"expected 0..1: X1 \(IntegratedGPU, Vulkan\), X1"):
        adapter_at(2)


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setattr(module, "adapters", tuple)
    monkeypatch.setattr(module, "missing", lambda: None)
    with pytest.raises(InputError, match="no adapter .* install the GPU's driver, or use device 'cpu'"):
        adapter_at(0)
    monkeypatch.setattr(module, "missing", lambda: "the package wgpu is not installed; pip install it")
    with pytest.raises(InputError, match="the package wgpu is not installed; .* or use device 'cpu'"):
        adapter_at(0)
