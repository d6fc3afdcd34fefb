"""Captures as other programs, apps and systems leave them: read, or named with what to do; never guessed in silence."""

import os
import struct
import unicodedata

import numpy as np
import pytest
from capture_scene import CENTRE, FOCAL, HEIGHT, WIDTH, dots, ring, said, write_capture, write_model, write_ring
from PIL import Image
from transforms_scene import OPENGL

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.captures.colmap import read_model
from lightfield_gs.io.captures.pinhole import pose_matrix
from lightfield_gs.io.images import write_image


def write_points(path, columns: dict) -> None:
    """A .ply of these columns."""
    kinds = {"u": ("uchar", "u1"), "f": ("float", "<f4")}
    told = [(name, *kinds[column.dtype.kind]) for name, column in columns.items()]
    rows = np.empty(len(columns["x"]), [(name, kind) for name, _, kind in told])
    for name, column in columns.items():
        rows[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {kind} {name}" for name, kind, _ in told]
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + rows.tobytes())


PLACES = {"x": np.array([1.0, -1]), "y": np.array([2.0, 0.5]), "z": np.array([3.0, 2])}


def test_lines_of_observations_may_be_absent(tmp_path):
    write_capture(tmp_path, form="txt", names=["0 a.png", *(f"{index}.png" for index in range(1, 5))])
    path = tmp_path / "sparse/0/images.txt"
    whole, assumed = said(tmp_path)
    assert assumed == ""
    lines = [line for line in path.read_text().split("\n") if line.endswith("png")]
    path.write_text("# one line each\n" + "\n".join(lines))
    capture, assumed = said(tmp_path)
    assert capture.names == whole.names and "4 of 5 photographs in images.txt have no line of observations" in assumed
    np.testing.assert_array_equal(capture.world_to_camera, whole.world_to_camera)


def test_whole_numbers_may_be_written_as_floats(tmp_path):
    write_capture(tmp_path, form="txt")
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace(f" {WIDTH} {HEIGHT} ", f" {WIDTH}.0 {HEIGHT}.000 "))
    np.testing.assert_array_equal(said(tmp_path)[0].sizes_px[0], (WIDTH, HEIGHT))
    path.write_text(path.read_text().replace(f" {WIDTH}.0 ", f" {WIDTH}.5 "))
    with pytest.raises(InputError, match="expected whole numbers, got '7 96.5 72.000'"):
        read_capture(tmp_path)


RIG = ((0.9, 0.1, -0.2, 0.3), (0.1, -0.2, 0.05))  # rig to its second camera


