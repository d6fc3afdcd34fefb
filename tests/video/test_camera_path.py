"""Camera paths: through the keyframes, smooth, round the subject; and files of them."""

import json

import numpy as np
import pytest
import yaml
from command_line import PANEL

from lightfield_gs import InputError, Rig
from lightfield_gs.video.camera_path import CameraPath, orbit

RIG = Rig(np.eye(4), (100.0, 110.0), (48.0, 30.0), 2.0)

STEP_S = 1e-5


def rigs(*degrees: float) -> list[Rig]:
    return [orbit(RIG, PANEL, angle) for angle in degrees]


def place(rig: Rig) -> np.ndarray:
    return -rig.world_to_camera[:3, :3].T @ rig.world_to_camera[:3, 3]


def test_keyframes_are_met_to_the_bit():
    keys = rigs(0, 20, 70)
    path = CameraPath([1, 2, 4], keys, PANEL)
    assert path.seconds == 3
    assert [path.at(time).to_dict() for time in (0, 1, 3)] == [key.to_dict() for key in keys]
    assert path.at(-1).to_dict() == keys[0].to_dict() and path.at(9).to_dict() == keys[2].to_dict()


def test_a_path_through_a_turntable_goes_round_the_subject():
    """No corner is cut: all the way the camera is as far from the middle of the panel, at the angle of the time."""
    path = CameraPath([0, 1, 2, 3], rigs(0, 30, 60, 90), PANEL)
    for time in np.linspace(0, 3, 13):
        expected = place(orbit(RIG, PANEL, 30 * time))
        np.testing.assert_allclose(place(path.at(time)), expected, atol=0.01)
        assert np.linalg.norm(place(path.at(time)) - (0, 0, 2)) == pytest.approx(2, abs=1e-9)


def test_speeds_do_not_jump():
    keys = rigs(0, 50, 60, 0)
    keys[1].zero_depth, keys[2].focal_px = 3.0, (200.0, 220.0)
    for times in ([0, 1, 1.5, 4], [0, 2, 3, 4]):
        path = CameraPath(times, keys, PANEL)
        assert path.is_loop

        def speed(time: float, path: CameraPath = path) -> np.ndarray:
            one, other = path.at(time), path.at(time + STEP_S)
            values = [[*place(rig), *rig.world_to_camera[:3, :3].ravel(), rig.zero_depth] for rig in (one, other)]
            return np.diff(values, axis=0)[0] / STEP_S

        for time in path.times_s[1:-1]:
            np.testing.assert_allclose(speed(time - 2 * STEP_S), speed(time + STEP_S), atol=5e-3)
        np.testing.assert_allclose(speed(0), speed(4 - STEP_S), atol=5e-3)


def test_a_full_turn_is_a_loop_without_a_frame_twice():
    path = CameraPath([0, 1, 2, 3, 4], rigs(0, 90, 180, 270, 360), PANEL)
    frames = path.frames(10)
    assert path.is_loop and len(frames) == 40 and len(path.frames(10, 8)) == 8
    angles = np.unwrap([np.arctan2(place(rig)[0], 2 - place(rig)[2]) for rig in frames])
    assert np.diff(angles).min() > 0 and angles[-1] == pytest.approx(2 * np.pi * 39 / 40, abs=0.02)
    assert len(CameraPath([0, 1], rigs(0, 10), PANEL).frames(10)) == 11


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_files(tmp_path, suffix):
    keys = rigs(0, 40)
    keys[0].to_yaml(tmp_path / "first.yaml")
    data = {"keyframes": [{"time": 0, "rig": "first.yaml"}, {"time": 2.5, "rig": keys[1].to_dict()}]}
    file = tmp_path / f"path.{suffix}"
    file.write_text(json.dumps(data) if suffix == "json" else yaml.safe_dump(data))
    path = CameraPath.load(file, PANEL)
    assert path.seconds == 2.5 and [rig.to_dict() for rig in path.rigs] == [key.to_dict() for key in keys]


@pytest.mark.parametrize(
    "data, words",
    [
        ({}, "missing keyframes"),
        ({"keyframes": 3}, "expected a list"),
        ({"keyframes": []}, "two keyframes or more"),
        ({"keyframes": [1, 2]}, "keyframe 0: expected time and rig"),
        ({"keyframes": [{"time": 0}]}, "keyframe 0: missing rig"),
        ({"keyframes": [{"time": 0, "rig": "no.yaml"}]}, "cannot read"),
        ({"keyframes": [{"time": 0, "rig": {"focal": 1}}]}, "unknown key 'focal'"),
        ({"keyframes": [{"time": t, "rig": RIG.to_dict()} for t in (0, 0)]}, "must increase"),
        ({"keyframes": [{"time": t, "rig": RIG.to_dict()} for t in ("a", 0)]}, "time must be a number"),
        ({"keyframes": [{"time": n, "rig": rig.to_dict()} for n, rig in enumerate(rigs(0, 170))]}, "170 degrees"),
    ],
)
def test_files_that_are_none(tmp_path, data, words):
    file = tmp_path / "path.json"
    file.write_text(json.dumps(data))
    with pytest.raises(InputError, match=words):
        CameraPath.load(file, PANEL)
