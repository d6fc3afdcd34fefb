"""Rendered captures: cameras where they should be, points on what the photographs show, and known faults."""

from pathlib import Path

import numpy as np
import pytest
from mesh_packs import cube, write_packs

from benchmarks import make_captures
from benchmarks.capture_stages import Room, _superellipsoid
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.capture import read_capture

WORDS = ("--captures", "1", "--photographs", "8", "--width", "96")


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    assert make_captures.main([str(folder), *WORDS]) == 0
    return folder


def azimuths_deg(capture, room):
    """Of the cameras about the upright axis through the middle, and their elevations."""
    middle = np.linalg.inv(room.centre) @ (0, 0, room.distance, 1)
    away = capture.centres - middle[:3]
    elevations = np.degrees(np.arcsin(away[:, 1] / np.linalg.norm(away, axis=1)))
    return np.degrees(np.arctan2(away[:, 0], away[:, 2])), elevations


def colour_errors(capture, poses):
    """Of each point: the least distance of its colour from that of a photograph where its camera sees it."""
    errors = np.full(len(capture.points), np.inf)
    for index, pose in enumerate(poses):
        x, y, z = (capture.points @ pose[:3, :3].T + pose[:3, 3]).T
        fx, fy, cx, cy = capture.intrinsics[index]
        column, row = np.floor(fx * x / z + cx).astype(int), np.floor(fy * y / z + cy).astype(int)
        width, height = capture.sizes_px[index]
        seen = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        photo = capture.image(index)[row[seen], column[seen]].astype(float)
        errors[seen] = np.minimum(errors[seen], np.abs(photo - capture.colours[seen]).mean(1))
    return errors


def test_cameras_stand_on_the_arc_of_a_panel_and_all_round(captures):
    arc, whole = (read_capture(captures / f"solids-{way}-1") for way in ("arc", "round"))
    azimuths, elevations = azimuths_deg(arc, Room(1))
    np.testing.assert_allclose(azimuths, np.linspace(-20, 20, 8), atol=6)
    np.testing.assert_allclose(elevations, 15, atol=6)
    azimuths, elevations = azimuths_deg(whole, Room(1))
    np.testing.assert_allclose(np.exp(1j * np.radians(azimuths - 45 * np.arange(8))), 1, atol=np.radians(7))
    np.testing.assert_allclose(elevations, np.resize([15, 37], 8), atol=6)
    assert arc.sizes_px.tolist() == [[96, 72]] * 8


@pytest.mark.parametrize("way", ["arc", "round"])
def test_points_lie_where_the_photographs_show_their_colours(captures, way):
    capture = read_capture(captures / f"solids-{way}-1")
    found = np.median(colour_errors(capture, capture.world_to_camera))
    inverse = np.linalg.inv(capture.world_to_camera)
    assert found < 6 and found < np.median(colour_errors(capture, inverse)) / 3


def test_exposures_and_noise_differ_between_photographs_of_one_place():
    image, rng = np.full((40, 40, 3), 0.5), np.random.default_rng(0)
    photos = np.array([make_captures._photographed(image, rng) for _ in range(200)]) / 255
    gains = np.log((photos.mean((1, 2)) / 0.5) ** 2.2)
    assert gains.mean(1).std() == pytest.approx(0.08, rel=0.2) and abs(gains.mean()) < 0.02
    deviation = np.hypot(1.5 / 255, 0.02 * np.sqrt(0.5))
    assert photos.std((1, 2)).mean() == pytest.approx(deviation, rel=0.1)


def test_superellipsoids_of_exponent_one_are_ellipsoids():
    u, v = np.random.default_rng(0).random((2, 50))
    half = np.array([0.2, 0.3, 0.5])
    points, normals = _superellipsoid(u, v, half, np.ones(2))
    np.testing.assert_allclose(((points / half) ** 2).sum(1), 1)
    gradient = points / half**2
    np.testing.assert_allclose(normals, gradient / np.linalg.norm(gradient, axis=1, keepdims=True))


def test_meshes_stand_in_the_room_in_their_own_colours(tmp_path):
    write_packs(tmp_path, {"train": [cube()] * 9})
    room = Room(1, tmp_path)
    image, depth = room.photograph(room.centre, 60.0, (64, 48))
    assert 0.5 < depth[24, 32] < room.distance < depth[4, 2] < 6
    red, green, blue = image[24, 32]
    assert red / green == pytest.approx(200 / 60, rel=0.02) and green / blue == pytest.approx(60 / 40, rel=0.02)
    write_packs(tmp_path / "few", {"train": [cube()]})
    with pytest.raises(InputError, match="expected 9 objects"):
        Room(1, tmp_path / "few")


def test_a_scene_of_gaussians_is_photographed_from_its_front(tmp_path, capsys):
    scene = str(Path(__file__).resolve().parents[2] / "lightfield_gs/data/banana/fitted.spz")
    assert make_captures.main([str(tmp_path), "--scene", scene, *WORDS]) == 0
    capture = read_capture(tmp_path / "fitted-arc-1")
    assert np.median(colour_errors(capture, capture.world_to_camera)) < 12
    assert make_captures.main([str(tmp_path), "--scene", scene, *WORDS]) == 2
    assert "exists" in capsys.readouterr().err
