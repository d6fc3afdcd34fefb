"""Captures of apps, and what a transforms.json may say or leave out; what is no capture is named."""

import json
import zipfile

import numpy as np
import pytest
from capture_scene import CENTRE, HEIGHT, WIDTH, dots, ring, said, to_world, write_ring
from PIL import Image
from transforms_scene import OPENGL

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_files import read_camera_file
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.captures.pinhole import pose_matrix


def test_scaled_rotations_are_divided_by_their_scale(tmp_path):
    """And only these: what is mirrored or sheared is refused still; cameras for --camera are read alike."""
    write_ring(tmp_path / "whole")
    whole = said(tmp_path / "whole")[0]

    def times(matrix):
        def change(frames):
            for frame in frames:
                pose = np.array(frame["transform_matrix"])
                pose[:3, :3] = pose[:3, :3] @ matrix
                frame["transform_matrix"] = pose.tolist()

        return change

    for scale in (0.01, 30.0):
        write_ring(tmp_path, change=times(scale * np.eye(3)))
        capture, assumed = said(tmp_path)
        np.testing.assert_allclose(capture.world_to_camera, whole.world_to_camera, atol=1e-12)
        assert f"the rotations of 6 of 6 cameras are scaled, the first by {scale:g}" in assumed
        with pytest.warns(Assumption, match="the rotations of 6 of 6 cameras are scaled"):
            cameras = read_camera_file(tmp_path / "transforms.json")
        np.testing.assert_allclose([one.world_to_camera for one in cameras], whole.world_to_camera, atol=1e-12)
    for matrix, words in ((np.diag([1, 1, -0.5]), "no rotation"), (np.diag([-2, 2, 2]), "mirrors")):
        write_ring(tmp_path, change=times(matrix))
        with pytest.raises(InputError, match=words):
            read_capture(tmp_path)


@pytest.mark.parametrize("matrix", [None, [], "no key", [[float("nan")] * 4] * 4, [[None] * 4] * 4])
def test_frames_without_a_pose_are_left_out(tmp_path, matrix):
    def change(frames):
        frames[2]["transform_matrix"] = matrix
        if matrix == "no key":
            del frames[2]["transform_matrix"]

    write_ring(tmp_path, change=change)
    capture, assumed = said(tmp_path)
    assert len(capture.names) == 5 and "1 of 6 frames has no pose and is left out: images/2.png" in assumed


def test_frames_that_are_there_twice_count_once(tmp_path):
    write_ring(tmp_path, change=lambda frames: frames.append({**frames[0], "file_path": "./images/0.png"}))
    capture, assumed = said(tmp_path)
    assert len(capture.names) == 6 and "1 of 7 frames is the same as one before and is left out" in assumed
    write_ring(tmp_path, change=lambda frames: frames.append({**frames[0], "fl_x": 71}))
    with pytest.raises(InputError, match="got 'images/0.png' twice, with different poses or cameras: take one out"):
        read_capture(tmp_path)


def test_an_angle_of_view_beside_another_focal_length_is_said(tmp_path):
    write_ring(tmp_path, camera_angle_x=1.2019)  # that of fl_x, rounded
    assert "camera_angle_x" not in said(tmp_path)[1]
    write_ring(tmp_path, camera_angle_x=0.7)
    assert (
        "6 of 6 frames have a camera_angle_x of another focal length than fl_x, 0.7 and not 1.202" in said(tmp_path)[1]
    )


def test_files_of_frames_by_other_names_are_named(tmp_path):
    write_ring(tmp_path, name="cams.json")
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(InputError, match=f"is no capture: give the one that it holds, {tmp_path / 'cams.json'}$"):
        read_capture(tmp_path)


def held(capture, *arguments) -> list[str]:
    """The names that a capture's split holds out."""
    return [capture.names[index] for index in capture.split(*arguments)[1]]


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_the_lists_of_a_file_hold_out(tmp_path):
    def names(*indices):
        return [f"./images/{index}.png" for index in indices]

    write_ring(tmp_path, train_filenames=names(0, 1, 2, 4), val_filenames=names(3), test_filenames=names(3))
    with pytest.warns(Assumption, match="1 photograph is in none of its lists of names .* left out: images/5.png"):
        capture = read_capture(tmp_path)
    with pytest.warns(Assumption, match="1 of 5 photographs is held out, as val_filenames and test_filenames of tran"):
        assert held(capture) == ["3.png"]
    assert held(capture, 2) == ["1.png", "3.png"] and held(capture, None) == []
    assert held(capture, None, ["4.png"]) == ["4.png"]
    write_ring(tmp_path, train_filenames=names(0, 1, 2, 3, 4))
    assert held(read_capture(tmp_path)) == ["5.png"]
    write_ring(tmp_path, test_filenames=[*names(2), "images/none.png"])
    with pytest.warns(
        Assumption, match="1 name in its lists of photographs is of no frame with a pose: images/none.png"
    ):
        assert held(read_capture(tmp_path)) == ["2.png"]
    write_ring(tmp_path, train_filenames=names(*range(6)), test_filenames=names(*range(6)))
    assert held(read_capture(tmp_path)) == ["4.png"] == held(read_capture(tmp_path), 8)  # the middle of every 8


