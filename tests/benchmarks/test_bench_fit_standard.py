"""bench fit on the published scenes, and on the halves of a protocol: tiny folders of the same layouts."""

import json

import numpy as np
import pytest
from bench_cases import arguments
from fit_capture import write_capture
from fit_scene import known_cameras, known_scene, photograph_scene
from PIL import Image

from benchmarks import fit_report, fit_runs, fit_standard
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands import bench as command
from training.data.text_model import write_text_model

FEW = ("--steps", "20", "--gaussians", "160", "--threads", "1")


def bench(*words):
    assert command.run(arguments("fit", *map(str, words))) == 0


def write_scene(folder, images, model_scale, count=10):
    """`count` photographs 64 x 48 in a folder of this name, and a model for images `model_scale` times as large."""
    scene, cameras = known_scene(), known_cameras(count, 64, 48)
    (folder / images).mkdir(parents=True)
    (folder / "sparse/0").mkdir(parents=True)
    taken = photograph_scene(scene, cameras)
    for name, photo in zip(taken.names, taken.photos.numpy()):
        Image.fromarray(photo).save(folder / images / name)
    numbers = model_scale * 64, model_scale * 48, *(model_scale * cameras.intrinsics()[0]).tolist()
    camera = f"1 PINHOLE {' '.join(map(str, numbers))}"
    poses = [(name, pose, 1) for name, pose in zip(taken.names, cameras.world_to_camera.double().numpy())]
    points = scene.means[:100].numpy()
    write_text_model(folder / "sparse/0", [camera], poses, points, np.full((100, 3), 127, np.uint8))
    return cameras.intrinsics()[0].numpy()


@pytest.fixture
def archives(tmp_path):
    """The three layouts: models of the whole photographs, of twice their size, and of their size."""
    folder = tmp_path / "data"
    for scene, images, scale in (
        ("360_v2/garden", "images_4", 4),
        ("tandt/train", "images", 2),
        ("db/playroom", "images", 1),
    ):
        intrinsics = write_scene(folder / scene, images, scale)
    return folder, intrinsics


def test_published_scenes_are_found_in_their_archives_and_read_at_their_size(archives, capsys):
    folder, intrinsics = archives
    sources = fit_standard.find_scenes(folder)
    assert [source.name for source in sources] == ["garden", "train", "playroom"]
    said = capsys.readouterr().err
    assert "3 of 13 scenes: garden, train, playroom; missing: bicycle, flowers, stump, treehill, room" in said
    for source in sources:
        capture, held_out = source.read(None)
        np.testing.assert_allclose(capture.intrinsics, np.tile(intrinsics, (10, 1)), rtol=1e-6)
        assert held_out == [0, 8] and capture.sizes_px.tolist() == [[64, 48]] * 10
    (folder / "garden").symlink_to(folder / "360_v2/garden")
    with pytest.raises(InputError, match="scene garden once"):
        fit_standard.find_scenes(folder)
    with pytest.raises(InputError, match="found none in"):
        fit_standard.find_scenes(folder / "tandt/train/images")


def test_published_scenes_are_fitted_once_and_stand_beside_published_means(archives, tmp_path, monkeypatch, capsys):
    folder, _ = archives
    words = ("--standard", folder, "--longest-px", "64", "--json", tmp_path / "rows.json", *FEW)
    bench(*words)
    shown = capsys.readouterr().out
    assert "mip-NeRF 360, means over scenes" in shown and "LiteGS  9 of 9    27.59  0.813  0.230" in shown
    assert "ours  1 of 9" in shown and "without truck, ours compare with no published mean" in shown
    assert "not as published: 20 steps, 160 Gaussians, photographs of at most 64 px" in shown
    result = json.loads((tmp_path / "rows.json").read_text())
    assert [capture["held_out"] for capture in result["captures"]] == [["00.png", "08.png"]] * 3
    monkeypatch.setattr(fit_runs, "rows", None)
    bench(*words, "--resume")
    said = capsys.readouterr()
    assert (
        "3 fits finished earlier" in said.err
        and said.out.split("means over scenes")[1:] == shown.split("means over scenes")[1:]
    )


def test_means_are_of_medians_over_the_scenes_of_a_set():
    common = dict.fromkeys(fit_report._NUMBERS) | {"arm": "ours", "step": 9, "seconds": 60.0, "gaussians": 1_000_000}
    values = {scene: 20.0 + number for number, scene in enumerate(fit_standard.SCENES)}
    rows = [
        common | {"capture": scene, "seed": seed, "psnr_db": value + seed, "ssim": 0.8}
        for scene, value in values.items()
        for seed in (0, 1, 5)
    ]
    found = {row["set"]: row for row in fit_standard.means(fit_report.summary(rows), 9)}
    of_nine = [values[scene] + 1 for scene in fit_standard.SETS["mip-NeRF 360"]]
    of_seven = [values[scene] + 1 for scene in values if scene in fit_standard.SETS["mip-NeRF 360, 7 scenes"]]
    assert len(of_nine) == 9 and len(of_seven) == 7
    assert found["mip-NeRF 360"]["psnr_db"] == pytest.approx(sum(of_nine) / 9)
    assert found["mip-NeRF 360, 7 scenes"]["psnr_db"] == pytest.approx(sum(of_seven) / 7)
    assert found["Deep Blending"]["scenes"] == 2 and found["Deep Blending"]["lpips"] is None


@pytest.fixture
def protocol(tmp_path):
    for name in ("one", "two"):
        write_capture(tmp_path / "data" / name)
    path = tmp_path / "protocol.yaml"
    path.write_text("choose: [one, far]\nreport: [two]\ngaussians: 160\nseeds: 2\n")
    return path


def test_a_run_has_one_half_of_the_protocol(protocol, tmp_path, capsys):
    words = ("--protocol", protocol, "--data", tmp_path / "data", "--json", tmp_path / "rows.json", "--steps", "4")
    bench(*words, "--half", "choose")
    assert "choose: 1 of 2 captures" in capsys.readouterr().err
    result = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["capture"], row["seed"]) for row in result["rows"]] == [("one", 0), ("one", 1)]
    assert result["protocol"]["half"] == "choose" and result["protocol"]["missing"] == ["far"]
    assert result["protocol"]["gaussians"] == 160
    with pytest.raises(InputError, match="half: choose, now report"):
        bench(*words, "--half", "report", "--resume")


@pytest.mark.parametrize(
    "words, message",
    [
        ("DATA/one --protocol FILE --half choose --data DATA", "each is a run of its own"),
        ("DATA/one --standard DATA", "each is a run of its own"),
        ("DATA/one --half choose", "belong to a protocol"),
        ("--protocol FILE --data DATA", "give half=choose or half=report"),
        ("--protocol FILE --half report --data DATA/one", "the half report"),
        ("--protocol BOTH --half report --data DATA", "got one in both"),
        ("--standard DATA --test-every 3", "every eighth"),
    ],
)
def test_halves_and_kinds_of_runs_do_not_mix(words, message, protocol, tmp_path, monkeypatch):
    both = tmp_path / "both.yaml"
    both.write_text("choose: [one]\nreport: [two, one]\ngaussians: 160\nseeds: 2\n")
    monkeypatch.setattr(fit_runs, "rows", None)
    for name, path in (("FILE", protocol), ("BOTH", both), ("DATA", tmp_path / "data")):
        words = words.replace(name, str(path))
    with pytest.raises(InputError, match=message):
        bench(*words.split())
