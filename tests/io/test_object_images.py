"""Sets as people have them: Exif orientations, masks, file names of other systems, lens distortion, contact sheets."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from srn_scene import FOCAL, HEIGHT, WIDTH, write_object
from transforms_scene import CAMERA, edit, write_transforms

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import BROWN_COEFFICIENTS, distort_brown
from lightfield_gs.io.captures.masks import find_object_masks
from lightfield_gs.io.captures.objects import read_nerf_object
from lightfield_gs.io.captures.undistortion import fraction_beyond
from training.data.images import find_cutout, read_view
from training.data.objects import read_object
from training.data.validate import main, problems

ORIENTATION = 0x0112


def _write_set(folder: Path, orientation: int = 1, camera=CAMERA) -> list[np.ndarray]:
    """An object of four noisy opaque pictures with this Exif orientation; returns their pixels [H,W,3] as stored."""
    write_transforms(folder, camera=camera)
    rng, exif, pictures = np.random.default_rng(0), Image.Exif(), []
    exif[ORIENTATION] = orientation
    for path in sorted((folder / "transforms").iterdir()):
        pictures.append(rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8))
        Image.fromarray(pictures[-1]).save(path, exif=exif)
    return pictures


@pytest.mark.parametrize("camera", [CAMERA, {"camera_angle_x": 0.9}])
def test_poses_are_of_the_pixels_as_stored(tmp_path, camera, capsys):
    pictures = _write_set(tmp_path / "a", 6, camera)
    views = read_object(tmp_path / "a/transforms.json")
    for index, picture in enumerate(pictures):
        np.testing.assert_array_equal(read_view(views, index)[..., :3], picture)
    assert main([str(tmp_path)]) == 0
    assert "Exif orientation 6 in 4 of 4 views is not applied" in capsys.readouterr().out


def test_cameras_of_the_turned_pictures_are_refused(tmp_path):
    _write_set(tmp_path / "a", 8, {**CAMERA, "w": HEIGHT, "h": WIDTH, "cx": 24, "cy": 32})
    for line in problems([tmp_path / "a/transforms.json"]):
        assert all(
            word in line
            for word in ("transforms.json: w, h", "48 x 64", "64 x 48", "Exif orientation 8", "auto-orient")
        )


def _mask(index: int, scale: int = 255) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:30, 10 + index : 40] = scale
    return mask


@pytest.mark.parametrize(
    "name", ["masks/{stem}.png", "masks/{stem}.png.png", "masks/transforms/{stem}.PNG", "m/{stem}.png"]
)
def test_masks_are_used(tmp_path, name):
    """Masks that the file names, else masks in masks/, also with values 0 and 1, as stored like the images."""
    pictures = _write_set(tmp_path / "a", 6)
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    for index in range(4):
        path = tmp_path / "a" / name.format(stem=f"{index:06d}")
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(_mask(index, 255 if index % 2 else 1)).save(path, exif=exif)
    if name.startswith("m/"):
        edit(
            tmp_path / "a/transforms.json",
            lambda data: [frame.update(mask_path=f".\\m\\{index:06d}") for index, frame in enumerate(data["frames"])],
        )
    views = read_object(tmp_path / "a/transforms.json")
    assert find_cutout(views).by == "masks"
    for index, picture in enumerate(pictures):
        frame, mask = read_view(views, index), _mask(index)
        np.testing.assert_array_equal(frame[..., 3], mask)
        np.testing.assert_array_equal(frame[..., :3], picture * (mask > 0)[..., None])


def test_masks_of_images_that_are_in_no_folder(tmp_path):
    (tmp_path / "masks").mkdir()
    images = [tmp_path / "a.png", tmp_path / "b.png"]
    for image in images:
        (tmp_path / "masks" / f"{image.name}.png").touch()
    assert find_object_masks(tmp_path, images) == tuple(tmp_path / "masks" / f"{image.name}.png" for image in images)


def test_masks_of_an_srn_object(tmp_path):
    write_object(tmp_path / "a")
    (tmp_path / "a/masks").mkdir()
    for index in range(3):
        Image.fromarray(_mask(index)).save(tmp_path / f"a/masks/{index:06d}.png")
    with pytest.raises(InputError, match="a/masks: missing masks: none for 000003.png"):
        read_object(tmp_path / "a")
    Image.new("L", (8, 8)).save(tmp_path / "a/masks/000003.png")
    views = read_object(tmp_path / "a")
    assert (read_view(views, 1)[..., 3] <= _mask(1)).all() and read_view(views, 1)[..., 3].any()
    with pytest.raises(InputError, match="000003.png: expected a mask of the image's size 64 x 48, got 8 x 8"):
        read_view(views, 3)


def test_scaled_rotations_are_divided_by_their_scale(tmp_path):
    write_transforms(tmp_path / "whole")
    write_transforms(tmp_path / "scaled")

    def scale(data):
        for frame in data["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) * (0.5, 0.5, 0.5, 1)).tolist()

    edit(tmp_path / "scaled/transforms.json", scale)
    with pytest.warns(Assumption, match="cameras are scaled, the first by 0.5: they are divided by it"):
        found = read_nerf_object(tmp_path / "scaled/transforms.json")
    whole = read_nerf_object(tmp_path / "whole/transforms.json")
    np.testing.assert_allclose(found.camera_to_world, whole.camera_to_world, atol=1e-12)


def test_names_of_other_systems(tmp_path):
    """Backslashes, a byte-order mark, other case, no extension."""
    write_transforms(tmp_path / "a")
    pixels = read_view(read_object(tmp_path / "a/transforms.json"), 2)
    (tmp_path / "a/transforms").rename(tmp_path / "a/Images")
    for path in list((tmp_path / "a/Images").iterdir()):
        path.rename(path.with_suffix(".PNG"))
    names = [".\\images\\000000.png", "images\\000001", "./Images/000002", "Images/000003.png"]
    edit(
        tmp_path / "a/transforms.json",
        lambda data: [frame.update(file_path=name) for frame, name in zip(data["frames"], names)],
    )
    file = tmp_path / "a/transforms.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    views = read_object(file)
    assert [path.name for path in views.image_paths] == [f"00000{index}.PNG" for index in range(4)]
    np.testing.assert_array_equal(read_view(views, 2), pixels)
    shutil.copy(tmp_path / "a/Images/000000.PNG", tmp_path / "a/Images/000000.Png")
    with pytest.raises(InputError, match=r"frames\[0\].file_path: .* may be 000000.PNG or 000000.Png: rename one"):
        read_object(file)


LENS = dict(zip(BROWN_COEFFICIENTS, (-0.21, 0.05, -0.02, 0.01, 0.004, -0.006)))


def test_lens_model_is_the_formula():
    """Term by term, in Python's own numbers."""
    for x, y in ((0.3, -0.2), (-0.45, 0.1), (0.0, 0.6)):
        r2 = x**2 + y**2
        radial = 1 + LENS["k1"] * r2 + LENS["k2"] * r2**2 + LENS["k3"] * r2**3 + LENS["k4"] * r2**4
        expected = (
            x * radial + 2 * LENS["p1"] * x * y + LENS["p2"] * (r2 + 2 * x**2),
            y * radial + LENS["p1"] * (r2 + 2 * y**2) + 2 * LENS["p2"] * x * y,
        )
        np.testing.assert_allclose(distort_brown(np.array([x, y]), np.array([*LENS.values()])), expected, rtol=1e-14)