def _write_rigs(folder, form: str, frames: list) -> None:
    """Rig 3 of cameras 7 and 8 (posed), 9 (not posed) and an IMU. frames: (pose, photographs by camera)."""
    turn, shift = RIG
    if form == "bin":
        data = struct.pack("<QIIiI", 1, 3, 4, 0, 7) + struct.pack("<iIB4d3d", 0, 8, 1, *turn, *shift)
        data += struct.pack("<iIB", 0, 9, 0) + struct.pack("<iIB4d3d", 1, 7, 1, 1, 0, 0, 0, 0, 0, 0)
        (folder / "rigs.bin").write_bytes(data)
        data = struct.pack("<Q", len(frames))
        for index, (pose, images) in enumerate(frames):
            data += struct.pack("<II4d3dI", index, 3, *pose[0], *pose[1], len(images) + 1)
            data += b"".join(struct.pack("<iIQ", 0, camera, image) for camera, image in images.items())
            data += struct.pack("<iIQ", 1, 7, 1)
        (folder / "frames.bin").write_bytes(data)
        return
    numbers = " ".join(map(str, [*turn, *shift]))
    (folder / "rigs.txt").write_text(f"# rigs\n3 4 CAMERA 7 CAMERA 8 1 {numbers} CAMERA 9 0 IMU 7 1 1 0 0 0 0 0 0\n")
    lines = ["# frames"]
    for index, (pose, images) in enumerate(frames):
        seen = " ".join(f"CAMERA {camera} {image}" for camera, image in images.items())
        lines.append(f"{index} 3 {' '.join(map(str, [*pose[0], *pose[1]]))} {len(images) + 1} {seen} IMU 7 1")
    (folder / "frames.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_poses_are_those_of_frames_and_rigs(tmp_path, form):
    """As COLMAP 4 composes them; those that images has right stay to the bit, and so does a camera without a place."""
    cameras = [(number, "PINHOLE", WIDTH, HEIGHT, [70.0, 78.0, *CENTRE]) for number in (7, 8, 9)]
    poses = ring(4)
    stale = [(f"{index}.png", (7, 8, 9, 7)[index], *pose) for index, pose in enumerate(poses)]
    write_model(tmp_path, form, cameras, stale)
    before = [image.world_to_camera for image in read_model(tmp_path).images]
    _write_rigs(tmp_path, form, [(poses[0], {7: 1, 8: 2, 9: 3}), (poses[2], {7: 4})])
    with pytest.warns(Assumption, match=f"the poses of 2 of 4 photographs are those of frames.{form} and rigs.{form}"):
        found = [image.world_to_camera for image in read_model(tmp_path).images]
    np.testing.assert_array_equal([found[0], found[2]], [before[0], before[2]])
    np.testing.assert_allclose(found[1], pose_matrix(*RIG) @ pose_matrix(*poses[0]), atol=1e-14)
    np.testing.assert_allclose(found[3], pose_matrix(*poses[2]), atol=1e-14)


def test_the_largest_of_several_models_is_read(tmp_path):
    write_capture(tmp_path, count=6)
    (tmp_path / "sparse/0").rename(tmp_path / "sparse/2")
    for number, count in ((0, 2), (1, 6)):
        images = [(f"{index:03d}.png", 7, *pose) for index, pose in enumerate(ring(count))]
        write_model(tmp_path / f"sparse/{number}", "txt", [(7, "PINHOLE", WIDTH, HEIGHT, [70, 78, *CENTRE])], images)
    capture, assumed = said(tmp_path)
    assert len(capture.names) == 6 and "sparse/1 of 6 photographs is read, not 0 of 2, 2 of 6 beside it" in assumed
    assert len(said(tmp_path / "sparse/0", images=tmp_path / "images")[0].names) == 2  # that was given itself
    (tmp_path / "sparse/0/images.txt").unlink()
    (tmp_path / "sparse/1/images.txt").write_text("damaged\n")
    assert len(said(tmp_path)[0].points) == 3  # those of model 2


def test_points_of_ply_files(tmp_path):
    """Beside a model, of another program, and of a scene of Gaussians; those that the model has come first."""
    write_capture(tmp_path)
    colours = {
        "red": np.array([1, 2], np.uint8),
        "green": np.array([3, 4], np.uint8),
        "blue": np.array([5, 6], np.uint8),
    }
    write_points(tmp_path / "sparse/0/points3D.ply", {**PLACES, **colours})
    capture, assumed = said(tmp_path)
    assert len(capture.points) == 3 and assumed == ""
    (tmp_path / "sparse/0/points3D.bin").unlink()
    capture, assumed = said(tmp_path)
    np.testing.assert_array_equal(capture.points, [(1, 2, 3), (-1, 0.5, 2)])
    assert capture.colours.tolist() == [[1, 3, 5], [2, 4, 6]] and "the 2 points of" in assumed
    (tmp_path / "sparse/0/points3D.ply").unlink()
    harmonics = {f"f_dc_{band}": np.array([0.0, 1.0 - band]) for band in range(3)}
    write_points(tmp_path / "sparse/0/cloud.ply", {**PLACES, **harmonics})
    assert said(tmp_path)[0].colours.tolist() == [[128, 128, 128], [199, 128, 56]]  # 0.5 +- 0.2821
    (tmp_path / "sparse/0/cloud.ply").write_text("ply\nformat binary_little_endian 1.0\nend_header\n")
    assert "points beside the photographs are not used: " in said(tmp_path)[1]


def test_points_beside_a_transforms_json(tmp_path):
    """A .ply of nerfstudio's name is read, also one that was in another folder.

    Else the points are those of the COLMAP model, moved as the cameras were, whatever applied_transform says.
    """
    matrices = write_ring(tmp_path, applied_transform=np.eye(3, 4).tolist())
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    moved = []
    for matrix in matrices:  # the model's world: ours turned, shifted and twice as large
        pose = np.eye(4)
        pose[:3, :3] = (turn @ matrix[:3, :3] @ OPENGL[:3, :3]).T
        pose[:3, 3] = -pose[:3, :3] @ (2 * turn @ matrix[:3, 3] + (3, 4, 5))
        moved.append(pose)
    place = np.array((0.3, -0.2, 0.4))
    images = []
    for index, pose in enumerate(moved):
        w = np.sqrt(max(0.0, 1 + np.trace(pose[:3, :3]))) / 2
        x, y, z = ((pose[a, b] - pose[b, a]) / (4 * w) for a, b in ((2, 1), (0, 2), (1, 0)))
        images.append((f"{index}.jpg", 7, (w, x, y, z), pose[:3, 3]))
    points = [(2 * turn @ place + (3, 4, 5), (9, 8, 7))] * 2
    model = tmp_path / "colmap/sparse/0"
    write_model(model, "bin", [(7, "PINHOLE", WIDTH, HEIGHT, [70, 78, *CENTRE])], images, points)
    capture, assumed = said(tmp_path)
    np.testing.assert_allclose(capture.points, [place] * 2, atol=1e-9)
    assert "by 6 cameras that both have" in assumed and capture.colours[0].tolist() == [9, 8, 7]
    write_model(model, "bin", [(7, "PINHOLE", WIDTH, HEIGHT, [70, 78, *CENTRE])], images[::2] + images[1:2], points)
    shuffled = [(f"{5 - index}.jpg", *image[1:]) for index, image in enumerate(images)]
    write_model(model, "bin", [(7, "PINHOLE", WIDTH, HEIGHT, [70, 78, *CENTRE])], shuffled, points)
    capture, assumed = said(tmp_path)
    assert not len(capture.points) and "its cameras do not stand as those of the photographs do" in assumed
    write_points(tmp_path / "sparse_pc.ply", PLACES)
    assert len(said(tmp_path)[0].points) == 2
    write_ring(tmp_path, ply_file_path="D:\\scans\\clouds\\own.ply")
    write_points(tmp_path / "own.ply", {key: column[:1] for key, column in PLACES.items()})
    capture, assumed = said(tmp_path)
    assert len(capture.points) == 1 and "own.ply, by the last parts of its name" in assumed


@pytest.mark.parametrize("damage", ["missing", "cut", "empty", "raw"])
def test_one_photograph_that_cannot_be_read_is_left_out(tmp_path, damage):
    names = [f"{index}.{'dng' if damage == 'raw' and index == 2 else 'jpg'}" for index in range(5)]
    write_capture(tmp_path, names=[name.replace("dng", "png") for name in names], picture=dots([(20, 20)]))
    if damage == "raw":
        write_model(
            tmp_path / "sparse/0",
            "bin",
            [(7, "PINHOLE", WIDTH, HEIGHT, [70, 78, *CENTRE])],
            [(name, 7, *pose) for name, pose in zip(names, ring(5))],
        )
        (tmp_path / "images/2.png").rename(tmp_path / "images/2.dng")
    path = tmp_path / "images" / names[2]
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage != "raw":
        path.write_bytes(data[: len(data) // 2] if damage == "cut" else b"")
    words = {"missing": "1 of 5 photographs is missing and left out: 2.jpg"}
    capture, assumed = said(tmp_path)
    assert capture.names == [names[index] for index in (0, 1, 3, 4)]
    assert words.get(damage, "1 of 5 photographs cannot be read and is left out: ") in assumed
    for index in (1, 3, 4):
        (tmp_path / "images" / names[index]).unlink()
    with pytest.raises(InputError, match="missing 4 of 5|missing 3 of 5"):
        read_capture(tmp_path)


def test_photographs_of_a_kind_that_is_not_read_are_named(tmp_path):
    """All are there, but raw: that is what is said, though masks have the same names."""
    write_capture(tmp_path, names=["0.png", "1.png", "2.png"])
    (tmp_path / "masks").mkdir()
    for index in range(3):
        Image.new("L", (WIDTH, HEIGHT)).save(tmp_path / f"masks/{index}.png")
        (tmp_path / f"images/{index}.png").rename(tmp_path / f"images/{index}.DNG")
    with pytest.raises(
        InputError, match="3 of 3 photographs cannot be read: .*0.DNG is a camera's raw file, a kind that"
    ):
        read_capture(tmp_path)


def test_linear_photographs_are_encoded(tmp_path):
    names = ["0.exr", "1.exr", "2.exr"]
    light = np.random.default_rng(2).random((HEIGHT, WIDTH, 3), np.float32) * 1.2
    write_capture(tmp_path, names=[name.replace("exr", "png") for name in names])
    images = [(name, 7, *pose) for name, pose in zip(names, ring(3))]
    write_model(tmp_path / "sparse/0", "bin", [(7, "PINHOLE", WIDTH, HEIGHT, [*FOCAL[2], *CENTRE])], images)
    for name in names:
        (tmp_path / "images" / name.replace("exr", "png")).unlink()
        write_image(tmp_path / "images" / name, light)
    capture, assumed = said(tmp_path)
    assert "3 of 3 photographs hold linear light, as 0.exr: it is encoded as sRGB" in assumed
    np.testing.assert_array_equal(capture.image(0), np.rint(255 * encode_srgb(light.clip(0, 1))))


def test_names_are_matched_after_normalising(tmp_path):
    """Files as macOS names them, letters and accents apart, and a model that has them together."""
    names = [f"Küche {index}.png" for index in range(3)]
    write_capture(tmp_path, names=[unicodedata.normalize("NFC", name) for name in names])
    for name in names:
        image = tmp_path / "images" / unicodedata.normalize("NFC", name)
        image.rename(image.with_name(unicodedata.normalize("NFD", name)))
    assert said(tmp_path)[0].names == [unicodedata.normalize("NFC", name) for name in names]


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize("page, word", [("cp1252", "Küche"), ("cp932", "表紙ソ"), ("cp1251", "снимок")])
def test_names_of_windows_code_pages(tmp_path, page, word, form):
    """The page by which the files are there; half of a Japanese letter may be a backslash."""
    names = [f"{word} {index}.png" for index in range(3)]
    write_capture(tmp_path, form=form, names=names)
    path = tmp_path / f"sparse/0/images.{form}"
    path.write_bytes(path.read_bytes().replace(word.encode(), word.encode(page)))
    capture, assumed = said(tmp_path)
    assert capture.names == names and f"Windows' code page {page[2:]}: {names[0]}" in assumed


def test_links_to_folders_are_followed(tmp_path):
    write_capture(tmp_path, names=["a/0.png", "a/1.png", "b/2.png"])
    for name in "ab":
        (tmp_path / "images" / name).rename(tmp_path / f"disk-{name}")
        os.symlink(tmp_path / f"disk-{name}", tmp_path / "images" / name)
    os.symlink(tmp_path / "images", tmp_path / "images/again")
    capture, assumed = said(tmp_path)
    assert capture.names == ["a/0.png", "a/1.png", "b/2.png"] and assumed == ""
    write_ring(tmp_path / "other")
    (tmp_path / "other/images").rename(tmp_path / "disk")
    os.symlink(tmp_path / "disk", tmp_path / "other/images")
    assert len(said(tmp_path / "other")[0].names) == 6


@pytest.mark.parametrize("before", ["D:\\scans\\shelf\\images\\", "/home/me/images/", "input/"])
def test_photographs_in_other_folders_are_found_by_their_last_parts(tmp_path, before):
    write_capture(tmp_path, names=[f"{name}/{index}.png" for name in "ab" for index in range(3)])
    poses = ring(6)
    images = [(f"{before}{name}/{index}.png", 7, *poses[index]) for name in "ab" for index in range(3)]
    write_model(tmp_path / "sparse/0", "bin", [(7, "PINHOLE", WIDTH, HEIGHT, [70, 78, *CENTRE])], images)
    capture, assumed = said(tmp_path)
    assert capture.names == [f"{name}/{index}.png" for name in "ab" for index in range(3)]
    assert "6 of 6 photographs are found by the last parts of their names" in assumed
    (tmp_path / "images/a").rename(tmp_path / "images/left")
    (tmp_path / "images/b").rename(tmp_path / "images/right")  # which is which, nothing says
    with pytest.raises(InputError, match="missing 6 of 6"):
        read_capture(tmp_path)


def test_a_mask_is_not_taken_for_a_missing_photograph(tmp_path):
    write_capture(tmp_path, names=[f"{index}.png" for index in range(5)])
    (tmp_path / "masks").mkdir()
    for index in range(5):
        Image.new("L", (WIDTH, HEIGHT), 255).save(tmp_path / f"masks/{index}.png")
    (tmp_path / "images/3.png").unlink()
    assert "3.png" not in said(tmp_path)[0].names
    (tmp_path / "images").rename(tmp_path / "photos")
    capture, assumed = said(tmp_path)
    assert capture.photographs[0].path == tmp_path / "photos/0.png" and "0.png is photos/0.png" in assumed
    assert capture.mask(0) is None and "masks counts" in assumed  # whose names are those within photos


def test_other_extensions_in_a_transforms_json(tmp_path):
    write_ring(tmp_path)
    for path in sorted((tmp_path / "images").iterdir()):
        Image.open(path).save(path.with_suffix(".JPG"))
        path.unlink()
    capture, assumed = said(tmp_path)
    assert capture.names[0] == "0.JPG" and "images/0.png is images/0.JPG" in assumed
    (tmp_path / "images/4.JPG").unlink()
    assert "1 of 6 photographs is missing and left out: images/4.png" in said(tmp_path)[1]
