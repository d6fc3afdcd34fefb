"""Photos on a GPU: the replayed stages against the CPU's. Needs a GPU."""

import warnings

import numpy as np
import pytest
import torch
from cuda_on_cpu import crop_cases, png_cases, sheet_cases, surface_cases
from cuda_on_cpu.cases import NORMS, norm_case, norm_expected
from photo_cases import PANEL, photo, psnr_db, tiny_net

from lightfield_gs import InputError, PhotoEncoder, Rig, SplatterNet, _core, encode, from_depth
from lightfield_gs.models.splatter_net import PRETRAINED
from lightfield_gs.models.unet import group_norm_silu
from lightfield_gs.panels.rig import frame_photo
from lightfield_gs.photo.detail_level import detail_level

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)


def of_the_cpu(net: SplatterNet, rgba: np.ndarray, detail=None, **options) -> tuple[torch.Tensor, Rig]:
    gaussians = net.cpu().predict(rgba, detail_level(detail, net.config, max(rgba.shape), PANEL))
    rig = frame_photo(gaussians, PANEL)
    return encode(gaussians, PANEL, rig, **options), rig


@pytest.mark.parametrize("shape", [(40, 90), (200, 30), (300, 300)])
@pytest.mark.parametrize("views", ["integer", "continuous"])
def test_image_is_that_of_the_cpu(shape, views):
    rgba, options = photo(*shape), dict(views=views, background=(0.2, 0.5, 0.9))
    encoder = PhotoEncoder(tiny_net().cuda(), PANEL, **options)
    found = encoder(rgba)
    expected, rig = of_the_cpu(tiny_net(), rgba, **options)
    assert found.is_cuda and psnr_db(found, expected) > 38
    assert encoder.rig.focal_px == pytest.approx(rig.focal_px, rel=0.01)
    assert encoder.rig.zero_depth == pytest.approx(rig.zero_depth, rel=0.01)


@pytest.mark.skipif(not PRETRAINED.exists(), reason="this checkout has no trained checkpoint")
def test_the_trained_network_draws_what_the_cpu_draws():
    rgba = photo(400, 300)
    found = PhotoEncoder(SplatterNet.from_pretrained().cuda(), PANEL)(rgba)
    assert psnr_db(found, of_the_cpu(SplatterNet.from_pretrained(), rgba)[0]) > 38


@pytest.mark.parametrize("detail", [1, 2, "auto"])
def test_a_photo_is_laid_over_the_prediction_as_on_the_cpu(detail):
    rgba = photo(300, 300)
    encoder = PhotoEncoder(tiny_net().cuda(), PANEL, detail=detail)
    for _ in range(2):
        assert psnr_db(encoder(rgba), of_the_cpu(tiny_net(), rgba, detail)[0]) > 35


def test_photos_of_one_size_are_replayed_and_others_captured():
    encoder = PhotoEncoder(tiny_net().cuda(), PANEL)
    photos = [photo(60, 80), photo(60, 80, (0.1, 0.3, 0.8)), np.roll(photo(60, 80), 9, 1)]
    encoder(photos[0])
    captured = encoder._captured
    images = [encoder(rgba) for rgba in photos]
    assert encoder._captured is captured
    for rgba, image in zip(photos, images):
        assert psnr_db(image, of_the_cpu(tiny_net(), rgba)[0]) > 38
    assert psnr_db(encoder(photo(61, 80)), of_the_cpu(tiny_net(), photo(61, 80))[0]) > 38
    assert encoder._captured is not captured


def test_a_rig_of_all_photos_makes_the_frame_a_graph_that_draws_each():
    photos = [photo(60, 80), photo(60, 80, (0.1, 0.3, 0.8)), np.roll(photo(60, 80), 9, 1)]
    rig = PhotoEncoder(tiny_net(), PANEL)
    rig(photos[0])
    encoder = PhotoEncoder(tiny_net().cuda(), PANEL, rig=rig.rig)
    for rgba in [*photos, photos[0]]:
        expected = encode(tiny_net().predict(rgba), PANEL, rig.rig)
        assert psnr_db(encoder(rgba), expected) > 38
    with pytest.raises(InputError, match="empty mask"):
        encoder(np.zeros_like(photos[0]))
    assert psnr_db(encoder(photos[1]), encode(tiny_net().predict(photos[1]), PANEL, rig.rig)) > 38


def test_bytes_and_tensors_on_the_device_are_taken():
    encoder = PhotoEncoder(tiny_net().cuda(), PANEL)
    as_bytes = np.round(255 * photo(50, 60)).astype(np.uint8)
    expected = encoder(as_bytes)
    assert torch.equal(encoder(torch.from_numpy(as_bytes).cuda()), expected)
    assert psnr_db(encoder(as_bytes / np.float32(255)), expected) > 60


