"""Depth by networks of transformers: tiny ones with random weights, through its real pipeline."""

import json
import sys

import numpy as np
import pytest
import torch
from command_line import complaint
from PIL import Image
from torch.nn.functional import interpolate

import lightfield_gs as lf
from lightfield_gs import cli
from lightfield_gs.base.options import DEPTH_MODEL
from lightfield_gs.io.images import read_info, read_picture, write_image
from lightfield_gs.panels.framing import focus_on_subject
from lightfield_gs.panels.rig import frame_photo
from lightfield_gs.photo import depth_network
from lightfield_gs.photo.depth_models.open import open_model
from lightfield_gs.photo.depth_models.pipeline import numbers_kind
from lightfield_gs.photo.depth_network import depth_from_network, estimated_depth
from lightfield_gs.photo.joint_upsampling import disparities_to_z, distances_to_z

LINE = "encode busy.png -o o.png --panel p.yaml --device cpu"


@pytest.fixture
def transformers():
    return pytest.importorskip("transformers", reason="needs the optional extra depth (transformers)")


@pytest.fixture
def offline(monkeypatch, tmp_path):
    """No connection and an empty cache."""
    constants = pytest.importorskip("huggingface_hub.constants", reason="needs the optional extra depth")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")


def tiny_network(transformers, folder, **options) -> str:
    """A Depth Anything of 40 thousand random weights, saved as on huggingface.co."""
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=56,
        patch_size=14,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        initializer_range=0.5,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[8] * 4,
        fusion_hidden_size=8,
        head_hidden_size=8,
        **options,
    )
    transformers.DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    processor = transformers.DPTImageProcessor(
        size={"height": 56, "width": 56}, ensure_multiple_of=14, keep_aspect_ratio=True
    )
    processor.save_pretrained(folder)
    return str(folder)


def busy_photo() -> np.ndarray:
    """Blocks of all colours, up to the border, in which nothing stands out; written as busy.png."""
    blocks = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
    photo = blocks.repeat(20, 0).repeat(20, 1)
    write_image("busy.png", photo)
    return photo


def test_a_photo_becomes_a_scene_through_the_pipeline(folder, capsys, transformers):
    model, photo = tiny_network(transformers, "net"), busy_photo()
    z = depth_from_network(photo, model, "cpu")
    assert z.shape == (120, 160) and z.dtype == np.float32 and 1 / 1.1 <= z.min() < z.max() <= 1.6 + 1e-6
    assert np.array_equal(z, depth_from_network(torch.from_numpy(photo / np.float32(255)), model, "cpu"))
    assert depth_from_network(photo, model, "cpu", limits=(2, 9)).max() == pytest.approx(9)
    assert cli.main(f"{LINE} --depth auto --depth-model net --save-rig r.yaml".split()) == 0
    out = capsys.readouterr().out
    assert "depth estimated by net: disparities" in out and "z 1.6 and 1 (assumed; --depth-range)" in out
    # The panel's plane is in what is nearest in the middle, and not at the harmonic mean of near and far
    scene = lf.from_depth(photo / np.float32(255), z)
    panel = lf.Panel.load("p.yaml")
    subject = focus_on_subject(frame_photo(scene, panel), scene, panel).zero_depth
    assert lf.Rig.from_yaml("r.yaml").zero_depth == pytest.approx(subject, rel=0.02)


def test_pictures_go_to_the_network_as_through_its_pipeline(folder, transformers):
    """Without the pipeline's work on the host; enlarged, as they are, and of a shape that is no multiple of a patch."""
    network = open_model(tiny_network(transformers, "net"), "cpu")
    whole = transformers.pipeline("depth-estimation", model="net", device="cpu")
    for height, width in ((70, 126), (56, 112), (40, 61)):
        picture = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
        with torch.no_grad():
            (found,) = network.predict([network.shrink(picture)])
            expected = whole(Image.fromarray(picture))["predicted_depth"]
        size = expected.shape[-2:]  # of the picture, or of what the network saw, by the version
        values = interpolate(found.values[None, None], size=size, mode="bicubic", align_corners=False)
        torch.testing.assert_close(values[0, 0], expected.reshape(size), atol=0, rtol=2e-3)
    assert network.shrink(busy_photo()).shape == (56, 70, 3)
    assert network.shrink(busy_photo(), 30).shape == (28, 42, 3) and network.shrink(busy_photo(), 80).shape == (
        56,
        70,
        3,
    )


