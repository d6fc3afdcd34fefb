"""Adapters by name, and the commands that draw on them."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run
from photo_cases import photo, tiny_net
from PIL import Image
from rasterizer_cases import panel, random_scene, rig

import lightfield_gs as lf
from lightfield_gs import Encoder, PhotoEncoder, Rig, encode
from lightfield_gs.base.assumptions import Fallback
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.quilt import quilt
from lightfield_gs.panels.quilt import QuiltLayout
from lightfield_gs.show.page.stage import Controls, Stage, StagedScene
from lightfield_gs.webgpu import adapters as module
from lightfield_gs.webgpu import devices, self_test
from lightfield_gs.webgpu.adapters import ALLOW_CPU, Adapter, adapter_at, adapters
from lightfield_gs.webgpu.buffers import Limits
from lightfield_gs.webgpu.frames import Frames

# The drivers of GPUs are not ours, and what is drawn on the CPU is tested elsewhere
pytestmark = pytest.mark.not_sanitized


def adapter(kind: str) -> Adapter:
    return Adapter("X1", kind, "Vulkan", "", Limits(1 << 27, 1 << 28), None)


def test_equal_cards_are_adapters_each_and_a_second_way_to_one_is_none(monkeypatch):
    def gpu(name: str, kind: str, backend: str) -> SimpleNamespace:
        info = {"device": name, "adapter_type": kind, "backend_type": backend, "description": ""}
        limits = {"max-storage-buffer-binding-size": 1 << 27, "max-buffer-size": 1 << 28}
        return SimpleNamespace(info=info, limits=limits)

    card, ways = ("X1", "DiscreteGPU"), ("D3D12", "Vulkan", "OpenGL")
    gpus = [gpu("llvmpipe", "CPU", "Vulkan"), *(gpu(*card, backend) for backend in ways), gpu(*card, "Vulkan")]
    monkeypatch.setattr(module, "missing", lambda: None)
    there = SimpleNamespace(gpu=SimpleNamespace(enumerate_adapters_sync=lambda: gpus))
    monkeypatch.setitem(sys.modules, "wgpu", there)
    found = adapters.__wrapped__()
    assert [adapter.gpu for adapter in found] == [gpus[2], gpus[4], gpus[0]]


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


# Encoders and other commands


def test_an_encoder_draws_and_keeps_an_unchanged_frame(frames):
    shown = panel()
    gaussians = random_scene(60, 1, dtype=torch.float32)
    fan = rig(shown, 0.1)
    encoder = Encoder(shown, fan, background=(0.1, 0.6, 0.3), device="webgpu")
    images = [encoder(gaussians) for _ in range(3)]
    assert torch.equal(images[0], encode(gaussians, shown, fan, background=(0.1, 0.6, 0.3), device="webgpu"))
    assert torch.equal(images[0], images[2]) and encoder.stats["reused"]["composite"] == 1
    gaussians.sh[:] = gaussians.sh.flip(0)  # which a device that keeps harmonics must not miss
    assert torch.equal(encoder(gaussians), encode(gaussians, shown, fan, background=(0.1, 0.6, 0.3), device="webgpu"))
    encoder.rig = rig(shown, -0.1)
    assert torch.equal(
        encoder(gaussians), encode(gaussians, shown, encoder.rig, background=(0.1, 0.6, 0.3), device="webgpu")
    )


def test_a_quilt_has_the_views_of_the_cpu(frames):
    layout = QuiltLayout(3, 2, 0.75, 96, 86)
    gaussians, fan = random_scene(60, 2, dtype=torch.float32), Rig(np.eye(4), (40, 40), (16, 21), 2.0, 60.0)
    for options in ({}, {"antialiased": True, "view_filter": 1.5}):
        a, b = (quilt(gaussians, layout, fan, device=where, **options) for where in ("webgpu", None))
        assert b.float().std() > 20 and (a.int() - b.int()).abs().max() <= 1


def test_a_photo_encoder_draws_on_the_adapter(frames):
    net, rgba = tiny_net(), photo(40, 60)
    a, b = (PhotoEncoder(net, PANEL, device=where)(rgba) for where in ("webgpu", None))
    assert (a.int() - b.int()).abs().max() <= 1


def test_commands_draw_on_the_adapter(frames, folder, capsys):
    for where in ("cpu", "webgpu"):
        run(capsys, f"video s.ply -o {where} --panel p.yaml --turntable 1 --fps 2 --device {where}")
        run(capsys, f"quilt s.ply -o {where}.png --tiles 2x2 --size 64x64 --device {where}")
    names = [path.name for path in sorted(folder.glob("cpu/*.png"))]
    assert len(names) == 2
    pairs = [(f"cpu/{name}", f"webgpu/{name}") for name in names]
    pairs.append(tuple(str(next(folder.glob(f"{where}_qs*.png"))) for where in ("cpu", "webgpu")))
    for one, other in pairs:
        a, b = (np.asarray(Image.open(name)).astype(int) for name in (one, other))
        assert a.std() > 5 and np.abs(a - b).max() <= 1


def test_the_page_draws_on_the_adapter(frames):
    gaussians, fan = random_scene(60, dtype=torch.float32), rig(PANEL)
    a, b = (Stage(StagedScene(gaussians, fan), PANEL, where).native(Controls())[0] for where in ("webgpu", None))
    assert np.abs(a.astype(int) - b.astype(int)).max() <= 1


# Devices that fail, and the choice of one


def test_a_lost_device_is_one_line_and_the_cpu_goes_on(frames, monkeypatch):
    monkeypatch.setattr(devices, "_lost", set())
    lost = Frames(adapters()[0].open(), frames.limits)
    monkeypatch.setattr(devices, "frames_on", lambda index: lost)
    shown, gaussians = panel(), random_scene(60, dtype=torch.float32)
    lost.device.destroy()
    with pytest.warns(Fallback, match="device 'webgpu' failed .*lost.*: the CPU draws in its place") as said:
        image = encode(gaussians, shown, rig(shown), device="webgpu")
    assert len(said) == 1 and "\n" not in str(said[0].message)
    assert torch.equal(image, encode(gaussians, shown, rig(shown)))
    assert torch.equal(image, encode(gaussians, shown, rig(shown), device="webgpu"))  # says no more


def test_the_self_test_compares_and_times(frames, monkeypatch):
    monkeypatch.setattr(self_test, "_SIZE_PX", (160, 90))
    monkeypatch.setattr(self_test, "_COUNT", 300)
    found = self_test.self_test(adapters()[0])
    assert found.is_right and min(found.open_ms, found.frame_ms, found.cpu_ms) > 0
    assert found.words().startswith("exact to 1/255, ")


def test_auto_takes_an_adapter_that_passes_and_pays(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(devices, "adapters", lambda: (adapter("CPU"), adapter("DiscreteGPU")))
    monkeypatch.setattr(devices, "choose_device", lambda name: "cpu")
    tested = []

    def result(apart: int, frame_ms: float) -> None:
        found = self_test.SelfTest(apart, 500.0, frame_ms, 50.0)
        monkeypatch.setattr(self_test, "self_test", lambda adapter: tested.append(adapter) or found)

    pixels = 1920 * 1080
    result(1, 5.0)
    chosen = devices.choose_drawing_device("auto", pixels, 100)
    assert chosen.torch == "cpu" and chosen.webgpu == "webgpu:1" and "X1 (DiscreteGPU, Vulkan)" in chosen.messages[0]
    assert devices.choose_drawing_device("auto", pixels, 1).webgpu is None  # one frame does not pay for the start
    assert devices.choose_drawing_device("auto", 20 * pixels, 1).webgpu == "webgpu:1"
    assert devices.choose_drawing_device("auto", pixels, 0).webgpu is None  # nothing is drawn by direct
    assert devices.choose_drawing_device("cpu", pixels, 100) == devices.DrawingDevice("cpu")
    assert len(tested) == 1  # the result is remembered
    for apart, frame_ms in ((2, 5.0), (0, 60.0)):
        (tmp_path / "lightfield-gs" / "webgpu.json").unlink()
        result(apart, frame_ms)
        assert devices.choose_drawing_device("auto", pixels, 10_000).webgpu is None


def test_auto_starts_no_driver_for_few_pixels(monkeypatch):
    asked = []
    monkeypatch.setattr(devices, "adapters", lambda: asked.append(1) or ())
    monkeypatch.setattr(devices, "choose_device", lambda name: "cpu")
    for pixels, frames, times in ((3840 * 2160, 1, 0), (7680 * 4320, 0, 0), (7680 * 4320, 1, 1), (1920 * 1080, 100, 2)):
        assert devices.choose_drawing_device("auto", pixels, frames) == devices.DrawingDevice("cpu")
        assert len(asked) == times


def test_info_lists_the_devices(frames, capsys):
    lines = run(capsys, "info --devices").splitlines()
    assert [line.split(": ")[0] for line in lines[:3]] == ["cpu", "cuda", "webgpu:0"]
    assert "MiB at once; " in lines[2]
    assert "a FILE or --devices is required, and not both" in complaint(capsys, "info")
    assert "a FILE or --devices is required, and not both" in complaint(capsys, "info s.ply --devices")


def test_a_report_has_all_that_an_issue_needs(frames, capsys, monkeypatch):
    monkeypatch.setattr(self_test, "_SIZE_PX", (160, 90))
    monkeypatch.setattr(self_test, "_COUNT", 300)
    text = run(capsys, "info --devices --report")
    assert f"lightfield-gs {lf.__version__}, wgpu " in text and "max-storage-buffer-binding-size 1" in text
    kernels = [line.split(": ")[0].strip() for line in text.splitlines() if "/255, " in line and "composite" in line]
    assert kernels == ["webgpu-pixel", "webgpu-lens-2", "webgpu-lens-3", "webgpu-lens-6"]
    monkeypatch.delenv(ALLOW_CPU)
    assert "failed: device 'webgpu:0'" in run(capsys, "info --devices --report") or not adapters()[0].is_cpu
    assert "info --devices --report" in complaint(capsys, "info s.ply --report")


def test_bench_measures_each_tiling(frames, folder, capsys):
    run(capsys, "bench webgpu --scene sheet:8 --panel p.yaml --tilings --repeats 1 --json rows.json")
    rows = json.loads((folder / "rows.json").read_text())["rows"]
    assert [row["kernel"] for row in rows[1:]] == ["webgpu-pixel", "webgpu-lens-2", "webgpu-lens-3", "webgpu-lens-6"]
    assert all(row["most_apart"] <= 1 and row["stages_ms"]["composite"] > 0 for row in rows)
