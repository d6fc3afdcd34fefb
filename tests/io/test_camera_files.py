"""Files of cameras as trainers write them, and viewmats with K."""

import json
import math

import numpy as np
import pytest
import torch
from panel_cases import plain_panel
from rasterizer_cases import random_scene, turned_pose

from lightfield_gs import Cameras, InputError, render
from lightfield_gs.encoding.view_files import read_cameras
from lightfield_gs.io.captures.camera_files import read_camera_file
from lightfield_gs.io.images import write_image

POSES = [turned_pose(0.3, -0.2), turned_pose(-0.1, 0.4)]
PANEL = plain_panel(200, 100, 4, cone_deg=30)


def inria(**changes) -> list[dict]:
    """The poses as Inria's program writes them."""
    entries = []
    for index, pose in enumerate(POSES):
        to_world = np.linalg.inv(pose)
        entries.append(
            {
                "id": index,
                "img_name": f"0000{index}",
                "width": 40,
                "height": 30,
                "position": to_world[:3, 3].tolist(),
                "rotation": to_world[:3, :3].tolist(),
                "fx": 44.0,
                "fy": 45.0,
                **changes,
            }
        )
    return entries


def transforms(**changes) -> dict:
    """The poses as NeRF's Blender script writes them, and Instant NGP's."""
    frames = [
        {"file_path": f"./{index}", "transform_matrix": (np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])).tolist()}
        for index, pose in enumerate(POSES)
    ]
    return {"w": 40, "h": 30, "fl_x": 44.0, "fl_y": 45.0, "frames": frames, **changes}


def written(folder, data, name="c.json"):
    (folder / name).write_text(json.dumps(data))
    return folder / name


def expected() -> Cameras:
    count = len(POSES)
    return Cameras(
        torch.tensor(np.stack(POSES)),
        torch.tensor([[44.0, 45.0]] * count, dtype=torch.float64),
        torch.tensor([[20.0, 15.0]] * count, dtype=torch.float64),
        40,
        30,
    )


def test_every_kind_gives_the_same_pictures(tmp_path):
    scene, want = random_scene(30, 1, seed=4), expected()
    k = torch.tensor([[44.0, 0, 20], [0, 45, 15], [0, 0, 1]], dtype=torch.float64).expand(2, 3, 3)
    for cameras in (
        Cameras.from_inria(written(tmp_path, inria())),
        Cameras.from_transforms(written(tmp_path, transforms())),
        Cameras(want.world_to_camera, k, width_px=40, height_px=30),
    ):
        assert (cameras.width_px, cameras.height_px) == (40, 30)
        torch.testing.assert_close(render(scene, cameras).image, render(scene, want).image, atol=1e-9, rtol=0)
    assert Cameras.from_inria(written(tmp_path, inria()), 1).count == 1


def test_numbers_of_a_frame_go_before_those_of_all(tmp_path):
    data = transforms(cx=21.0, camera_angle_y=1.0)
    del data["fl_x"], data["fl_y"]
    data["frames"][1] |= {"fl_x": 50.0, "cy": 14.0}
    cameras = Cameras.from_transforms(written(tmp_path, data))
    fy = 15 / math.tan(0.5)
    assert cameras.focal_px.numpy() == pytest.approx(np.array([[fy, fy], [50, fy]]))
    assert cameras.principal_point_px.tolist() == [[21, 15], [21, 14]]


def test_a_size_that_the_file_leaves_out_is_that_of_the_image(tmp_path):
    data = transforms(camera_angle_x=0.9)
    for key in ("w", "h", "fl_x", "fl_y"):
        del data[key]
    assert read_camera_file(written(tmp_path, data))[0].assumed.startswith("its image is taken as square")
    with pytest.raises(InputError, match="c.json: expected w and h"):
        Cameras.from_transforms(tmp_path / "c.json")
    write_image(tmp_path / "0.png", np.zeros((30, 40, 3), np.uint8))
    cameras = Cameras.from_transforms(tmp_path / "c.json")
    assert (cameras.width_px, cameras.height_px) == (40, 30)
    assert float(cameras.focal_px[0, 0]) == pytest.approx(20 / math.tan(0.45))


def test_the_image_fits_the_panel_and_the_principal_point_stays(tmp_path):
    camera = read_camera_file(written(tmp_path, inria(cx=21.0)))[0]
    focal, centre = camera.fitted(PANEL.width_px, PANEL.height_px)
    scale = 100 / 30
    assert focal == pytest.approx((44 * scale, 45 * scale)) and centre == pytest.approx((100 + scale, 50))


@pytest.mark.parametrize(
    "data, words",
    [
        (inria(fx=None), r"\[0\].fx"),
        (inria(position=[0, 1]), r"\[0\].position"),
        (inria(width=0), r"\[0\].width"),
        (inria(rotation=np.diag([1, 1, -1]).tolist()), r"\[0\].rotation.*mirroring"),
        (inria(fy="44"), r"\[0\].fy"),
        (inria(position=[0, 1, math.inf]), "position.*finite"),
        ([], "no cameras"),
        ([3], r"\[0\]: expected an object"),
        (transforms(frames=3), "frames"),
        (transforms(frames=[]), "no cameras"),
        (transforms(fl_x=-1), "fl_x"),
        (transforms(frames=[{"transform_matrix": [[1, 2], [3]]}]), r"frames\[0\].transform_matrix"),
        (transforms(frames=[{}]), r"frames\[0\].transform_matrix"),
        (transforms(camera_model="OPENCV_FISHEYE"), "pinhole"),
        (transforms(w=None), r"frames\[0\].w"),
        ({"cameras": 3}, "frames"),
        (3, "frames"),
        ({"world_to_camera": 3}, "cameras="),
    ],
)
def test_what_is_wrong_is_named(tmp_path, data, words):
    with pytest.raises(InputError, match="c.json.*" + words):
        read_camera_file(written(tmp_path, data))


def test_files_of_the_other_option_are_told_apart(tmp_path):
    for data in (inria(), transforms()):
        with pytest.raises(InputError, match=r"c.json.*camera=FILE"):
            read_cameras(written(tmp_path, data), PANEL)
    for call, data, words in (
        (Cameras.from_inria, transforms(), "list"),
        (Cameras.from_transforms, inria(), "frames"),
        (Cameras.from_transforms, transforms(k1=0.1), "distortion"),
        (Cameras.from_inria, [*inria()[:1], *inria(width=41)[1:]], "2 sizes"),
    ):
        with pytest.raises(InputError, match="c.json.*" + words):
            call(written(tmp_path, data))
    with pytest.raises(InputError, match="index must be 0..1"):
        Cameras.from_inria(written(tmp_path, inria()), 2)


@pytest.mark.parametrize("row, column", [(0, 1), (1, 0), (2, 0), (2, 2)])
def test_skew_is_refused(row, column):
    k = torch.eye(3)[None].clone()
    k[0, row, column] += 0.5
    with pytest.raises(InputError, match=f"row {row}, column {column}"):
        Cameras(torch.eye(4)[None], k, width_px=4, height_px=4)
    with pytest.raises(InputError, match="or K"):
        Cameras(torch.eye(4)[None], torch.ones(1, 2), width_px=4, height_px=4)
