"""The network: its size, its untrained state, cropping, checkpoints and prediction from photos."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from photo_cases import TINY

from lightfield_gs import Cameras, InputError, render
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.models import ModelConfig, SplatterNet
from lightfield_gs.models.composer import parameter_groups
from lightfield_gs.models.crop import Square, crop_resize, object_square
from lightfield_gs.models.initializer import describe_pixels
from lightfield_gs.models.splatter_net import PRETRAINED


def tiny_net(**changes) -> SplatterNet:
    torch.manual_seed(0)
    return SplatterNet(ModelConfig.from_dict(TINY | changes))


def disc(size: int = 32, colour=(0.9, 0.3, 0.1)) -> torch.Tensor:
    """Premultiplied RGBA [1,4,size,size] of a disc whose colour varies."""
    grid = (torch.arange(size) + 0.5) / size
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    alpha = (((x - 0.5) ** 2 + (y - 0.5) ** 2) < 0.36**2).float()
    return torch.stack([*(alpha * value * (0.6 + 0.4 * x) for value in colour), alpha])[None]


def central_intrinsics(size: int = 32) -> torch.Tensor:
    return torch.tensor([[1.4 * size, 1.4 * size, size / 2, size / 2]])


@pytest.mark.parametrize(
    "name, millions, tolerance",
    [("default", 6.6, 0.05), ("small", 6.5, 0.05), ("full-resolution", 6.5, 0.05), ("original", 56.4, 0.02)],
)
def test_parameter_count(name, millions, tolerance):
    with torch.device("meta"):
        net = SplatterNet(ModelConfig.from_yaml(name))
    assert sum(p.numel() for p in net.parameters()) / 1e6 == pytest.approx(millions, rel=tolerance)


@pytest.mark.parametrize("patch", [1, 2])
def test_untrained_network_puts_every_pixel_on_its_line_of_sight(patch):
    size, config = 32, {"patch_px": patch}
    intrinsics = torch.tensor([[40.0, 44.0, 17.5, 12.25]])
    gaussians = tiny_net(**config)(disc(), intrinsics)
    assert gaussians.means.shape == (1, 2 * size * size, 3)
    x, y, z = gaussians.means[0].unbind(-1)
    rows, columns = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    torch.testing.assert_close(40.0 * x / z + 17.5, columns.flatten().repeat(2), atol=1e-3, rtol=0)
    torch.testing.assert_close(44.0 * y / z + 12.25, rows.flatten().repeat(2), atol=1e-3, rtol=0)
    first, second = z.view(2, -1)
    torch.testing.assert_close(first, torch.full_like(first, 1.1))
    assert (second > first).all()
    inside = disc()[0, 3].flatten() > 0
    colours = 0.5 + SH_CONSTANT * gaussians.sh[0, : size * size, 0]
    torch.testing.assert_close(colours[inside], disc()[0, :3].flatten(1).T[inside], atol=1e-5, rtol=0)
    assert (gaussians.opacities[0].view(2, -1)[:, ~inside] < 1 / 255).all()


def test_untrained_network_shows_its_input_to_the_source_camera():
    image = disc()
    gaussians = tiny_net()(image, central_intrinsics())
    intrinsics = central_intrinsics()[:, None]
    camera = Cameras(torch.eye(4)[None, None], intrinsics[..., :2], intrinsics[..., 2:], 32, 32)
    rendered = render(gaussians, camera).image[0, 0].permute(2, 0, 1)
    error = (rendered - (image[0, :3] + 1 - image[0, 3:]))[:, 10:22, 10:22]
    assert error.abs().max() < 0.1


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.1, 30))
def test_any_prediction_is_a_valid_scene_with_ordered_layers(seed, scale):
    net = tiny_net(layers=3, sh_degree=1)
    rng = torch.Generator().manual_seed(seed)
    raw = scale * torch.randn(1, 3 * sum(parameter_groups(1).values()), 4, 4, generator=rng)
    image = torch.rand(1, 4, 4, 4, generator=rng)
    pixels = describe_pixels(torch.cat([image[:, :3] * image[:, 3:], image[:, 3:]], 1), central_intrinsics(4))
    raw[:, [1, 2, 3, 1 + 24, 2 + 24, 3 + 24, 1 + 48, 2 + 48, 3 + 48]] = 0  # no offsets: depth alone
    gaussians = net.composer(raw, pixels)
    gaussians.validate()
    assert gaussians.sh_degree == 1
    depth = gaussians.means[0, :, 2].view(3, -1)
    assert (depth[1:] >= depth[:-1] - 1e-5).all()
    assert depth.min() > 0.749 and depth.max() < 1.851


@pytest.mark.parametrize(
    "changes",
    [{"sh_degree": 3}, {"patch_px": 2}, {"composer": "absolute", "layers": 1}],
    ids=["harmonics", "patches", "absolute"],
)
def test_symmetric_network_sees_the_mirror_image_in_a_mirror(changes):
    net = tiny_net(symmetric=True, **changes)
    torch.nn.init.normal_(net.head.weight, std=0.1)
    picture, intrinsics = disc(), torch.tensor([[44.0, 44.0, 17.5, 12.25]])
    picture[..., :9, :] *= 0.5  # neither symmetric nor in the middle
    mirror = torch.tensor([[44.0, 44.0, 32 - 17.5, 12.25]])
    # From the left of the one and from the right of the other, far enough for harmonics and rotations to show.
    seen = []
    for image, k, side in ((picture, intrinsics, 0.3), (picture.flip(3), mirror, -0.3)):
        pose = torch.eye(4)[None, None].clone()
        pose[..., 0, 3] = side
        seen.append(render(net(image, k), Cameras(pose, k[None, :, :2], k[None, :, 2:], 32, 32)).image[0, 0])
    assert seen[0].amax() - seen[0].amin() > 0.2
    torch.testing.assert_close(seen[0], seen[1].flip(1), atol=2e-3, rtol=0)


def test_gradients_reach_every_parameter():
    net = tiny_net()
    torch.nn.init.normal_(net.head.weight, std=0.1)
    for module in net.modules():  # the zero second convolutions hide the first ones
        if isinstance(module, torch.nn.Conv2d):
            torch.nn.init.normal_(module.weight, std=0.1)
    gaussians = net(disc(), central_intrinsics())
    sum(field.square().sum() for field in gaussians.fields().values()).backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in net.parameters())


def test_original_configuration_starts_as_published():
    torch.manual_seed(0)
    original = ModelConfig.from_yaml("original").to_dict()
    original["unet"] |= {"base_channels": 32, "blocks": 1, "dropout": 0.0}
    net = SplatterNet(ModelConfig.from_dict(original)).eval()
    gaussians = net(disc(), central_intrinsics()).detach()
    assert gaussians.sh_degree == 1 and gaussians.count == 32 * 32
    assert gaussians.scales.log().mean() == pytest.approx(np.log(0.02), abs=0.05)
    assert gaussians.opacities.logit().mean() == pytest.approx(-2, abs=0.7)
    assert not gaussians.sh[..., 1:, :].any()
    torch.testing.assert_close(gaussians.quaternions.norm(dim=-1), torch.ones(1, 1024))
    assert 0.8 < gaussians.means[..., 2].mean() < 1.8


@pytest.mark.parametrize("size", [16, 48])
def test_network_runs_at_other_sizes(size):
    assert tiny_net()(torch.rand(2, 4, size, size), central_intrinsics(size).repeat(2, 1)).count == 2 * size * size
    with pytest.raises(InputError, match="width of the images: expected a multiple of"):
        tiny_net()(torch.rand(2, 4, size, size + 1), central_intrinsics(size).repeat(2, 1))


def test_object_square_is_centred_with_a_margin():
    alpha = torch.zeros(100, 60)
    alpha[20:70, 10:30] = 1
    assert object_square(alpha, margin=0.1) == Square(left=-10, top=15, side=60)
    with pytest.raises(InputError, match="empty mask"):
        object_square(torch.zeros(8, 8))


@settings(max_examples=30, deadline=None)
@given(left=st.integers(-20, 40), top=st.integers(-20, 40), side=st.integers(30, 80), size=st.sampled_from([32, 64]))
def test_crop_moves_pixels_as_its_intrinsics_say(left, top, side, size):
    """A soft spot at a known place must appear where the shifted and scaled camera projects it."""
    square, spot = Square(left, top, side), (left + 0.6 * side, top + 0.4 * side)
    rows, columns = torch.meshgrid(torch.arange(100) + 0.5, torch.arange(120) + 0.5, indexing="ij")
    image = torch.exp(-((columns - spot[0]) ** 2 + (rows - spot[1]) ** 2) / 18)[None]
    cropped = crop_resize(image, square, size)[0]
    fx, fy, cx, cy = square.intrinsics((100.0, 90.0), (60.0, 50.0), size)
    expected = (fx * (spot[0] - 60) / 100 + cx, fy * (spot[1] - 50) / 90 + cy)
    rows, columns = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    if 10 < spot[0] < 110 and 10 < spot[1] < 90:
        found = ((cropped * columns).sum() / cropped.sum(), (cropped * rows).sum() / cropped.sum())
        assert found == (pytest.approx(expected[0], abs=0.25), pytest.approx(expected[1], abs=0.25))


def test_checkpoint_round_trip(tmp_path):
    net = tiny_net().eval()
    torch.nn.init.normal_(net.head.weight, std=0.05)
    net.save(tmp_path / "net.safetensors", {"note": "a test"})
    loaded = SplatterNet.from_pretrained(tmp_path / "net.safetensors")
    assert loaded.config == net.config and not loaded.training
    for name, tensor in net.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor.half().float()), name


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"\xff" * 64])
def test_damaged_checkpoint_is_an_input_error(tmp_path, content):
    (tmp_path / "bad.safetensors").write_bytes(content)
    with pytest.raises(InputError, match="bad.safetensors"):
        SplatterNet.from_pretrained(tmp_path / "bad.safetensors")


def test_missing_cut_or_foreign_checkpoint_is_an_input_error(tmp_path):
    from safetensors.torch import save_file

    with pytest.raises(InputError, match="no such"):
        SplatterNet.from_pretrained(tmp_path / "none.safetensors")
    for metadata in (None, {"lightfield_gs.model_config": "[" * 6000}):
        save_file({"a": torch.zeros(3)}, tmp_path / "foreign.safetensors", metadata)
        with pytest.raises(InputError, match="SplatterNet checkpoint"):
            SplatterNet.from_pretrained(tmp_path / "foreign.safetensors")
    tiny_net().save(tmp_path / "whole.safetensors")
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "whole.safetensors").read_bytes()[:-100])
    with pytest.raises(InputError):
        SplatterNet.from_pretrained(tmp_path / "cut.safetensors")


@pytest.mark.parametrize(
    "change, word",
    [
        ({"layers": 0}, "layers"),
        ({"sh_degree": 4}, "sh_degree"),
        ({"colour": 1}, "colour"),
        ({"image_size_px": 30}, "image_size_px"),
        ({"near": 2.0}, "base_depth"),
        ({"unet": {"heads": 3}}, "heads"),
        ({"unet": {"blocks": "two"}}, "blocks"),
        ({"unet": 5}, "unet"),
        ({"layers": True}, "layers"),
        ({"unet": {"base_channels": 1 << 40}}, "base_channels"),
        ({"unet": {"base_channels": 3, "heads": 1}}, "base_channels"),
        ({"near": "0.5"}, "near"),
        ({"composer": "sum"}, "composer"),
    ],
)
def test_bad_configuration_names_the_field(change, word):
    with pytest.raises(InputError, match=word):
        ModelConfig.from_dict(change)


@pytest.mark.parametrize("shape", [(40, 90, 4), (21, 15, 4), (300, 200, 4)])
def test_predict_takes_any_photo(shape):
    photo = np.zeros(shape, np.float32)
    photo[shape[0] // 4 :, shape[1] // 3 :] = (0.2, 0.7, 0.4, 1)
    gaussians = tiny_net().predict(photo).validate()
    assert gaussians.means.dim() == 2 and gaussians.count > 0
    assert 0.75 < gaussians.means[:, 2].median() < 1.85
    # The crop is centred on the object, wherever the photo shows it.
    assert gaussians.means[:, :2].mean(0).abs().max() < 0.05


@pytest.mark.parametrize(
    "photo, word",
    [
        (np.zeros((8, 8, 3), np.float32), "H,W,4"),
        (np.zeros((8, 8, 4), np.uint16), "65535"),
        (np.full((8, 8, 4), 2, np.float32), "0..1"),
        (np.zeros((8, 8, 4), np.float32), "mask"),
        (np.full((8, 8, 4), np.nan, np.float32), "finite"),
        (np.zeros((0, 8, 4), np.float32), "H,W,4"),
    ],
)
def test_predict_refuses_what_is_no_photo(photo, word):
    with pytest.raises(InputError, match=word):
        tiny_net().predict(photo)


@pytest.mark.skipif(not PRETRAINED.exists(), reason="this checkout has no trained checkpoint")
def test_pretrained_checkpoint_is_small_and_works():
    assert PRETRAINED.stat().st_size <= 15_000_000
    net = SplatterNet.from_pretrained()
    photo = disc(96)[0].permute(1, 2, 0).clamp(0, 1).numpy()
    gaussians = net.predict(photo).validate()
    assert 0.9 < gaussians.means[:, 2].median() < 1.6


def test_package_import_leaves_network_and_training_tools_out():
    code = (
        "import sys, lightfield_gs; left_out = 'lightfield_gs.models', 'training', 'jsonargparse', 'tensorboard', "
        "'safetensors'; print([m for m in left_out if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
