"""The reader of transforms.json, beside the SRN reader, and the way from own data to an own checkpoint."""

import json
import math
import re
import shutil

import numpy as np
import pytest
import torch
import yaml
from faulty_set import assert_fault_is_named
from photo_cases import TINY
from PIL import Image
from srn_scene import HEIGHT, WIDTH, look_at, write_object
from test_evaluate import ANGLES, KnownScene
from transforms_scene import OPENGL, edit, write_transforms

from lightfield_gs import Gaussians, InputError, cli
from lightfield_gs.models import ModelConfig, SplatterNet
from training import evaluate, train
from training.data.cache import load_set
from training.data.images import read_view
from training.data.objects import find_objects, read_object
from training.data.resident import ResidentViews
from training.data.validate import main, problems
from training.evaluation import score_folder
from training.rendering import render_views


def test_same_object_in_both_layouts(tmp_path):
    """Also in a world of another size, which the reader brings back to the network's."""
    write_object(tmp_path / "set/srn")
    write_transforms(tmp_path / "set/nerf", scale=3.1)
    nerf, srn = (read_object(path) for path in find_objects(tmp_path / "set"))
    assert (nerf.name, srn.name) == ("nerf", "srn")
    np.testing.assert_allclose(nerf.camera_to_world, srn.camera_to_world, atol=1e-12)
    np.testing.assert_array_equal(nerf.intrinsics, srn.intrinsics)
    assert (nerf.width_px, nerf.height_px) == (srn.width_px, srn.height_px)
    for view in range(len(srn.image_paths)):
        np.testing.assert_array_equal(read_view(nerf, view), read_view(srn, view))
    cached = load_set(tmp_path / "set", tmp_path / "cache", workers=1)
    resident, count = ResidentViews([cached]), len(srn.image_paths)
    pixels = resident.windows(torch.from_numpy(resident.rectangles), 48, 64)
    assert torch.equal(pixels[:count], pixels[count:]) and pixels.any()
    np.testing.assert_array_equal(cached.objects[0].intrinsics, nerf.intrinsics)


