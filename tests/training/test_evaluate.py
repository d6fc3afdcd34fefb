"""Scoring a network: conventions, bins, the copy baseline and the command."""

import json

import numpy as np
import pytest
import torch
from photo_cases import TINY
from PIL import Image
from srn_scene import HEIGHT, WIDTH, look_at, write_object

from lightfield_gs import Gaussians, InputError
from lightfield_gs.models import ModelConfig, SplatterNet
from training import evaluate
from training.comparison import azimuths_from_source, compare_object
from training.data.objects import read_object
from training.data.plan import relative_cameras
from training.evaluation import labelled, score_folder
from training.rendering import render_card, render_views

ANGLES = ((0, 0), (-10, 0), (5, 6), (10, -6), (4, 0))


class KnownScene(torch.nn.Module):
    """Stands for a perfect network: returns the scene that the pictures show, in the source camera's axes."""

    def __init__(self, gaussians: Gaussians) -> None:
        super().__init__()
        self.gaussians, self.config = gaussians, ModelConfig.from_dict(TINY)

    def forward(self, images, intrinsics):
        return Gaussians(*(field[None] for field in self.gaussians.fields().values()))


def _scene() -> Gaussians:
    """A few Gaussians about (0, 0, 1.3) before the source camera."""
    rng = torch.Generator().manual_seed(0)
    count = 40
    means = 0.15 * torch.randn(count, 3, generator=rng) + torch.tensor([0, 0, 1.3])
    scales = 0.03 + 0.02 * torch.rand(count, 3, generator=rng)
    return Gaussians(
        means,
        torch.randn(count, 4, generator=rng),
        scales,
        torch.full((count,), 0.9),
        torch.randn(count, 1, 3, generator=rng),
    )