def test_the_host_waits_once():
    encoder, rgba = PhotoEncoder(tiny_net().cuda(), PANEL), photo(60, 80)
    encoder(rgba)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            encoder(rgba)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len([w for w in caught if "synchroniz" in str(w.message)]) == 1


@pytest.mark.parametrize(
    "rgba, word",
    [
        (np.zeros((8, 8, 3), np.float32), "H,W,4"),
        (np.zeros((8, 8, 4), np.float32), "mask"),
        (np.full((8, 8, 4), 2, np.float32), "0..1"),
        (np.full((8, 8, 4), np.nan, np.float32), "0..1"),
    ],
)
def test_what_is_no_photo_is_refused_and_the_next_is_drawn(rgba, word):
    encoder = PhotoEncoder(tiny_net().cuda(), PANEL)
    for _ in range(2):
        with pytest.raises(InputError, match=word):
            encoder(rgba)
        assert psnr_db(encoder(photo(60, 80)), of_the_cpu(tiny_net(), photo(60, 80))[0]) > 38


def test_stages_are_timed():
    stats = {}
    PhotoEncoder(tiny_net().cuda(), PANEL)(photo(60, 80), stats)
    assert list(stats["stages_ms"]) == ["crop", "network", "framing", "encode"]


@pytest.mark.parametrize("case", surface_cases.CASES)
def test_the_surface_of_the_sheet_is_that_of_pytorch(case):
    surface_cases.compare(case, surface_cases.found(case, "cuda"))


@pytest.mark.parametrize("case", sheet_cases.CASES)
def test_texels_are_those_of_pytorch(case):
    sheet_cases.compare(case, sheet_cases.laid(case, "cuda"))


def test_photos_are_cropped_as_on_the_host():
    crop_cases.compare([crop_cases.cropped(case, "cuda") for case in crop_cases.CASES], crop_cases.refused("cuda"))


def test_a_photo_with_depths_is_the_scene_of_the_cpu():
    """A disc with a soft outline before a wall."""
    rows, columns = np.mgrid[:60, :90]
    distance = np.hypot(rows - 30, columns - 45)
    inside = np.clip(20.5 - distance, 0, 1)[..., None]
    wall = np.stack([0.4 + 0.2 * np.sin(columns / 5), 0.5 + 0.2 * np.cos(rows / 4), 0.3 + 0 * rows], 2)
    image = (inside * (0.9, 0.2, 0.1) + (1 - inside) * wall).astype(np.float32)
    depth = np.where(distance < 20.5, 1.0, 3.0).astype(np.float32)
    here, there, again = (from_depth(torch.from_numpy(image).to(device), depth) for device in ("cpu", "cuda", "cuda"))
    assert there.means.is_cuda and there.count == here.count > 60 * 90
    for name, field in here.fields().items():
        found = there.fields()[name]
        assert torch.equal(found, again.fields()[name])
        apart = (found.cpu() - field).abs().reshape(len(field), -1) / (1 + field.abs().reshape(len(field), -1))
        assert apart[: 60 * 90].max() < 5e-5 and (name == "sh" or apart.max() < 5e-5), name
        # Of two patches behind the disc that fit alike, each device may take another: both are of the wall
        assert apart[60 * 90 :].mean() < 0.1, name


@pytest.mark.parametrize("name", png_cases.IMAGES)
def test_images_are_compressed_for_png(name, tmp_path):
    png_cases.compare(name, png_cases.compressed(name, "cuda"), tmp_path)


@pytest.mark.parametrize("case", NORMS)
@torch.no_grad()
def test_group_norm_and_silu(case, monkeypatch):
    norm, features = norm_case(*case)
    monkeypatch.setattr(torch.nn.GroupNorm, "forward", lambda *arguments: pytest.fail("PyTorch's was called"))
    found = group_norm_silu(norm.cuda(), features.cuda())
    torch.testing.assert_close(found.cpu().double(), norm_expected(norm.cpu(), features), rtol=2**-8, atol=2e-5)
    assert found.is_contiguous(memory_format=torch.channels_last)


@torch.no_grad()
def test_group_norm_keeps_what_is_no_number():
    norm, features = norm_case(*NORMS[0])
    features[0, -1, 2, 3] = float("nan")  # in the last group of the first image
    found, expected = group_norm_silu(norm.cuda(), features.cuda()).cpu(), norm_expected(norm.cpu(), features)
    assert expected.isnan().any() and torch.equal(found.isnan(), expected.isnan())