def test_pictures_of_a_known_scene_are_drawn_again(tmp_path):
    """Every frame has a camera of its own: pixels that are not square, principal points off-centre, large units."""
    rng, count = torch.Generator().manual_seed(0), 40
    means = 0.15 * torch.randn(count, 3, generator=rng) + torch.tensor([0, 0, 1.3])
    scales = 0.03 + 0.02 * torch.rand(count, 3, generator=rng)
    scene = Gaussians(
        means,
        torch.randn(count, 4, generator=rng),
        scales,
        torch.full((count,), 0.9),
        torch.randn(count, 1, 3, generator=rng),
    )
    poses = np.stack([look_at(*angles) for angles in ANGLES])
    cameras = torch.from_numpy(np.linalg.inv(poses) @ poses[0]).float()
    steps = torch.arange(len(ANGLES))[:, None]
    intrinsics = torch.tensor([[140.0, 120, 64, 48]]) + steps * torch.tensor([[2.0, -3, 1.5, -2]])
    batched = Gaussians(*(field[None] for field in scene.fields().values()))
    images, alpha = render_views(batched, cameras[None], intrinsics[None], 128, 96, torch.zeros(1, len(ANGLES), 3))
    straight = images[0].permute(0, 2, 3, 1) / alpha[0, ..., None].clamp_min(1e-6)
    pixels = (torch.cat([straight, alpha[0, ..., None]], -1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    frames = []
    for index, (fx, fy, cx, cy) in enumerate(intrinsics.tolist()):
        Image.fromarray(pixels[index]).save(tmp_path / f"{index}.png")
        pose = poses[index] @ OPENGL
        pose[:3, 3] *= 4
        frames.append(
            {"file_path": str(index), "transform_matrix": pose.tolist(), "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        )
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames, "fl_x": 1.0}))
    report = score_folder(KnownScene(scene), tmp_path)
    assert report["psnr_db"] > 50 and report["copy_psnr_db"] < 30


def _angle(size: float, focal: float) -> float:
    return 2 * math.atan(size / 2 / focal)


@pytest.mark.parametrize(
    "camera, expected",
    [
        ({"camera_angle_x": _angle(WIDTH, 80)}, (80, 80, 32, 24)),
        ({"camera_angle_y": _angle(HEIGHT, 50)}, (50, 50, 32, 24)),
        ({"camera_angle_x": _angle(WIDTH, 80), "camera_angle_y": _angle(HEIGHT, 50), "cy": 20.5}, (80, 50, 32, 20.5)),
        ({"fl_x": 70, "camera_angle_x": 0.1, "cx": 31}, (70, 70, 31, 24)),
        ({"fl_x": 70, "fl_y": 71, "w": WIDTH, "h": HEIGHT, "k1": 0, "camera_model": "OPENCV"}, (70, 71, 32, 24)),
    ],
)
def test_ways_to_say_the_camera(tmp_path, camera, expected):
    write_transforms(tmp_path / "a", camera=camera)
    views = read_object(tmp_path / "a/transforms.json")
    np.testing.assert_allclose(views.intrinsics, np.tile(expected, (4, 1)))
    assert (views.width_px, views.height_px) == (WIDTH, HEIGHT)


def test_splits(tmp_path):
    """Training takes the split "train", scores "val" unless told otherwise; transforms.json beside them is not read."""
    write_transforms(tmp_path / "set/a", "transforms_train.json")
    write_transforms(tmp_path / "val", "transforms_val.json", angles=((0, 0), (7, 0), (-5, 0)))
    for path in (tmp_path / "val").iterdir():
        shutil.move(path, tmp_path / "set/a" / path.name)
    shutil.copy(tmp_path / "set/a/transforms_val.json", tmp_path / "set/a/transforms.json")
    write_transforms(tmp_path / "set/b")
    names = {
        split: [path.relative_to(tmp_path / "set").as_posix() for path in find_objects(tmp_path / "set", split)]
        for split in ("train", "val", "test", None)
    }
    assert names == {
        "train": ["a/transforms_train.json", "b/transforms.json"],
        "val": ["a/transforms_val.json", "b/transforms.json"],
        "test": ["b/transforms.json"],
        None: ["a/transforms_train.json", "a/transforms_val.json", "b/transforms.json"],
    }
    cached = load_set(tmp_path / "set", tmp_path / "cache", workers=1)
    assert [len(views.camera_to_world) for views in cached.objects] == [4, 4]
    net = SplatterNet(ModelConfig.from_dict(TINY)).eval()
    assert score_folder(net, tmp_path / "set")["views"] == 2 + 3  # but for the source of each
    assert score_folder(net, tmp_path / "set", split="train")["views"] == 3 + 3
    with pytest.raises(InputError, match="transforms_test.json"):
        find_objects(tmp_path / "set/a", "test")


def test_transforms_file_of_an_srn_renderer_is_no_object(tmp_path):
    write_object(tmp_path / "a")
    (tmp_path / "a/pose/transforms.json").write_text("{}")
    assert find_objects(tmp_path) == [tmp_path / "a"]


def _set(**values):
    return lambda data: data.update(values)


def _set_frame(**values):
    return lambda data: data["frames"][2].update(values)


def _turn(data, matrix):
    for frame in data["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ matrix).tolist()


def _one_direction(data):
    for index, frame in enumerate(data["frames"]):
        frame["transform_matrix"] = [[1, 0, 0, 0.1 * index], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]


FAULTS = {
    "no frames": (_set(frames=[]), "frames: expected a list"),
    "frames of another kind": (_set(frames={"a": 1}), "frames: expected a list"),
    "frame of another kind": (lambda d: d["frames"].insert(2, 7), r"frames\[2\]: expected an object"),
    "no file_path": (lambda d: d["frames"][2].pop("file_path"), r"frames\[2\].file_path"),
    "missing image": (_set_frame(file_path="transforms/9"), r"frames\[2\].file_path: missing image"),
    "image that none can be": (_set_frame(file_path="\ud800"), r"frames\[2\].file_path.*surrogates"),
    "image elsewhere": (_set_frame(file_path="../good/transforms/000000.png"), r"frames\[2\].file_path.*leads out"),
    "no matrix": (lambda d: d["frames"][2].pop("transform_matrix"), r"frames\[2\].transform_matrix: bad pose"),
    "3 rows": (_set_frame(transform_matrix=[[1, 0, 0, 0]] * 3), r"frames\[2\].transform_matrix: bad pose.*4 rows"),
    "ragged matrix": (_set_frame(transform_matrix=[[1, 2], [3]]), r"frames\[2\].transform_matrix: bad pose"),
    "words in matrix": (_set_frame(transform_matrix=[["1"] * 4] * 4), r"frames\[2\].transform_matrix: bad pose"),
    "NaN in matrix": (_set_frame(transform_matrix=[[math.nan] * 4] * 4), r"frames\[2\].transform_matrix: bad pose"),
    "stretched matrix": (_set_frame(transform_matrix=np.diag([2, 1, 2, 1]).tolist()), r"frames\[2\].*no rotation"),
    "mirrored axes": (lambda d: _turn(d, np.diag([-1, 1, 1, 1])), r"frames\[0\].transform_matrix: wrong handedness"),
    "OpenCV axes": (lambda d: _turn(d, OPENGL), "transform_matrix: wrong handedness.*OpenGL axes"),
    "one direction": (_one_direction, "transform_matrix: the 4 cameras look in one direction"),
    "no focal length": (lambda d: [d.pop("fl_x"), d.pop("fl_y")], "missing focal length.*camera_angle_x"),
    "negative focal length": (_set(fl_x=-3), "bad intrinsics.*focal"),
    "word as focal length": (_set(fl_x="70"), "fl_x: expected a number"),
    "infinite focal length": (_set(fl_x=math.inf), "fl_x: expected a number"),
    "wide angle": (lambda d: [d.pop("fl_x"), d.update(camera_angle_x=3.5)], "camera_angle_x: expected 0 to pi"),
    "centre outside": (_set_frame(cx=99), r"frames\[2\]: bad intrinsics.*outside"),
    "half a pixel": (_set(w=64.5), "whole width"),
    "other size": (_set(w=48), "bad intrinsics.*64 x 48"),
    "sizes differ": (_set_frame(w=48), r"frames\[2\]: bad intrinsics: expected the size"),
    "impossible distortion": (_set(k1=-30), r"frames\[0\].*k1 -30 folds.*undistort"),
    "word as distortion": (_set(k1="0.1"), "k1: expected a number"),
    "distortion of another model": (_set(k1=0.1, k6=0.2), "k6.*undistort"),
    "fisheye": (_set(camera_model="OPENCV_FISHEYE"), "camera_model.*OPENCV_FISHEYE.*undistort"),
    "fisheye by its flag": (_set(is_fisheye=True), "is_fisheye.*undistort"),
    "exchanged size": (_set(w=HEIGHT, h=WIDTH, cx=24, cy=32), "w, h.*48 x 64.*64 x 48.*exchanged"),
    "mask of one frame": (_set_frame(mask_path="transforms/000000.png"), r"frames\[0\]: missing mask_path"),
    "missing mask": (lambda d: [f.update(mask_path="m") for f in d["frames"]], r"frames\[0\].mask_path: missing image"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_validator_names_file_and_field(tmp_path, fault, capsys):
    change, pattern = FAULTS[fault]
    write_transforms(tmp_path / "set/good")
    write_transforms(tmp_path / "set/bad")
    edit(tmp_path / "set/bad/transforms.json", change)
    assert_fault_is_named(tmp_path, pattern, capsys)


@pytest.mark.parametrize(
    "text, pattern",
    [("{", "is not JSON"), ("[]", "expected an object"), ("[" * 9999, "not JSON"), ('{"frames": [{}]}', "file_path")],
)
def test_damaged_files(tmp_path, text, pattern):
    write_transforms(tmp_path / "a")
    (tmp_path / "a/transforms.json").write_text(text)
    (line,) = problems(find_objects(tmp_path))
    assert re.search(pattern, line) and str(tmp_path / "a/transforms.json") in line


def test_two_layouts_in_one_folder(tmp_path):
    write_object(tmp_path / "a")
    (tmp_path / "a/transforms.json").write_text("{}")
    (line,) = problems(find_objects(tmp_path))
    assert "expected one layout" in line


@pytest.mark.slow
def test_from_own_data_to_own_checkpoint(tmp_path, capsys):
    """The commands of docs/training.md, on a network small enough to train in seconds."""
    for name in ("train/a", "train/b", "val/c"):
        write_transforms(tmp_path / name, seed=ord(name[-1]))
    assert main([str(tmp_path)]) == 0
    unet = {"base_channels": 8, "multipliers": [1, 2], "blocks": 1, "attention_px": [8], "heads": 2}
    (tmp_path / "model.yaml").write_text(yaml.safe_dump({"image_size_px": 16, "features": 8, "unet": unet}))
    (tmp_path / "own.yaml").write_text(
        yaml.safe_dump(
            {
                "output_dir": str(tmp_path / "run"),
                "data": [str(tmp_path / "train")],
                "cache_dir": str(tmp_path / "cache"),
                "model": str(tmp_path / "model.yaml"),
                "stages": [{"steps": 2, "image_size_px": 16, "objects": 2}],
                "targets": 1,
                "optimizer": {"warmup_steps": 1},
            }
        )
    )
    assert train.main(["--config", str(tmp_path / "own.yaml")]) == 0
    weights = str(tmp_path / "run/model.safetensors")
    scores = str(tmp_path / "scores.json")
    assert evaluate.main(["--data", str(tmp_path / "val"), "--checkpoint", weights, "--json", scores]) == 0
    assert json.loads((tmp_path / "scores.json").read_text())["views"] == 3
    photo = str(tmp_path / "val/c/transforms/000000.png")
    output = tmp_path / "light-field.png"
    assert cli.main(["encode", photo, "-o", str(output), "--panel", "toy-8v", "--checkpoint", weights]) == 0
    assert output.exists()
