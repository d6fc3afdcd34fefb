"""Exports of apps as phones write them: depth maps become points, a dataparser's transform moves the world."""

import json

import numpy as np
import pytest
from capture_scene import CENTRE, HEIGHT, WIDTH, dots, ring, said, to_world, write_ring
from PIL import Image

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_files import read_camera_file
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.captures.pinhole import pose_matrix
from lightfield_gs.io.images import write_image

FOCAL = (70.0, 78.0)


def _write_plane(path, unit: float, tilt: float = 0.02):
    """A depth map, half as large as the photographs, of the plane z = 1.5 + tilt * column; its left column is empty."""
    depth = np.tile(1.5 + tilt * np.arange(WIDTH // 2), (HEIGHT // 2, 1))
    depth[:, 0] = 0
    if path.suffix == ".exr":
        write_image(path, (depth / unit).astype(np.float32)[..., None])
    else:
        Image.fromarray(np.rint(depth / unit).astype(np.uint16)).save(path)


def _are_on_planes(points: np.ndarray, poses: np.ndarray, tilt: float = 0.02) -> np.ndarray:
    """Which points [P,3] are on the plane of one of the cameras [C,4,4], and in its view."""
    on = np.zeros(len(points), bool)
    for pose in poses:
        x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
        column, row = (FOCAL[0] * x / z + CENTRE[0]) / 2 - 0.5, (FOCAL[1] * y / z + CENTRE[1]) / 2 - 0.5
        inside = (column > 0.5) & (column < WIDTH / 2) & (row > -0.6) & (row < HEIGHT / 2)
        on |= inside & (np.abs(z - (1.5 + tilt * column)) < 2e-3)
    return on


def test_polycams_depth_and_border(tmp_path):
    """Sure depths become points with the photographs' colours; the black border of corrected images does not count."""
    frames = tmp_path / "keyframes"
    for kind in ("corrected_cameras", "corrected_images", "depth", "confidence"):
        (frames / kind).mkdir(parents=True)
    for index, matrix in enumerate(to_world(4)):
        numbers = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        numbers |= {"fx": FOCAL[0], "fy": FOCAL[1], "cx": CENTRE[0], "cy": CENTRE[1], "width": WIDTH, "height": HEIGHT}
        name = f"{86523 + index}"
        (frames / f"corrected_cameras/{name}.json").write_text(json.dumps(numbers | {"blur_score": 100.5}))
        Image.new("RGB", (WIDTH, HEIGHT), (200, 100, 50)).save(frames / f"corrected_images/{name}.jpg", quality=100)
        _write_plane(frames / f"depth/{name}.png", 1e-3)
        sure = np.full((HEIGHT // 2, WIDTH // 2), 127, np.uint8)
        sure[: HEIGHT // 4] = 255
        Image.fromarray(sure).save(frames / f"confidence/{name}.png")
    (tmp_path / "mesh_info.json").write_text("{}")
    capture, assumed = said(tmp_path)
    assert "begins at 3384 points by 4 of 4 depth maps" in assumed and "no points" not in assumed  # 47 x 18 each
    assert len(capture.points) == 4 * (WIDTH // 2 - 1) * (HEIGHT // 4)
    assert _are_on_planes(capture.points, capture.world_to_camera).all()
    assert np.abs(capture.colours.astype(int) - (200, 100, 50)).max() <= 2
    mask = capture.mask(0)
    assert "15 pixels at each edge" in assumed and mask[15:-15, 15:-15].min() == 255
    assert mask.sum() == 255 * (WIDTH - 30) * (HEIGHT - 30)


def test_record3ds_depth(tmp_path):
    poses = []
    for turn, shift in ring(4):
        w, _, y, _ = turn
        poses.append([w, 0, y, 0, *(-pose_matrix(turn, shift)[:3, :3].T @ shift)])
    data = {"w": WIDTH, "h": HEIGHT, "K": [FOCAL[0], 0, 0, 0, FOCAL[1], 0, *CENTRE, 1], "poses": poses}
    (tmp_path / "metadata.json").write_text(json.dumps(data))
    for kind in ("rgb", "depth"):
        (tmp_path / kind).mkdir()
    for index in range(4):
        Image.fromarray(dots([(20, 20)])).save(tmp_path / f"rgb/{index}.jpg")
        _write_plane(tmp_path / f"depth/{index}.exr", 1.0)
    capture, assumed = said(tmp_path)
    assert "points by 4 of 4 depth maps" in assumed
    assert _are_on_planes(capture.points, capture.world_to_camera).all()


def test_nerfcapture(tmp_path):
    """Names without an extension, each frame its own camera, and depth maps beside the photographs."""
    (tmp_path / "images").mkdir()
    frames = []
    for index, matrix in enumerate(to_world(4)):
        Image.fromarray(dots([(20, 20)])).save(tmp_path / f"images/{index}.png")
        _write_plane(tmp_path / f"images/{index}.depth.png", 1e-4)
        camera = {"fl_x": FOCAL[0] + index, "fl_y": FOCAL[1], "cx": CENTRE[0], "cy": CENTRE[1], "w": WIDTH, "h": HEIGHT}
        names = {"file_path": f"images/{index}", "depth_path": f"images/{index}.depth.png", "timestamp": 4.5 + index}
        frames.append({**names, "transform_matrix": matrix.tolist(), **camera})
    top = {"w": WIDTH, "h": HEIGHT, "fl_x": 1, "fl_y": 1, "cx": 320, "cy": 240, "integer_depth_scale": 1e-4}
    (tmp_path / "transforms.json").write_text(json.dumps({**top, "depth_source": "LiDAR", "frames": frames}))
    capture, assumed = said(tmp_path)
    assert capture.names == [str(index) for index in range(4)]
    np.testing.assert_array_equal(capture.intrinsics[:, 0], [70, 71, 72, 73])
    np.testing.assert_allclose(capture.world_to_camera, [pose_matrix(*pose) for pose in ring(4)], atol=1e-12)
    assert "points by 4 of 4 depth maps" in assumed
    first = read_capture(tmp_path).points[: len(capture.points) // 4]
    assert _are_on_planes(first, capture.world_to_camera[:1]).all()
    for index in range(4):  # as the app leaves them out where the phone has no LiDAR
        (tmp_path / f"images/{index}.depth.png").unlink()
    assert not len(said(tmp_path)[0].points)


def test_a_dataparsers_transform_moves_cameras_and_points(tmp_path):
    """To scale * (R p + t): where a scene stands that nerfstudio exports. Cameras for --camera move alike."""
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {key}\n" for key in "xyz")
    write_ring(tmp_path, ply_file_path="sparse_pc.ply")
    (tmp_path / "sparse_pc.ply").write_text(header + "end_header\n0.1 0.2 0.3\n-1 0 2\n")
    before, _ = said(tmp_path)
    turn, shift, scale = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]]), np.array([0.5, -2, 1]), 0.25
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps({"transform": np.column_stack([turn, shift]).tolist(), "scale": scale}))
    after, assumed = said(tmp_path)
    assert "are moved as dataparser_transforms.json says, scaled by 0.25" in assumed

    def moved(points):
        return scale * (points @ turn.T + shift)

    np.testing.assert_allclose(after.points, moved(before.points), atol=1e-7)
    np.testing.assert_allclose(after.centres, moved(before.centres), atol=1e-12)
    point = np.array([0.1, 0.2, 0.3])
    for was, now in zip(before.world_to_camera, after.world_to_camera):  # it is in the same place of a picture
        seen, still = was[:3, :3] @ point + was[:3, 3], now[:3, :3] @ moved(point) + now[:3, 3]
        np.testing.assert_allclose(still / still[2], seen / seen[2], atol=1e-12)
    with pytest.warns(Assumption, match="moved as dataparser_transforms.json says"):
        cameras = read_camera_file(tmp_path / "transforms.json")
    np.testing.assert_allclose([one.world_to_camera for one in cameras], after.world_to_camera, atol=1e-12)
    file.write_text(json.dumps({"transform": [[1, 2], [3, 4]], "scale": scale}))
    with pytest.raises(InputError, match="dataparser_transforms.json: transform: expected 3 rows of 4 numbers"):
        read_capture(tmp_path)