def test_metric_networks_give_distances(folder, transformers):
    model, photo = tiny_network(transformers, "net", depth_estimation_type="metric", max_depth=20), busy_photo()
    found = estimated_depth(photo, model, "cpu")
    with torch.no_grad():
        network = open_model(model, "cpu")
        (values, _, _), *_ = network.predict([network.shrink(photo)])
    assert "distances" in found.description and found.focal_px is None
    assert float(values.min()) * 0.999 <= found.z.min() <= found.z.max() <= float(values.max()) * 1.001
    with pytest.raises(lf.InputError, match="depth_range= is for disparities"):
        depth_from_network(photo, model, "cpu", limits=(1, 2))
    assert depth_from_network(photo, model, "cpu", kind="disparity").max() <= 1.6 + 1e-6


def test_without_a_cut_out_the_whole_scene_is_shown(folder, capsys, transformers, monkeypatch):
    tiny_network(transformers, "net")
    busy_photo()
    monkeypatch.setattr(depth_network, "model_folder", lambda model, say: "net")
    assert cli.main(LINE.split()) == 0
    output = capsys.readouterr()
    assert "shown as a whole scene, as with --depth auto" in output.err and "--mask FILE" in output.err
    assert f"depth estimated by {DEPTH_MODEL}" in output.out


def test_weights_that_cannot_be_fetched(folder, capsys, transformers, offline):
    busy_photo()
    assert cli.main(f"{LINE} --depth auto".split()) == 2
    output = capsys.readouterr()
    assert output.out == f"fetching the depth network {DEPTH_MODEL} from huggingface.co, once (99 MB, Apache-2.0)\n"
    assert "could not be fetched" in output.err and "--depth-model FOLDER" in output.err and output.err.count("\n") == 1
    command = f"run `hf download {DEPTH_MODEL}` once"
    assert cli.main(LINE.split()) == 2
    refusal = capsys.readouterr().err
    assert "has no cut-out and no plain background" in refusal and "pip install" not in refusal
    assert all(refusal.index(command) < refusal.index(way) for way in ("--depth-model", "--depth FILE", "--mask FILE"))
    assert "there is no folder ./nets" in complaint(capsys, f"{LINE} --depth auto --depth-model ./nets")
    (folder / "empty").mkdir()
    assert "expected a depth-estimation model" in complaint(capsys, f"{LINE} --depth auto --depth-model empty")


def test_without_the_package(folder, capsys, monkeypatch):
    busy_photo()
    for name in ("transformers", "huggingface_hub"):
        monkeypatch.setitem(sys.modules, name, None)
    command = "pip install 'lightfield-gs[photo]'"
    assert command in complaint(capsys, f"{LINE} --depth auto")
    refusal = complaint(capsys, LINE)
    assert f"has no cut-out and no plain background: {command}" in refusal
    assert all(refusal.index(command) < refusal.index(way) for way in ("--depth FILE", "--mask FILE"))


def test_options_that_do_not_go_with_it(folder, capsys):
    busy_photo()
    assert "is for --depth auto" in complaint(capsys, f"{LINE} --depth-model net")
    assert "is about a depth map in a file" in complaint(capsys, f"{LINE} --depth auto --depth-scale 2")
    assert "is about a mask or a depth map" in complaint(capsys, f"{LINE} --depth auto --map-orientation stored")