def test_distorted_pictures_become_those_of_a_pinhole_camera(tmp_path):
    """A picture whose colours say where a point of the scene is, seen through the lens, is seen as without it."""
    camera = {**CAMERA, "fl_x": 50.0, "fl_y": 55.0, "cx": 30.0, "cy": 26.0}
    write_transforms(tmp_path / "a", camera={**camera, **LENS, "camera_model": "OPENCV"})
    places = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
    seen = (places - (30, 26)) / (50, 55)
    points = seen.copy()
    for _ in range(50):  # the inverse: which point is seen in each pixel
        points -= distort_brown(points, np.array([*LENS.values()])) - seen
    assert np.abs(distort_brown(points, np.array([*LENS.values()])) - seen).max() < 1e-12
    scene = 128 + 140 * points
    for path in (tmp_path / "a/transforms").iterdir():
        picture = np.dstack([scene, np.full(scene.shape[:2], 77)]).round().clip(0, 255)
        Image.fromarray(picture.astype(np.uint8)).save(path)
    views = read_object(tmp_path / "a/transforms.json")
    np.testing.assert_array_equal(views.intrinsics, np.tile((50, 55, 30, 26), (4, 1)))
    frame = read_view(views, 1).astype(float)
    inner = frame[..., 3] == 255
    assert 0.9 < inner.mean() <= 1 and not frame[frame[..., 3] == 0].any()
    expected = 128 + 140 * seen  # of a pinhole camera
    assert np.abs(frame[..., :2] - expected)[inner].max() < 2


