"""The reader and validator of SRN-layout folders."""

import tarfile

import numpy as np
import pytest
import torch
from faulty_set import assert_fault_is_named
from PIL import Image
from srn_scene import look_at, write_object

from lightfield_gs.io.captures.objects import read_pose
from training.comparison import azimuths_from_source
from training.data.cache import load_set
from training.data.images import read_view
from training.data.objects import find_objects, read_object
from training.data.resident import ResidentViews
from training.data.sampler import angles_from_source
from training.data.validate import main, problems


def test_reads_the_original_renderer(shared_dir):
    (folder,) = find_objects(shared_dir / "data/srn")
    views = read_object(folder)
    assert views.intrinsics.tolist() == [[131.25, 131.25, 64, 64]] * len(views.image_paths)
    assert (views.width_px, views.height_px) == (128, 128)
    assert len(views.image_paths) == len(list((folder / "rgb").iterdir())) == len(views.camera_to_world)
    positions, forward = views.camera_to_world[:, :3, 3], views.camera_to_world[:, :3, 2]
    np.testing.assert_allclose(positions[0], (-0.12943094968795776, 1.0043233633041382, 0.6438802480697632))
    # Every camera looks at the origin from 1.2 away: z points forward.
    np.testing.assert_allclose(positions + np.linalg.norm(positions, axis=1)[:, None] * forward, 0, atol=1e-4)
    assert read_view(views, 0).shape == (128, 128, 4)


def test_rendered_objects_are_well_and_stand_at_the_documented_angles(shared_dir, tmp_path):
    with tarfile.open(shared_dir / "data/objects/val.tar.gz") as archive:
        members = [m for m in archive if "cone/cc0_mixed__alien/" in m.name]
        archive.extractall(tmp_path, members, filter="data")
    assert list(problems(find_objects(tmp_path))) == []
    views = read_object(next(tmp_path.rglob("cc0_mixed__alien")))
    found = azimuths_from_source(views.camera_to_world).reshape(3, 9)
    np.testing.assert_allclose(np.abs(found), np.tile(np.abs([0, -20, -15, -10, -5, 5, 10, 15, 20]), (3, 1)), atol=1e-3)
    assert (np.sign(found[:, 1:5]) == -np.sign(found[:, 5:])).all()


@pytest.mark.parametrize("suffix", [".png", ".webp", ".jpg"])
def test_image_formats(tmp_path, suffix):
    write_object(tmp_path / "a", suffix=suffix)
    views = read_object(tmp_path / "a")
    pixels = read_view(views, 0)
    assert pixels.dtype == np.uint8 and pixels.shape == (48, 64, 4)
    assert pixels[24, 32, 3] == 255 and pixels[0, 0, 3] == 0  # an opaque format gets its mask from the white background
    assert (pixels[0, 0] == 0).all()


def test_opaque_picture_without_plain_background_is_all_subject(tmp_path):
    write_object(tmp_path / "a", suffix=".png")
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "a/rgb/000000.png")
    assert (read_view(read_object(tmp_path / "a"), 0)[..., 3] == 255).all()


def test_world_to_camera_flag(tmp_path):
    write_object(tmp_path / "a")
    expected = read_object(tmp_path / "a").camera_to_world
    for path in (tmp_path / "a/pose").iterdir():
        np.savetxt(path, np.linalg.inv(read_pose(path)))
    with open(tmp_path / "a/intrinsics.txt", "a") as file:
        file.write("1\n")
    np.testing.assert_allclose(read_object(tmp_path / "a").camera_to_world, expected, atol=1e-12)


def _edit_poses(folder, matrix):
    for path in (folder / "pose").iterdir():
        np.savetxt(path, read_pose(path) @ matrix)


def _write(path, text):
    path.write_text(text)


def _set_intrinsics(folder, first_line, last_line="48 64"):
    (folder / "intrinsics.txt").write_text(f"{first_line}\n0 0 0\n1\n{last_line}\n")


