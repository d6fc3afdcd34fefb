"""Framing of scenes that are not all object: floaters, skies, rooms, captures all around; and what a camera sees."""

import math

import numpy as np
import pytest
import torch
from subject_cases import PANEL, UPRIGHT, blobs, directions, floaters, joined, room, thing

from lightfield_gs import Gaussians, InputError, Panel, Rig
from lightfield_gs.panels import framing, visibility
from lightfield_gs.panels.content import content_extent
from lightfield_gs.panels.rig import frame_extent, frame_photo


def place(rig: Rig) -> np.ndarray:
    return -rig.world_to_camera[:3, :3].T @ rig.world_to_camera[:3, 3]


def height_px(rig: Rig, height: float, distance: float) -> float:
    return rig.focal_px[1] * height / distance


@pytest.mark.parametrize("near, far", [(3, 20), (10, 100), (50, 51)])
def test_three_percent_of_floaters_do_not_shrink_the_subject(near, far):
    scene, notes = thing(), []
    alone = Rig.frame(scene, PANEL)
    rig = Rig.frame(joined(scene, floaters(45, near, far)), PANEL, notes=notes)
    assert height_px(rig, 1.2, rig.zero_depth) > 0.9 * height_px(alone, 1.2, alone.zero_depth)
    assert rig.zero_depth == pytest.approx(alone.zero_depth, rel=0.05)
    assert len(notes) == 1 and "2.9% of the scene lies far around" in notes[0]


@pytest.mark.parametrize("share", [0.2, 0.6])
def test_an_object_in_a_sky_is_framed_from_inside_the_sky(share):
    scene, notes = thing(), []
    count = int(len(scene.means) * share / (1 - share))
    rig = Rig.frame(joined(scene, blobs(100 * directions(count, 4), 5.0)), PANEL, notes=notes)
    assert 1 < np.linalg.norm(place(rig)) < 10 and abs(rig.zero_depth + place(rig)[2]) < 0.2
    assert height_px(rig, 1.2, rig.zero_depth) > 0.8 * PANEL.height_px and notes


def turned_room() -> np.ndarray:
    matrix, _ = np.linalg.qr(np.random.default_rng(11).normal(size=(3, 3)))
    return matrix


@pytest.mark.parametrize(
    "walls, centre",
    [
        (room(), (0, 0, 0)),
        (room(), (1.2, 0.6, -0.9)),
        (room(faces=(0, 1, 3, 4, 5)), (0, 0.2, 0)),
        (room(half=(2.5, 2.5, 2.5), turn=turned_room()), (0, 0, 0)),
    ],
    ids=["middle", "aside", "no ceiling", "turned"],
)
def test_an_object_in_a_room_is_framed_from_inside_the_room(walls, centre):
    notes = []
    rig = Rig.frame(joined(walls, thing(centre, 500)), PANEL, notes=notes)
    from_object = place(rig) - centre
    assert 0.4 < -from_object[2] < 3 and rig.zero_depth == pytest.approx(-from_object[2], abs=0.3)
    assert place(rig)[2] > -3 and np.abs(from_object[:2]).max() < 0.3
    assert len(notes) == 1 and "closed on most sides" in notes[0]


def test_what_is_closed_and_empty_is_said_to_be():
    """A room, or a box: nobody knows."""
    for scene in (room(), blobs(directions(4000, 5), 0.05)):
        notes = []
        Rig.frame(scene, PANEL, notes=notes)
        assert len(notes) == 1 and "shell" in notes[0] and "outside" in notes[0]


def test_a_small_dense_part_of_a_wide_capture_is_framed_from_within():
    random = np.random.default_rng(6)
    distance = 0.7 * np.exp(random.uniform(0, 4.5, (9000, 1)))
    around = distance * directions(9000, 7)
    around = blobs(around[around[:, 1] < 0.5])
    around.scales *= around.means.norm(dim=1, keepdim=True)
    notes = []
    rig = Rig.frame(joined(thing(count=3000), around), PANEL, notes=notes)
    assert np.linalg.norm(place(rig)) < 10 and "surrounds its densest part" in notes[0]


def pole() -> Gaussians:
    random = np.random.default_rng(8)
    return blobs(random.uniform(-1, 1, (60, 3)) * [0.02, 2, 0.02] + [0, 2.5, 0])


@pytest.mark.parametrize(
    "scene",
    [
        joined(thing(), pole()),
        joined(thing((-4, 0, 0)), thing((4, 0, 1))),
        joined(blobs(0.4 * directions(2000, 9) - [0, 1, 0]), blobs(directions(4000, 10) * [0.5, 0.7, 0.4])),
        blobs(np.random.default_rng(12).uniform(-1, 1, (3000, 3)), 0.05),
        blobs(np.random.default_rng(13).normal(size=(3000, 3)), 0.05),
    ],
    ids=["pole", "two", "statue", "box", "cloud"],
)
def test_objects_are_framed_whole_without_a_word(scene):
    notes = []
    rig = Rig.frame(scene, PANEL, notes=notes)
    assert notes == []
    matrix = torch.from_numpy(rig.world_to_camera).float()
    seen = scene.means @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = torch.tensor(rig.focal_px) * seen[:, :2] / seen[:, 2:] + torch.tensor(rig.principal_point_px)
    inside = ((pixels >= 0) & (pixels <= torch.tensor([PANEL.width_px, PANEL.height_px]))).all(1)
    assert inside.float().mean() > 0.97


