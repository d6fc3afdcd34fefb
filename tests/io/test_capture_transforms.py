"""Captures of transforms.json: nerfstudio's and instant-ngp's."""

import json

import numpy as np
import pytest
from capture_scene import CENTRE, DOTS, HEIGHT, MODELS, WIDTH, centre_of_dot, dots, in_pixels, seen, write_capture
from PIL import Image
from transforms_scene import OPENGL, edit

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.capture import read_capture

CAMERA = {"w": WIDTH, "h": HEIGHT, "fl_x": 70.0, "fl_y": 78.0, "cx": CENTRE[0], "cy": CENTRE[1]}
KEYS = {
    "OPENCV": ["k1", "k2", "p1", "p2"],
    "OPENCV_FISHEYE": ["k1", "k2", "k3", "k4"],
    "THIN_PRISM_FISHEYE": ["k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"],
}


def _write(folder, model="PINHOLE", **camera):
    """Write a capture as transforms.json with the poses of a COLMAP model, and return the poses.

    The model is where nerfstudio leaves it, and only its points are read.
    """
    picture = dots([in_pixels(model, seen(model, *dot)) for dot in DOTS])
    write_capture(folder / "colmap", "PINHOLE")
    poses = read_capture(folder / "colmap").world_to_camera
    (folder / "images/a").mkdir(parents=True)
    frames = []
    for index, pose in enumerate(poses):
        Image.fromarray(picture).save(folder / f"images/a/{index}.png")
        matrix = (np.linalg.inv(pose) @ OPENGL).tolist()
        frames.append({"file_path": f"./images/a/{index}.png", "transform_matrix": matrix})
    (folder / "transforms.json").write_text(json.dumps({"camera_model": model, **CAMERA, **camera, "frames": frames}))
    return poses


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
@pytest.mark.parametrize("model", ["PINHOLE", *KEYS])
def test_same_as_colmaps(tmp_path, model):
    """Poses, and dots where a lens without distortion shows them, of lenses named by keys."""
    coefficients = dict(zip(KEYS.get(model, []), MODELS[model][2]))
    poses = _write(tmp_path, model, **coefficients)
    capture = read_capture(tmp_path)
    assert capture.names == ["0.png", "1.png", "2.png"] and len(capture.points) == 3
    np.testing.assert_allclose(capture.world_to_camera, poses, atol=1e-12)
    np.testing.assert_allclose(capture.intrinsics[0], [70, 78, *CENTRE])
    for dot in DOTS:
        place = in_pixels(model, seen("FISHEYE", *dot) if "FISHEYE" in model else dot)
        assert np.abs(centre_of_dot(capture.image(2), place) - place).max() < 0.25


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_fisheyes_of_instant_ngp(tmp_path):
    _write(tmp_path, "OPENCV_FISHEYE", camera_model=None, is_fisheye=True, k1=0.1, k2=-0.05, k3=0.2, k4=0.03)
    capture = read_capture(tmp_path / "transforms.json", longest_px=WIDTH // 2)
    place = np.array(in_pixels("OPENCV_FISHEYE", seen("FISHEYE", *DOTS[1]))) / 2
    assert np.abs(centre_of_dot(capture.image(0), place, 4) - place).max() < 0.25


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_points_masks_and_reduced_copies(tmp_path):
    _write(tmp_path)
    header = "ply\nformat ascii 1.0\nelement vertex 2\n"
    header += "".join(f"property float {key}\n" for key in "xyz")
    header += "".join(f"property uchar {key}\n" for key in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "sparse_pc.ply").write_text(header + "1 2 3 4 5 255\n-1 0.5 2 0 1 2\n")
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:20] = 255
    (tmp_path / "m").mkdir()
    Image.fromarray(mask).save(tmp_path / "m/0.png")
    (tmp_path / "images_2").mkdir()
    for index in range(3):
        Image.new("RGB", (WIDTH // 2, HEIGHT // 2)).save(tmp_path / f"images_2/{index}.png")

    def change(data):
        data.update(ply_file_path="sparse_pc.ply", applied_transform=np.eye(4)[[0, 2, 1]].tolist())
        data["frames"][0]["mask_path"] = "m/0.png"

    edit(tmp_path / "transforms.json", change)
    capture = read_capture(tmp_path)
    np.testing.assert_array_equal(capture.points, [(1, 2, 3), (-1, 0.5, 2)])
    np.testing.assert_array_equal(capture.colours, [(4, 5, 255), (0, 1, 2)])
    np.testing.assert_array_equal(capture.mask(0), mask)
    assert capture.mask(1) is None
    half = read_capture(tmp_path, images="images_2")
    np.testing.assert_allclose(half.intrinsics, capture.intrinsics / 2)
    np.testing.assert_array_equal(half.mask(0), mask[1::2, 1::2])
    write_capture(tmp_path, names=["a/0.png", "a/1.png", "a/2.png"])
    with pytest.warns(Assumption, match="the COLMAP model .*sparse/0 is read, not .*transforms.json"):
        assert len(read_capture(tmp_path).points) == 3


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda d: d["frames"][1].update(file_path="images/none.png"), "missing 1 of 3 photographs: images/none.png"),
        (
            lambda d: d["frames"][1].update(file_path="images/a/0.png"),
            "each photograph once, got 'images/a/0.png' twice",
        ),
        (lambda d: d["frames"][2].update(transform_matrix=[[1, 0]]), r"frames\[2\].transform_matrix: expected 4 rows"),
        (
            lambda d: [frame.pop("transform_matrix") for frame in d["frames"]],
            r"expected some with a pose \(transform_matrix\), got 3 without",
        ),
        (lambda d: d.update(camera_model="VR180_L"), "camera_model: expected one of SIMPLE_PINHOLE"),
        (lambda d: d.update(k5=0.1), "k5: expected a lens of k1, k2, k3, k4, p1, p2 alone"),
        (lambda d: d.update(k1="x"), "k1 must be a number"),
        (lambda d: d.update(ply_file_path="none.ply"), "ply_file_path: expected the name of a .ply"),
        (lambda d: d.update(frames=[]), "frames: expected a list of views"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, change, words):
    _write(tmp_path)
    edit(tmp_path / "transforms.json", change)
    with pytest.raises(InputError, match=words):
        read_capture(tmp_path)