FAULTS = {
    "mirrored axes": (lambda f: _edit_poses(f, np.diag([-1, 1, 1, 1])), "wrong handedness.*mirrors"),
    "OpenGL axes": (lambda f: _edit_poses(f, np.diag([1, -1, -1, 1])), "wrong handedness.*look away"),
    "missing pose": (lambda f: (f / "pose/000001.txt").unlink(), "missing poses.*000001"),
    "missing image": (lambda f: (f / "rgb/000002.png").unlink(), "missing images.*000002"),
    "no poses": (lambda f: [p.unlink() for p in (f / "pose").iterdir()], "missing poses"),
    "no images": (lambda f: [p.unlink() for p in (f / "rgb").iterdir()], "no image"),
    "no intrinsics": (lambda f: (f / "intrinsics.txt").unlink(), "missing intrinsics"),
    "zero focal length": (lambda f: _set_intrinsics(f, "0 32 24 0"), "bad intrinsics.*focal"),
    "centre outside": (lambda f: _set_intrinsics(f, "70 99 24 0"), "bad intrinsics.*outside"),
    "other size": (lambda f: _set_intrinsics(f, "70 32 24 0", "64 64"), "bad intrinsics.*64 x 48"),
    "short intrinsics": (lambda f: _write(f / "intrinsics.txt", "70 32 24\n"), "bad intrinsics"),
    "words in intrinsics": (lambda f: _write(f / "intrinsics.txt", "focal\n"), "expected lines of numbers"),
    "15 numbers": (lambda f: _write(f / "pose/000000.txt", "1 " * 15), "bad pose.*16"),
    "infinite pose": (lambda f: _write(f / "pose/000000.txt", "inf " * 16), "bad pose"),
    "no rotation": (lambda f: _write(f / "pose/000000.txt", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"), "bad pose.*rotation"),
    "no image data": (lambda f: _write(f / "rgb/000001.png", "hello"), "unreadable image"),
    "empty image": (lambda f: Image.new("RGBA", (64, 48)).save(f / "rgb/000001.png"), "empty image"),
    "faint image": (lambda f: Image.new("RGBA", (64, 48), (9, 9, 9, 40)).save(f / "rgb/000001.png"), "empty mask"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_validator_names_the_fault(tmp_path, fault, capsys):
    break_it, pattern = FAULTS[fault]
    write_object(tmp_path / "set/good")
    write_object(tmp_path / "set/bad")
    break_it(tmp_path / "set/bad")
    assert_fault_is_named(tmp_path, pattern, capsys)
    assert not list((tmp_path / "cache").iterdir())


def test_validator_accepts_good_data(tmp_path, capsys):
    write_object(tmp_path / "good")
    assert main([str(tmp_path)]) == 0
    assert "1 objects" in capsys.readouterr().out
    assert main([str(tmp_path / "none")]) == 2
    assert capsys.readouterr().err.startswith("training.data.validate: error: ")


def test_cache_holds_the_very_pixels(tmp_path):
    for name in ("a", "b"):
        write_object(tmp_path / "set" / name, seed=ord(name))
    cached = load_set(tmp_path / "set", tmp_path / "cache", workers=1)
    resident = ResidentViews([cached, cached])  # the second time at other offsets
    for index, folder in enumerate(2 * find_objects(tmp_path / "set")):
        views, first = read_object(folder), resident.first_view[index]
        for view in range(len(views.image_paths)):
            np.testing.assert_array_equal(resident.camera_to_world[first + view], views.camera_to_world[view])
            rectangle, frame = resident.rectangles[first + view], read_view(views, view)
            window = resident.windows(torch.from_numpy(rectangle[None]), 48, 64)[0].numpy()
            _, left, top, width, height = rectangle
            assert not window[height:].any() and not window[:, width:].any()
            redrawn = np.zeros_like(frame)
            redrawn[top : top + height, left : left + width] = window[:height, :width]
            np.testing.assert_array_equal(redrawn, frame)
    write_object(tmp_path / "set/c")  # a changed set is decoded anew
    assert len(load_set(tmp_path / "set", tmp_path / "cache", workers=1).objects) == 3


def test_sets_whose_names_have_dots_have_caches_of_their_own(tmp_path):
    pixels = []
    for seed in (1, 2):
        write_object(tmp_path / "set.v1/a", seed=seed)
        pixels.append(np.array(load_set(tmp_path / "set.v1", tmp_path / "cache", workers=1).pixels))
    assert not np.array_equal(*pixels)
    assert len(list((tmp_path / "cache").glob("set.v1-*"))) == 4


def test_angles_of_known_cameras():
    cameras = np.stack([look_at(0, 0), look_at(20, 0), look_at(0, 10)])
    angles = angles_from_source(cameras, cameras[0])
    np.testing.assert_allclose(np.abs(angles), [[0, 0], [20, 0], [0, 10]], atol=1e-9)