@pytest.mark.parametrize("panel", [PANEL, Panel(**{**PANEL.to_dict(), "width_px": 60})])
@pytest.mark.parametrize("place", [(0, 0, 0), (0.5, 0.2, -0.5), (0, 0, -1.05)])
def test_a_camera_inside_a_scene_takes_ninety_degrees_at_most(panel, place):
    cloud = blobs(np.random.default_rng(14).uniform(-1, 1, (3000, 3)))
    pose = np.eye(4)
    pose[:3, 3] = -np.array(place)
    rig = Rig.frame(cloud, panel, pose)
    for focal, centre, size in zip(rig.focal_px, rig.principal_point_px, (panel.width_px, panel.height_px)):
        assert math.degrees(math.atan(centre / focal) + math.atan((size - centre) / focal)) <= 90.001
    assert np.array_equal(rig.world_to_camera, pose)


def test_with_a_pose_the_zero_plane_lies_in_the_subject():
    """Not in the empty middle between it and what is far behind."""
    random = np.random.default_rng(15)
    wall = blobs(random.uniform(-1, 1, (3000, 3)) * [30, 20, 0] + [0, 0, 60], 0.6)
    scene = joined(thing((0, 0, 3)), wall)
    assert Rig.frame(scene, PANEL, UPRIGHT).zero_depth == pytest.approx(3, abs=0.3)
    camera = Rig(UPRIGHT, (80.0, 80.0), (80.0, 40.0), 1.0)
    given = framing.focus_on_scene(camera, scene, PANEL)
    assert given.zero_depth == pytest.approx(3, abs=0.3) and given.focal_px == (80, 80)
    with pytest.raises(InputError, match="in front"):
        framing.focus_on_scene(camera, thing((0, 0, -3)), PANEL)


def test_what_hides_the_content_counts():
    content, rig = thing((0, 0, 3)), Rig(UPRIGHT, (150, 150), (80, 40), 3)
    nothing, curtain = (
        blobs([[0, 0, -5]]),
        blobs(np.random.default_rng(16).uniform(-1, 1, (4000, 3)) * [1, 1, 0] + [0, 0, 1.5], 0.05),
    )
    assert visibility.visible_fraction(content, nothing, PANEL, rig) > 0.95
    assert visibility.visible_fraction(content, curtain, PANEL, rig) < 0.05


def test_a_photo_keeps_its_whole_view_however_wide():
    wide = blobs(np.stack([np.linspace(-3, 3, 400), np.zeros(400), np.ones(400)], 1))
    rig = frame_photo(wide, PANEL)
    assert rig.focal_px[0] < 30 and Rig.frame(wide, PANEL, UPRIGHT).focal_px[0] == pytest.approx(80)


@pytest.mark.parametrize("width", [640, 648, 1021])
def test_some_of_a_photos_many_gaussians_show_how_far_all_reach(width):
    """Cameras of a grid that lie on a slanted ellipse."""
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, 640), torch.linspace(-1, 1, width), indexing="ij")
    x, y = 0.4 * columns.flatten(), 0.3 * rows.flatten()
    z = 1.3 + 0.2 * x
    count = len(x)
    opacities = (0.8 * (torch.hypot(x / 0.31, (y - 0.2 * x) / 0.22) < 1)).float()
    scales = torch.full((count, 3), 1e-3)
    means, turns = torch.stack([x * z, y * z, z], 1), torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    gaussians = Gaussians(means, turns, scales, opacities, torch.zeros(count, 1, 3))
    rig, whole = (frame_photo(gaussians, PANEL), frame_extent(content_extent(gaussians).tolist(), PANEL))
    assert rig.focal_px == pytest.approx(whole.focal_px, rel=4e-3) and rig.focal_px != whole.focal_px
    assert rig.principal_point_px == pytest.approx(whole.principal_point_px, abs=4e-3 * PANEL.height_px)
    assert rig.zero_depth == pytest.approx(whole.zero_depth, rel=1e-3)


def test_a_photos_content_is_inside_all_views():
    """A ring that is as wide as the panel and deep: its ends move most in the outermost views."""
    turn = np.linspace(0, 2 * np.pi, 600)
    ring = np.stack([0.9 * np.cos(turn), 0.05 * np.sin(3 * turn), 1.5 + 0.4 * np.cos(turn)], 1)
    gaussians = blobs(ring, 0.01)
    rig = frame_photo(gaussians, PANEL)
    for x in (0, PANEL.views / 2, PANEL.views):
        camera = rig.cameras_at(PANEL, [x])
        seen = ring @ camera.world_to_camera[0, :3, :3].numpy().T + camera.world_to_camera[0, :3, 3].numpy()
        columns = float(camera.focal_px[0, 0]) * seen[:, 0] / seen[:, 2] + float(camera.principal_point_px[0, 0])
        assert columns.min() > 0 and columns.max() < PANEL.width_px
