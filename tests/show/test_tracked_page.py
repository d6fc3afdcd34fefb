"""The page of a scene that follows a viewer's eyes: on a panel with lenses and on a plain screen."""

import io
import json
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from command_line import complaint, scene
from eye_cases import PANEL, face
from PIL import Image
from test_page import get, serving
from test_page_in_browser import REST, browser, pixels

from lightfield_gs import Rig, encode_eyes
from lightfield_gs.app.options import EyesOptions, LookOptions, PanelOptions
from lightfield_gs.app.tracked_eyes import tracked_screen
from lightfield_gs.encoding.eyes import render_head_coupled
from lightfield_gs.panels.comfort import comfortable_amount
from lightfield_gs.panels.stereo_screen import StereoScreen
from lightfield_gs.panels.tracked_eyes import eye_cameras
from lightfield_gs.show.page.exports import exports
from lightfield_gs.show.page.stage import Controls, StagedScene
from lightfield_gs.show.page.steering import steering_routes
from lightfield_gs.show.page.tracked_stage import TrackedStage

SCREEN = StereoScreen(96, 54).panel()


def staged(is_plain: bool) -> TrackedStage:
    panel, gaussians = SCREEN if is_plain else PANEL, scene()
    return TrackedStage(StagedScene(gaussians, Rig.frame(gaussians, panel), "s.ply"), panel, face(), is_plain)


@pytest.mark.parametrize("is_plain", [False, True])
def test_the_panel_shows_the_scene_to_the_eyes_of_now(is_plain):
    stage = staged(is_plain)
    draw = render_head_coupled if is_plain else encode_eyes
    with serving(steering_routes(stage, exports(stage))) as server:
        state = json.loads(get(server, "/panel.json?after=-1")[1])
        assert state["fills"] == is_plain and json.loads(get(server, "/drawing.json")[1]) is None
        pictures = []
        for eyes in (face(), face(150, 40, 700)):
            stage.look(eyes)
            moved = json.loads(get(server, f"/panel.json?after={state['version']}")[1])
            assert moved["version"] > state["version"]
            state = moved
            shown = np.asarray(Image.open(io.BytesIO(get(server, "/panel.png")[1])))
            np.testing.assert_array_equal(shown, draw(stage.gaussians, stage.panel, stage.base, eyes).numpy())
            pictures.append(shown)
        assert np.abs(pictures[0].astype(int) - pictures[1]).max() > 50
        controls = Controls(zoom=1.3)
        stage.settle(controls)
        zoomed = np.asarray(Image.open(io.BytesIO(get(server, "/panel.png")[1])))
        rig = controls.rig(stage.base, stage.panel)
        np.testing.assert_array_equal(zoomed, draw(stage.gaussians, stage.panel, rig, face(150, 40, 700)).numpy())
        crop = np.asarray(Image.open(io.BytesIO(get(server, "/frame?show=native&width=40&height=30&x=1&y=0.5")[1])))
        assert crop.shape == (30, 40, 3)
        assert list(exports(stage)) == ["rig.yaml"] and stage.drawing.seconds > 0


@pytest.mark.not_sanitized
def test_the_page_follows_the_eyes_by_itself(tmp_path):
    """Whoever sits before a laptop sees the scene turn as they move, and may go on steering it."""
    stage = staged(is_plain=True)
    with serving(steering_routes(stage, exports(stage))) as server, browser(tmp_path, 1200, 800) as page:
        page.open(f"{server.url}/")
        page.wait(REST)
        assert page.run("document.querySelector('#look-from').hidden")
        words = "document.querySelector('#said').textContent"
        assert "from between the eyes" in page.run(words)
        seen = []
        for eyes in (face(-200), face(200)):
            stage.look(eyes)
            page.wait("document.querySelector('#said').textContent.includes('coarse')")
            time.sleep(0.5)
            seen.append(pixels(page, "eye"))
        assert np.abs(seen[0].astype(int) - seen[1]).max() > 50


@pytest.mark.parametrize("amount", [None, 0.5])
def test_a_plain_screen_shows_a_scene_as_deep_as_behind_a_window(amount, tmp_path, monkeypatch):
    """The cone of a scene's rig is of displays with views, and no depth strains eyes that both see one picture."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    screen = tracked_screen(EyesOptions("track", screen_size=24.0), None, PanelOptions(viewing_distance=500.0), 0.0)
    panel = screen.drawn_panel
    rig = replace(Rig.frame(scene(), panel), cone_deg=40.0)
    cameras = eye_cameras(panel, screen.deepened(rig, LookOptions(depth_amount=amount)), [(0, 0, 500), (80, 0, 500)])
    point = torch.from_numpy(np.linalg.inv(rig.world_to_camera) @ (0, 0, 2 * rig.zero_depth, 1))  # 500 mm behind
    seen = [
        focal[0] * at[0] / at[2] + centre[0]
        for at, focal, centre in zip(cameras.world_to_camera @ point, cameras.focal_px, cameras.principal_point_px)
    ]
    moved = (amount or 1.0) * 40 * rig.focal_px[0] / 500  # the line of sight meets the window half-way
    assert (seen[1] - seen[0]).item() == pytest.approx(moved)
    assert comfortable_amount(scene(), panel, rig) is None


@pytest.mark.parametrize(
    "words, complained",
    [
        ("--eyes track --stereo sbs", "leave out one"),
        ("--eyes track --view-filter 1", "--view-filter averages"),
        ("--eyes udp:5005 --screen-size 24 --panel toy-8v", "leave out one"),
        ("--tracker-fov 70", "--tracker-fov is for --eyes"),
        ("--eyes udp:5005 --tracker-at 0,0,0 --screen-size 24", "is of a camera that sees the eyes"),
        ("--eyes none.txt", "cannot read none.txt"),
        ("--eyes none.abc --screen-size 24", ", or a .txt of positions"),
        ("--eye-distance 60", "--eye-distance is for --stereo or --eyes"),
    ],
)
def test_options_that_exclude_each_other_are_refused(tmp_path, capsys, words, complained, monkeypatch):
    from lightfield_gs.io.scenes.files import write_scene

    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    write_scene(scene(), tmp_path / "s.ply")
    assert complained in complaint(capsys, f"view {tmp_path}/s.ply --no-open {words}")
