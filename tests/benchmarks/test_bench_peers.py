"""The peers of the benchmarks. Without a GPU our own renderer stands in for gsplat: what is tested is all round it."""

import types

import pytest
import torch

from benchmarks import peers
from lightfield_gs import encode
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.panels.panel import Panel
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

PANEL = Panel(width_px=96, height_px=48, views=7, line_number=6.3, slant_tan=0.2, phase=1.5, subpixel_order="BGR")


def stand_in(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, sh_degree, backgrounds, packed, **options
):
    """gsplat.rasterization as its documentation describes it, drawn by ours; colours [..., N, 3] or harmonics."""
    assert options == {"rasterize_mode": "classic", "eps2d": 0.3, "near_plane": 0.01, "radius_clip": 0.0}
    assert packed is False and bool((backgrounds == 1).all()) and backgrounds.shape == viewmats.shape[:-2] + (3,)
    sh = (colors - 0.5).unsqueeze(-2) / 0.28209479177387814 if sh_degree is None else colors
    assert sh.shape[-2] == ((sh_degree or 0) + 1) ** 2
    cameras = Cameras(viewmats, torch.stack([Ks[..., 0, 0], Ks[..., 1, 1]], -1), Ks[..., :2, 2], width, height)
    image, alpha, *_ = render(Gaussians(means, quats, scales, opacities, sh), cameras, background=(1, 1, 1), alpha=True)
    return image, alpha.unsqueeze(-1), {}


@pytest.fixture
def gsplat(monkeypatch):
    module = types.SimpleNamespace(rasterization=stand_in, __version__="0")
    monkeypatch.setattr(peers, "gsplat", lambda: module)
    peers._interlace_plan.cache_clear()


@pytest.mark.parametrize("views_a_call", [1, 3, 7, 100])
@pytest.mark.parametrize("sh_degree", [0, 2])
def test_gsplat_classic_takes_every_subpixel_from_its_view(gsplat, monkeypatch, views_a_call, sh_degree):
    monkeypatch.setattr(peers, "BYTES_AT_A_TIME", views_a_call * 20 * 96 * 48)
    gaussians = load_scene("sheet:16", sh_degree)
    rig = benchmark_rig("sheet:16", gaussians, PANEL, 20.0)
    image = peers.GsplatClassic(gaussians, PANEL, rig)()
    expected = encode(gaussians, PANEL, rig, "classic")
    assert image.dtype == torch.uint8 and image.shape == expected.shape
    # The limits of the Jacobian are a camera's own here and the rig's there
    assert int((image.int() - expected.int()).abs().max()) <= 1
    assert float((image != expected).double().mean()) < 0.01


def test_gsplat_images_of_a_batch_and_their_gradients(gsplat):
    scenes = [load_scene("sheet:8", 1), load_scene("cloud:64", 1)]
    batch = Gaussians(*(torch.stack(field).requires_grad_() for field in zip(*(s.fields().values() for s in scenes))))
    cameras = benchmark_rig("sheet:8", scenes[0], PANEL, 20.0).cameras(PANEL).to(torch.float32)
    image, coverage = peers.gsplat_images(batch, cameras)
    expected, alpha, *_ = render(batch, cameras, background=(1, 1, 1), alpha=True)
    assert image.shape == (2, 7, 48, 96, 3) and coverage.shape == (2, 7, 48, 96, 1)
    assert torch.equal(image, expected) and torch.equal(coverage.squeeze(-1), alpha)
    gradients = torch.autograd.grad(image.sum() + coverage.sum(), list(batch.fields().values()))
    assert all(bool(torch.isfinite(g).all()) and bool(g.any()) for g in gradients)


def test_gsplat_draws_nearly_our_image():
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    pytest.importorskip("gsplat")
    gaussians = load_scene("sheet:32", 3).to("cuda")
    rig = benchmark_rig("sheet:32", gaussians, PANEL, 20.0)
    peer = peers.GsplatClassic(gaussians, PANEL, rig)
    difference = (peer().int() - encode(gaussians, PANEL, rig).int()).float() / 255
    assert float(difference.square().mean()) < 1e-4  # 40 dB: its cut-offs differ from ours
    assert set(peer.counted()["stages_ms"]) == {"dense views", "interlace"}


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_gsplat_without_a_gpu_is_named():
    with pytest.raises(InputError, match="GPU"):
        peers.gsplat()