def test_a_folder_of_train_and_test_files(tmp_path):
    """Tests are held out, also those that are among the photographs to fit to; the file itself is read alone."""
    write_ring(tmp_path, 5, "transforms_train.json")
    write_ring(tmp_path, 2, "transforms_test.json", first=4)
    write_ring(tmp_path, 1, "transforms_val.json", first=6)
    capture, assumed = said(tmp_path)
    assert capture.names == [f"{index}.png" for index in range(6)]
    assert "1 photograph of transforms_train.json is in transforms_test.json too" in assumed
    assert "transforms_val.json is not read" in assumed
    with pytest.warns(Assumption, match="2 of 6 photographs are held out, as transforms_test.json says: 4.png, 5.png"):
        assert held(capture) == ["4.png", "5.png"]
    assert len(said(tmp_path / "transforms_train.json")[0].names) == 5
    (tmp_path / "transforms_test.json").unlink()
    assert said(tmp_path)[0].held_out == ("6.png",)


def test_raw_data_of_polycam(tmp_path):
    """Corrected cameras, or else those that the phone tracked."""
    matrices = to_world(4)
    for kind in ("cameras", "images"):
        (tmp_path / "keyframes" / kind).mkdir(parents=True)
    for index, matrix in enumerate(matrices):
        numbers = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        numbers |= {"fx": 70.0, "fy": 78.0, "cx": CENTRE[0], "cy": CENTRE[1], "width": WIDTH, "height": HEIGHT}
        (tmp_path / f"keyframes/cameras/{1000 + index}.json").write_text(json.dumps(numbers))
        Image.fromarray(dots([(20, 20)])).save(tmp_path / f"keyframes/images/{1000 + index}.jpg")
    capture = said(tmp_path)[0]
    for kind in ("cameras", "images"):
        (tmp_path / "keyframes" / kind).rename(tmp_path / f"keyframes/corrected_{kind}")
    for found in (capture, said(tmp_path)[0]):
        assert found.names == [f"{1000 + index}.jpg" for index in range(4)]
        np.testing.assert_allclose(found.world_to_camera, [pose_matrix(*pose) for pose in ring(4)], atol=1e-12)
        np.testing.assert_array_equal(found.intrinsics[0], [70, 78, *CENTRE])
    (tmp_path / "keyframes/corrected_cameras/1001.json").write_text("{}")
    with pytest.raises(InputError, match="1001.json: fx: missing: expected a number"):
        read_capture(tmp_path)


def test_record3d(tmp_path):
    poses = []
    for turn, shift in ring(4):  # world to camera: about y, and away
        w, _, y, _ = turn
        place = -pose_matrix(turn, shift)[:3, :3].T @ shift
        poses.append([w, 0, 0, 0, *place])  # x, y, z, w: turned half about x, to OpenGL's axes, and back about y
        poses[-1][:4] = [w, 0, y, 0]
    data = {"w": WIDTH, "h": HEIGHT, "K": [70, 0, 0, 0, 78, 0, *CENTRE, 1], "poses": [*poses, [0] * 7], "fps": 60}
    (tmp_path / "metadata.json").write_text(json.dumps(data))
    (tmp_path / "rgb").mkdir()
    for index in range(5):
        Image.fromarray(dots([(20, 20)])).save(tmp_path / f"rgb/{index}.jpg")
    capture, assumed = said(tmp_path)
    np.testing.assert_allclose(capture.world_to_camera, [pose_matrix(*pose) for pose in ring(4)], atol=1e-12)
    assert capture.names == ["0.jpg", "1.jpg", "2.jpg", "3.jpg"] and "1 of 5 frames has no pose there" in assumed
    np.testing.assert_array_equal(capture.intrinsics[0], [70, 78, *CENTRE])
    data["perFrameIntrinsicCoeffs"] = [[60 + index, 61, 40, 30] for index in range(5)]
    (tmp_path / "metadata.json").write_text(json.dumps(data))
    np.testing.assert_array_equal(said(tmp_path / "metadata.json")[0].intrinsics[:, 0], [60, 61, 62, 63])


def test_cameras_json_beside_photographs(tmp_path):
    (tmp_path / "images").mkdir()
    entries = []
    for index, matrix in enumerate(to_world(3) @ OPENGL):
        Image.fromarray(dots([(20, 20)])).save(tmp_path / f"images/a{index}.png")
        entry = {"img_name": f"a{index}", "rotation": matrix[:3, :3].tolist(), "position": matrix[:3, 3].tolist()}
        entries.append({**entry, "fx": 70.0, "fy": 78.0, "width": WIDTH, "height": HEIGHT})
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    for given in (tmp_path, tmp_path / "cameras.json"):
        capture = said(given)[0]
        np.testing.assert_allclose(capture.world_to_camera, [pose_matrix(*pose) for pose in ring(3)], atol=1e-12)


def test_files_that_are_no_capture_are_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "capture.zip", "w") as archive:
        archive.writestr("sparse/0/images.txt", "")
    (tmp_path / "images.bin").write_bytes(bytes(8))
    (tmp_path / "film.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(16))
    (tmp_path / "notes.txt").write_text("table")
    for name, words in (
        ("capture.zip", "is an archive: unpack it, and give the folder"),
        ("images.bin", "is one file of a COLMAP model: give the folder"),
        ("film.mp4", "is a film without cameras: sfm=True chooses frames and finds their cameras"),
        ("notes.txt", "expected a capture, got a file of another kind"),
    ):
        with pytest.raises(InputError, match=f"{name}: {words}"):
            read_capture(tmp_path / name)