def test_alpha_and_masks_are_undistorted_too(tmp_path, capsys):
    camera = {**CAMERA, "k1": -0.4}
    write_transforms(tmp_path / "a", camera=camera)
    (tmp_path / "a/masks").mkdir()
    disc = np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] + 0.5 - np.array([HEIGHT / 2, WIDTH / 2])[:, None, None])) < 20
    for path in (tmp_path / "a/transforms").iterdir():
        Image.new("RGB", (WIDTH, HEIGHT), (9, 200, 9)).save(path)
        Image.fromarray(255 * disc.astype(np.uint8)).save(tmp_path / "a/masks" / path.name)
    frame = read_view(read_object(tmp_path / "a/transforms.json"), 0)
    radius = np.sqrt((frame[..., 3] / 255).sum() / np.pi)
    wanted = next(r for r in np.arange(15, 30, 0.01) if r * (1 - 0.4 * (r / FOCAL) ** 2) >= 20)
    assert wanted > 20.5 and abs(radius - wanted) < 0.1
    assert main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "undistorted (k1 -0.4) to a pinhole camera of 64 x 48 px, fx 70, fy 70, cx 32, cy 24" in said


def test_how_much_of_a_picture_is_beyond_the_undistorted_one():
    intrinsics, none = np.array([70.0, 70, 32, 24]), np.zeros(6)
    assert fraction_beyond(intrinsics, none, 64, 48) == 0
    k1 = np.array([-0.3, 0, 0, 0, 0, 0])
    # In the middle of each side the frame ends at r (1 + k1 r^2) of the stored picture, in corners at less.
    sides = [r * (1 - 0.3 * r**2) / r for r in (32 / 70, 24 / 70)]
    assert 1 - sides[0] * sides[1] < fraction_beyond(intrinsics, k1, 64, 48) < 0.25


def test_contact_sheet_shows_what_is_left_out(tmp_path, capsys):
    write_object(tmp_path / "set/good")
    write_object(tmp_path / "set/bad")
    (tmp_path / "set/bad/rgb/000001.png").write_bytes(b"")
    shutil.copytree(tmp_path / "set/good", tmp_path / "set/none")
    (tmp_path / "set/none/intrinsics.txt").unlink()
    sheet = tmp_path / "sheet.png"
    assert main([str(tmp_path / "set"), "--sheet", str(sheet)]) == 2
    printed = capsys.readouterr()
    assert "bad, good: cut out by alpha" in printed.out and "3 of 3 objects" in printed.out
    assert len(printed.err.splitlines()) == 2  # of bad and none
    pixels = np.asarray(Image.open(sheet)).astype(int)
    views = read_object(tmp_path / "set/good")
    row, scale = 96 + 14 + 4, 2
    for column in range(4):
        top, left = row + 14, 4 + column * 132
        thumb = pixels[top : top + 96 : scale, left : left + 128 : scale]
        frame = read_view(views, column)
        np.testing.assert_array_equal(thumb[frame[..., 3] == 255], frame[frame[..., 3] == 255][:, :3])
        outside = thumb[frame[..., 3] == 0]
        assert (outside[:, [0, 2]] > 150).all() and (outside[:, 1] < 100).all()
    assert (pixels[14:100, 140:250] == (255, 90, 90)).all()  # the view that cannot be read
    assert main([str(tmp_path / "set"), "--sheet", str(tmp_path / "sheet.gif")]) == 2
    assert "expected a contact sheet's name to end in .png" in capsys.readouterr().err


def test_srn_cameras_far_from_the_object_are_noted(tmp_path, capsys):
    """Such poses are taken as they are, unlike those of transforms.json."""
    write_object(tmp_path / "a")
    for path in (tmp_path / "a/pose").iterdir():
        pose = np.loadtxt(path).reshape(4, 4)
        pose[:3, 3] *= 2
        np.savetxt(path, pose.reshape(1, 16))
    assert main([str(tmp_path)]) == 0
    said = capsys.readouterr().err
    assert said.startswith("note: a: the cameras stand 2.60 units") and "by 0.5\n" in said


def test_notes_on_what_may_not_be_meant(tmp_path, capsys):
    _write_set(tmp_path / "a")
    assert main([str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert "whole pictures are the subject" in printed.out
    assert printed.err.startswith("note: ") and "the whole picture is object in 4 of 4 views" in printed.err
