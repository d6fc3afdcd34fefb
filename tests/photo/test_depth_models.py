"""Depth Anything 3, MoGe-2 and Video Depth Anything: tiny ones, against numbers of their authors' programs."""

import math

import numpy as np
import pytest
import torch
from depth_weights import FEATURES, depth_anything_3, filled, in_time, moge_2, video_depth_anything
from PIL import Image
from torch import nn

from lightfield_gs import cli
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import write_image
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.photo.depth_models.depth_anything_3 import DepthAnything3
from lightfield_gs.photo.depth_models.model import normalized, resized
from lightfield_gs.photo.depth_models.moge import MoGe2
from lightfield_gs.photo.depth_models.open import open_model
from lightfield_gs.photo.depth_models.video_depth_anything import VideoDepthAnything
from lightfield_gs.photo.depth_models.weights import Weights
from lightfield_gs.photo.depth_network import depth_from_network, estimated_depth
from lightfield_gs.photo.depth_windows import in_windows
from lightfield_gs.photo.steady_depth import PictureEstimate

PLACES = ((3, 5), (20, 30), (27, 41))


def picture(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    channels = (7 * x + 3 * y) % 256, (5 * x * y // 9) % 256, (11 * y + x) % 256
    return np.stack(channels, 2).astype(np.uint8)


def test_depth_anything_3_as_its_authors_have_it(tmp_path):
    """Numbers of depth-anything-3 0.1.1: DinoV2 and DPT with these weights, at the same picture."""
    network = open_model(str(depth_anything_3(tmp_path / "net")), "cpu")
    assert isinstance(network, DepthAnything3) and network.shrink(picture(400, 600)).shape == (336, 504, 3)
    ((distances, focal, sky),) = network.predict([picture(42, 84)])
    assert focal is None and sky == pytest.approx(0.0702948, abs=1e-6)
    assert [float(distances[place]) for place in PLACES] == pytest.approx([0.79935, 1.92194, 2.07212], rel=1e-4)
    # The sky is put behind the rest
    assert (distances == distances.max()).double().mean() == pytest.approx(sky)


def test_moge_2_as_its_authors_have_it(tmp_path):
    """Numbers of dlr-moge 2.0.0, MoGeModel.infer with these weights in float32; it resizes floats, not bytes."""
    network = open_model(str(moge_2(tmp_path / "net")), "cpu")
    assert isinstance(network, MoGe2)
    ((distances, focal, sky),) = network.predict([picture(64, 96)])
    places = (*PLACES, (60, 90), (40, 10))
    found = [float(distances[place]) for place in places]
    assert found == pytest.approx([1.08822, 1.06343, 1.49177, 0.89606, 1.3349], rel=0.01)
    assert focal == pytest.approx(0.354651, rel=1e-3) and sky == 0


def test_the_field_of_view_of_moge_2_is_taken(folder, capsys, tmp_path):
    moge_2(tmp_path / "net")
    write_image("photo.png", picture(128, 192))
    depth = estimated_depth(picture(128, 192), tmp_path / "net", "cpu")
    angle = 2 * math.degrees(math.atan(192 / 2 / depth.focal_px))
    line = f"encode photo.png -o o.png --panel p.yaml --device cpu --depth auto --depth-model {tmp_path / 'net'}"
    assert cli.main(f"{line} --save-rig own.yaml".split()) == 0
    assert f"field of view {angle:.3g} degrees, estimated too (--fov)" in capsys.readouterr().out
    assert cli.main(f"{line} --fov {angle:.6f} --save-rig told.yaml".split()) == 0
    panel = Panel.load("p.yaml")
    own, told = (Rig.from_yaml(name, panel) for name in ("own.yaml", "told.yaml"))
    assert own.focal_px == pytest.approx(told.focal_px, rel=1e-5)


def test_video_depth_anything_sees_the_other_pictures(tmp_path):
    network = open_model(str(video_depth_anything(tmp_path / "net")), "cpu")
    assert isinstance(network, VideoDepthAnything) and network.shrink(picture(400, 600)).shape == (518, 784, 3)
    here, there = picture(42, 56), picture(42, 56)[::-1].copy()
    (alone,), beside, still = (network.predict(row) for row in ([here], [here, there], [here, here]))
    assert not torch.allclose(alone.values, beside[0].values, rtol=1e-3)
    assert alone.values.shape == (42, 56) and len(beside) == len(still) == 2 and (alone.values >= 0).all()


def test_attention_in_time_is_that_of_torch():
    """A transformer block of torch's own modules, with the same weights."""
    weights = filled(in_time("head.motion_modules."))
    network = VideoDepthAnything.__new__(VideoDepthAnything)
    network._head = Weights(weights, "head.")
    x = torch.randn(5, FEATURES, 3, 4, generator=torch.Generator().manual_seed(0))
    own = {
        name.split("motion_modules.2.temporal_transformer.")[-1]: value
        for name, value in weights.items()
        if ".2.temp" in name
    }
    tokens = nn.functional.group_norm(x, 32, own["norm.weight"], own["norm.bias"], 1e-6)
    tokens = tokens.permute(2, 3, 0, 1).reshape(12, 5, FEATURES) @ own["proj_in.weight"].T + own["proj_in.bias"]
    block = {name.removeprefix("transformer_blocks.0."): value for name, value in own.items()}
    for part in range(2):
        name = f"attention_blocks.{part}."
        attention = nn.MultiheadAttention(FEATURES, 8, batch_first=True)
        attention.in_proj_weight.data = torch.cat([block[f"{name}to_{letter}.weight"] for letter in "qkv"])
        attention.in_proj_bias.data.zero_()
        attention.out_proj.weight.data = block[f"{name}to_out.0.weight"]
        attention.out_proj.bias.data = block[f"{name}to_out.0.bias"]
        seen = nn.functional.layer_norm(tokens, (FEATURES,), block[f"norms.{part}.weight"], block[f"norms.{part}.bias"])
        seen = seen + block[f"{name}pos_encoder.pe"][:, :5]
        tokens = tokens + attention(seen, seen, seen)[0]
    seen = nn.functional.layer_norm(tokens, (FEATURES,), block["ff_norm.weight"], block["ff_norm.bias"])
    both = seen @ block["ff.net.0.proj.weight"].T + block["ff.net.0.proj.bias"]
    gated = both[..., : 4 * FEATURES] * nn.GELU()(both[..., 4 * FEATURES :])
    tokens = tokens + gated @ block["ff.net.2.weight"].T + block["ff.net.2.bias"]
    tokens = tokens @ own["proj_out.weight"].T + own["proj_out.bias"]
    expected = x + tokens.reshape(3, 4, 5, FEATURES).permute(2, 3, 0, 1)
    assert torch.allclose(network._in_time(2, x), expected, atol=1e-5)


def test_windows_of_a_video_have_one_scale():
    """A network that draws scale and offset anew for each window."""
    random, calls = np.random.default_rng(0), []
    truth = [torch.linspace(1, 2, 48).reshape(6, 8) + 0.01 * number for number in range(50)]

    def disparities(pictures):
        calls.append(len(pictures))
        scale, offset = random.uniform(0.5, 2), random.uniform(-1, 1)
        return [scale * truth[int(part[0, 0, 0])] + offset for part in pictures]

    row = [(10 + number, np.full((6, 8, 3), number, np.uint8)) for number in range(50)]
    found = list(in_windows(row, disparities, 20, False))
    assert [number for number, _ in found] == [number for number, _ in row] and calls == [20, 20, 20, 14]
    scale = found[0][1].disparities.std() / truth[0].std()
    offset = found[0][1].disparities.mean() - scale * truth[0].mean()
    for (_, estimate), values in zip(found, truth):
        assert torch.allclose(estimate.disparities, scale * values + offset, atol=1e-4)
    assert isinstance(found[0][1], PictureEstimate)


def test_windows_end_at_cuts():
    calls = []

    def disparities(pictures):
        calls.append([int(part[0, 0, 0]) for part in pictures])
        return [torch.ones(6, 8) for _ in pictures]

    row = [(number, np.full((6, 8, 3), 200 if number > 3 else 10, np.uint8)) for number in range(7)]
    assert len(list(in_windows(row, disparities, 32, False))) == 7 and calls == [[10] * 4, [200] * 3]


def test_weights_of_another_network_are_refused(tmp_path):
    folder = depth_anything_3(tmp_path / "net")
    from safetensors.torch import load_file, save_file

    tensors = load_file(folder / "model.safetensors")
    del tensors["model.head.projects.2.weight"]
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(InputError, match="expected the weights of Depth Anything 3 .*no model.head.projects.2.weight"):
        depth_from_network(picture(42, 84), folder, "cpu")
    torch.save({"model": {}}, tmp_path / "model.pt")
    with pytest.raises(InputError, match="expected the weights of MoGe-2"):
        depth_from_network(picture(42, 84), tmp_path, "cpu")


@pytest.mark.parametrize(
    ("size", "how"), [((42, 70), Image.Resampling.BICUBIC), ((90, 140), Image.Resampling.BILINEAR)]
)
def test_tensors_are_resized_as_pictures_are(size, how):
    """Pillow rounds, and cuts off overshoots, between its two passes."""
    y, x = np.mgrid[:64, :96]
    waves = 128 + 100 * np.sin(x / 9), 128 + 90 * np.cos(y / 7), 100 + 80 * np.sin((x + y) / 5)
    wide = np.stack(waves, 2).astype(np.uint8)
    found = resized(torch.from_numpy(wide), *size, how)
    expected = np.asarray(Image.fromarray(wide).resize(size[::-1], how))
    assert found.dtype == torch.uint8 and np.abs(found.numpy().astype(int) - expected).max() <= 1
    assert torch.equal(normalized([found], found.device), normalized([found.numpy()], found.device))