def test_disparities_are_normalized_by_percentiles():
    values = torch.linspace(5, 15, 1001).reshape(7, 143)
    values[0, 0], values[-1, -1] = -1e6, 1e6  # outliers
    found = disparities_to_z(values, (2.0, 4.0))
    low, high = 5.1, 14.9
    expected = 1 / (0.25 + 0.25 * ((values - low) / (high - low)).clamp(0, 1.25))
    assert torch.allclose(found.z(values), expected, atol=1e-5) and found.value_range == pytest.approx(
        high - low, rel=1e-4
    )
    flat = disparities_to_z(torch.full((4, 5), 3.0))
    assert "flat" in flat.notes[0] and torch.equal(flat.z(flat.disparities), torch.full((4, 5), 1.6))


def test_distances_stay_as_they_are():
    values = torch.tensor([[0.5, 2.0], [80.0, 0.0]])
    found = distances_to_z(values)
    z = found.z(found.disparities)
    assert torch.allclose(z[values > 0], values[values > 0]) and torch.isnan(z[1, 1])
    assert "25.0% have no distance" in found.notes[0]


@pytest.mark.parametrize(
    "bad", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)) + 2, np.zeros((4, 4, 3), np.int32), "photo.png", None]
)
def test_images_that_are_none(bad):
    with pytest.raises(lf.InputError):
        depth_from_network(bad)


def test_models_that_do_not_say_what_their_numbers_are(monkeypatch):
    class Network:
        model_type = family = "chmv2"
        kind = None

    assert numbers_kind(Network) is None
    monkeypatch.setattr(depth_network, "open_model", lambda folder, device: Network)
    with pytest.raises(lf.InputError, match=r"\(chmv2\).* give depth_kind="):
        depth_from_network(np.zeros((4, 4, 3), np.uint8), ".", "cpu")
    Network.model_type = "dpt"
    assert numbers_kind(Network) == "disparity"


@pytest.mark.parametrize(
    "name, repository, licence",
    [
        ("MoGe-2", "Ruicheng/moge-2-vitl", "MIT"),
        ("DA3MONO-LARGE", "depth-anything/DA3MONO-LARGE", "Apache-2.0"),
        ("Video-Depth-Anything", "depth-anything/Video-Depth-Anything-Small", "Apache-2.0"),
    ],
)
def test_models_of_other_families_by_their_names(folder, capsys, offline, name, repository, licence):
    busy_photo()
    assert cli.main(f"{LINE} --depth auto --depth-model {name}".split()) == 2
    output = capsys.readouterr()
    assert output.out.startswith(f"fetching the depth network {repository} ") and licence in output.out
    assert f"run `hf download {repository}` once" in output.err and output.err.count("\n") == 1


def test_depths_of_a_video_are_averaged_with_their_neighbours(folder, capsys, transformers):
    tiny_network(transformers, "net")
    photo, random = busy_photo().astype(float), np.random.default_rng(0)
    (folder / "clip").mkdir()
    for number in range(4):
        noise = random.normal(0, 8, photo.shape)
        write_image(f"clip/{number}.png", (photo + noise).clip(0, 255).astype(np.uint8))
    options = "--panel p.yaml --device cpu --depth auto --depth-model net"
    for number in (1, 2):
        assert cli.main(f"encode clip/{number}.png -o {number}.png {options}".split()) == 0
    assert cli.main(f"video clip -o v {options}".split()) == 0
    alone, together = (
        [read_picture(name).pixels.astype(float) for name in names]
        for names in (("1.png", "2.png"), ("v/frame-000001.png", "v/frame-000002.png"))
    )
    change_alone, change_together = (np.abs(first - second).mean() for first, second in (alone, together))
    assert change_together < change_alone  # the rest is noise of the colours


def test_the_image_says_which_network(folder, transformers, monkeypatch):
    tiny_network(transformers, "net")
    busy_photo()
    assert cli.main(f"{LINE} --depth auto --depth-model net".split()) == 0
    assert json.loads(read_info("o.png").metadata["encoding"])["depth"] == {"model": "net"}