@pytest.mark.parametrize("fineness", [1, 2])
def test_the_true_scene_scores_as_well_as_8_bits_allow(tmp_path, fineness):
    """Pictures of known Gaussians, drawn straight from the poses on disk; only the source camera's axes are shared."""
    write_object(tmp_path / "a", angles=ANGLES)
    views, scene = read_object(tmp_path / "a"), _scene()
    world_to_camera = torch.from_numpy(np.linalg.inv(views.camera_to_world) @ views.camera_to_world[0]).float()
    intrinsics = fineness * torch.tensor([[140.0, 140.0, 64.0, 48.0]]).expand(len(ANGLES), 4)
    batched = Gaussians(*(field[None] for field in scene.fields().values()))
    black = torch.zeros(1, len(ANGLES), 3)
    images, alpha = render_views(batched, world_to_camera[None], intrinsics[None], 128 * fineness, 96 * fineness, black)
    straight = images[0].permute(0, 2, 3, 1) / alpha[0, ..., None].clamp_min(1e-6)
    pixels = (torch.cat([straight, alpha[0, ..., None]], -1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    for index, picture in enumerate(pixels):
        Image.fromarray(picture).save(tmp_path / f"a/rgb/{index:06d}.png")
    (tmp_path / "a/intrinsics.txt").write_text(
        f"{140 * fineness} {64 * fineness} {48 * fineness} 0\n0 0 0\n1\n{96 * fineness} {128 * fineness}\n"
    )
    report = score_folder(KnownScene(scene), tmp_path, supersampling=fineness)
    assert report["psnr_db"] > 50 and report["ssim"] > 0.999 and report["source"]["psnr_db"] > 50
    assert report["copy_psnr_db"] < 30


def test_bins_and_copy_baseline(tmp_path):
    write_object(tmp_path / "a", angles=ANGLES)
    report = score_folder(SplatterNet(ModelConfig.from_dict(TINY)).eval(), tmp_path)
    assert report["objects"] == 1 and report["views"] == 4
    assert [(row["angle_deg"], row["views"]) for row in report["bins"]] == [(5, 2), (10, 2)]
    kept = {}
    nets = [SplatterNet(ModelConfig.from_dict(TINY)).eval() for _ in range(2)]
    assert [score_folder(net, tmp_path, decoded=kept) for net in nets] == [score_folder(net, tmp_path) for net in nets]
    assert list(kept) == [tmp_path / "a"]
    for name in ("psnr_db", "ssim", "copy_psnr_db", "copy_ssim", "card_psnr_db", "card_ssim"):
        assert np.mean([row[name] for row in report["bins"]]) == pytest.approx(report[name])
    assert report["source"]["views"] == 1 and report["source"]["copy_psnr_db"] == 100
    assert [label for label, _ in labelled(report)] == ["source", "5 deg", "10 deg", "all"]
    comparison = compare_object(SplatterNet(ModelConfig.from_dict(TINY)).eval(), tmp_path / "a")
    assert comparison.truth.shape == comparison.card.shape == (5, 3, 96, 128)  # the longer side becomes 128
    frames = [np.asarray(Image.open(tmp_path / f"a/rgb/{i:06d}.png")).astype(float) for i in range(5)]
    on_white = [f[..., :3] * (f[..., 3:] / 255) + 255 - f[..., 3:] for f in frames]
    doubled = [np.repeat(np.repeat(f, 2, 0), 2, 1) / 255 for f in on_white]  # 64 x 48 stored, 128 x 96 compared
    expected = np.mean([-10 * np.log10(((doubled[0] - f) ** 2).mean()) for f in doubled[1:]])
    assert report["copy_psnr_db"] == pytest.approx(expected, abs=0.01)


def test_the_objects_of_a_limit_are_spread_over_the_folder(tmp_path):
    for name in "abcdefg":
        write_object(tmp_path / name, angles=ANGLES[:2])
    net = SplatterNet(ModelConfig.from_dict(TINY)).eval()
    scored = {limit: list(score_folder(net, tmp_path, limit=limit)["object_psnr_db"]) for limit in (1, 3, 7, 9, None)}
    assert scored == {1: ["a"], 3: ["a", "c", "e"], 7: [*"abcdefg"], 9: [*"abcdefg"], None: [*"abcdefg"]}
    for limit in (0, -2):
        with pytest.raises(InputError, match="limit must be 1"):
            score_folder(net, tmp_path, limit=limit)


def test_scores_at_another_size_are_of_the_stored_pixels(tmp_path, capsys):
    """Copying at the stored size is compared pixel by pixel; objects that would be magnified are left out."""
    write_object(tmp_path / "plain/a", angles=ANGLES[:2])
    write_object(tmp_path / "textured/a", angles=ANGLES[:2])
    for path in (tmp_path / "plain/a/rgb").iterdir():
        Image.open(path).resize((4 * WIDTH, 4 * HEIGHT), Image.Resampling.NEAREST).save(path)
    (tmp_path / "plain/a/intrinsics.txt").write_text(
        f"280 {2 * WIDTH} {2 * HEIGHT} 0\n0 0 0\n1\n{4 * HEIGHT} {4 * WIDTH}\n"
    )
    net = SplatterNet(ModelConfig.from_dict(TINY)).eval()
    report = score_folder(net, tmp_path / "plain", size_px=256)
    pixels = [np.asarray(Image.open(tmp_path / f"plain/a/rgb/{i:06d}.png")).astype(float) / 255 for i in range(2)]
    first, second = (frame[..., :3] * frame[..., 3:] + 1 - frame[..., 3:] for frame in pixels)
    assert report["copy_psnr_db"] == pytest.approx(-10 * np.log10(((first - second) ** 2).mean()), abs=0.01)
    steps = [np.diff(first - second, axis=axis).ravel() for axis in (0, 1)]
    expected = -10 * np.log10((np.concatenate(steps) ** 2).mean())
    assert report["copy_gradient_psnr_db"] == pytest.approx(expected, abs=0.01)
    with pytest.raises(InputError, match="at least 256 px on the longer side, got 64"):
        score_folder(net, tmp_path / "textured", size_px=256)
    net.save(tmp_path / "net.safetensors")
    options = ["--checkpoint", str(tmp_path / "net.safetensors"), "--json", str(tmp_path / "s.json"), "--size", "96"]
    assert evaluate.main(["--data", str(tmp_path / "plain"), str(tmp_path / "textured"), *options]) == 0
    scores = json.loads((tmp_path / "s.json").read_text())
    assert list(scores) == ["plain", "textured"] and scores["plain"]["size_px"] == 96
    assert "textured:\nangle" in capsys.readouterr().out


def test_detail_brings_the_source_view_nearer_to_the_photo(tmp_path):
    """Of a checkerboard that an untrained network of 16 px cannot show."""
    write_object(tmp_path / "a", angles=ANGLES[:2])
    path = tmp_path / "a/rgb/000000.png"
    frame = np.array(Image.open(path))
    frame[..., :3] = 255 * (np.indices(frame.shape[:2]).sum(0) // 3 % 2)[..., None]
    Image.fromarray(frame).save(path)
    net = SplatterNet(ModelConfig.from_dict(TINY)).eval()
    soft, sharp = (score_folder(net, tmp_path, detail=detail)["source"] for detail in (None, 4))
    assert sharp["gradient_psnr_db"] > soft["gradient_psnr_db"] + 0.5
    assert sharp["psnr_db"] > soft["psnr_db"] + 0.5


def test_objects_that_cannot_be_scored_are_left_out_and_named(tmp_path, capsys):
    net = SplatterNet(ModelConfig.from_dict(TINY)).eval()
    net.save(tmp_path / "net.safetensors")
    write_object(tmp_path / "set/pair", angles=ANGLES[:2])
    alone = score_folder(net, tmp_path / "set")
    write_object(tmp_path / "set/single", angles=ANGLES[:1])
    write_object(tmp_path / "set/white", angles=ANGLES)
    Image.new("RGB", (WIDTH, HEIGHT), "white").save(tmp_path / "set/white/rgb/000003.png")
    Image.new("RGBA", (WIDTH, HEIGHT)).save(tmp_path / "set/white/rgb/000001.png")
    report = score_folder(net, tmp_path / "set")
    assert list(report.pop("skipped")) == ["single", "white"] and alone.pop("skipped") == {} and report == alone
    arguments = [
        "--data",
        str(tmp_path / "set"),
        "--checkpoint",
        str(tmp_path / "net.safetensors"),
        "--json",
        str(tmp_path / "scores.json"),
    ]
    assert evaluate.main(arguments) == 0
    printed = capsys.readouterr()
    notes = [line for line in printed.err.splitlines() if line.startswith("note: skipped ")]
    assert len(notes) == 2 and "single: expected at least two views" in notes[0] and "000001.png: empty" in notes[1]
    assert "1 objects scored from view 0, 2 skipped" in printed.out
    assert list(json.loads((tmp_path / "scores.json").read_text())["skipped"]) == ["single", "white"]
    with pytest.raises(InputError, match="none of 1 objects can be scored; the first: .*single"):
        score_folder(net, tmp_path / "set/single")


def test_scores_from_afar_are_doubted(tmp_path, capsys):
    """Poses of SRN objects are not scaled: from twice as far nothing is where the network puts it."""
    SplatterNet(ModelConfig.from_dict(TINY)).save(tmp_path / "net.safetensors")
    for name, scale in (("near", 1), ("far", 2)):
        write_object(tmp_path / "set" / name, angles=ANGLES)
        for path in (tmp_path / "set" / name / "pose").iterdir():
            pose = np.loadtxt(path).reshape(4, 4)
            pose[:3, 3] *= scale
            np.savetxt(path, pose.reshape(1, 16))
    arguments = [
        "--data",
        str(tmp_path / "set"),
        "--checkpoint",
        str(tmp_path / "net.safetensors"),
        "--json",
        str(tmp_path / "scores.json"),
    ]
    assert evaluate.main(arguments) == 0
    assert "note: 1 objects may be scored in vain, such as far: the cameras stand 2.60" in capsys.readouterr().err


def test_any_view_may_be_the_source(tmp_path):
    """The middle one is that between the others; an object without that number is left out."""
    net = SplatterNet(ModelConfig.from_dict(TINY)).eval()
    write_object(tmp_path / "a", angles=((-20, 0), (20, 0), (2, 1), (10, 0)))
    write_object(tmp_path / "b", angles=ANGLES[:2])
    angles = {}
    for source in (0, 1, "middle"):
        report = score_folder(net, tmp_path / "a", source=source)
        angles[source] = [(row["angle_deg"], row["views"]) for row in report["bins"]]
    assert angles == {0: [(20, 1), (30, 1), (40, 1)], 1: [(10, 1), (20, 1), (40, 1)], "middle": [(10, 1), (20, 2)]}
    report = score_folder(net, tmp_path, source=3)
    assert report["objects"] == 1 and "expected a source view of 0..1, got 3" in report["skipped"]["b"]
    with pytest.raises(SystemExit):
        evaluate.main(["--data", str(tmp_path), "--json", "s.json", "--source", "-1"])


def test_flat_card_is_seen_where_its_points_project():
    """A picture whose values are its own coordinates says which of its points a pixel shows."""
    intrinsics, depth = torch.tensor([90.0, 95.0, 33.0, 25.0]), 1.3
    rows, columns = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    poses = np.stack([look_at(10, 5), look_at(25, -4), look_at(-15, 12), look_at(190, 5)])
    cameras = torch.from_numpy(relative_cameras(poses, poses[0])).float()
    card = render_card(torch.stack([columns, rows]), intrinsics, depth, cameras, intrinsics.expand(4, 4))
    torch.testing.assert_close(card[0], torch.stack([columns, rows]), atol=1e-3, rtol=0)
    for camera, seen in zip(cameras[1:3].double(), card[1:3]):
        for row, column in ((10, 20), (24, 32), (35, 50)):
            across = (seen[:, row, column] - intrinsics[2:]) / intrinsics[:2] * depth
            x, y, z = (camera @ torch.cat([across, torch.tensor([depth, 1])]).double())[:3]
            assert float(90 * x / z + 33) == pytest.approx(column + 0.5, abs=0.02)
            assert float(95 * y / z + 25) == pytest.approx(row + 0.5, abs=0.02)
    behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))[None]
    assert not render_card(torch.ones(1, 48, 64), intrinsics, depth, behind, intrinsics[None]).any()


def test_azimuths_of_known_cameras():
    cameras = np.stack([look_at(azimuth, elevation) for azimuth, elevation in ((30, 10), (50, 16), (10, 4), (30, -20))])
    np.testing.assert_allclose(np.abs(azimuths_from_source(cameras)), [0, 20, 20, 0], atol=1e-9)
    assert np.prod(np.sign(azimuths_from_source(cameras)[1:3])) == -1
    np.testing.assert_allclose(np.abs(azimuths_from_source(cameras[:2])), [0, 20], atol=1e-9)
    np.testing.assert_allclose(azimuths_from_source(cameras[[0, 3]]), [0, 0], atol=1e-9)  # one above the other
    behind = np.stack([look_at(0, 5), look_at(180, 10)])
    np.testing.assert_allclose(np.abs(azimuths_from_source(behind)), [0, 180], atol=1e-9)
    roll = np.eye(4)
    roll[:2, :2] = [[0, -1], [1, 0]]
    with pytest.raises(InputError, match="roll"):
        azimuths_from_source(np.stack([cameras[0], cameras[1] @ roll, cameras[2], look_at(70, 30) @ roll]))


def test_command_writes_scores_and_pictures(tmp_path, capsys):
    write_object(tmp_path / "set/a", angles=ANGLES)
    SplatterNet(ModelConfig.from_dict(TINY)).save(tmp_path / "net.safetensors")
    arguments = [
        "--data",
        str(tmp_path / "set"),
        "--checkpoint",
        str(tmp_path / "net.safetensors"),
        "--save-renders",
        str(tmp_path / "renders"),
        "--json",
        str(tmp_path / "scores.json"),
    ]
    assert evaluate.main(arguments) == 0
    scores = json.loads((tmp_path / "scores.json").read_text())
    metrics = {"psnr_db", "ssim", "copy_psnr_db", "copy_ssim", "card_psnr_db", "card_ssim"}
    assert metrics <= scores.keys() and all(metrics | {"angle_deg"} <= row.keys() for row in scores["bins"])
    picture = np.asarray(Image.open(tmp_path / "renders/a.png"))
    assert picture.shape == (2 * 96, 5 * 128, 3) and (WIDTH, HEIGHT) == (64, 48)
    printed = capsys.readouterr().out
    assert "all" in printed and "source" in printed and "card PSNR" in printed


def test_objects_of_one_name_have_pictures_of_their_own(tmp_path):
    for name in ("cars/001", "chairs/001", "one"):
        write_object(tmp_path / "set" / name, angles=ANGLES[:2])
    net, renders = SplatterNet(ModelConfig.from_dict(TINY)).eval(), tmp_path / "renders"
    score_folder(net, tmp_path / "set", save_renders=renders)
    assert {path.relative_to(renders).as_posix() for path in renders.rglob("*.png")} == {
        "cars/001.png",
        "chairs/001.png",
        "one.png",
    }
    score_folder(net, tmp_path / "set/one", save_renders=tmp_path / "single")
    assert (tmp_path / "single/one.png").exists()


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["--data", "{tmp}/none"], "no such folder"),
        (["--data", "{tmp}"], "no object"),
        (["--data", "{tmp}", "--checkpoint", "{tmp}/none.safetensors"], "no such checkpoint"),
    ],
)
def test_command_reports_bad_input_in_one_line(tmp_path, capsys, arguments, word):
    if "--checkpoint" not in arguments:
        SplatterNet(ModelConfig.from_dict(TINY)).save(tmp_path / "net.safetensors")
        arguments = [*arguments, "--checkpoint", "{tmp}/net.safetensors"]
    arguments = [argument.format(tmp=tmp_path) for argument in arguments]
    assert evaluate.main([*arguments, "--json", str(tmp_path / "scores.json")]) == 2
    error = capsys.readouterr().err
    assert word in error and error.count("\n") == 1
    assert not (tmp_path / "scores.json").exists()
