"""A live picture that its owner steers, and one for eyes that are tracked."""

import io
import json
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from command_line import complaint, scene
from eye_cases import PANEL as LENSES
from eye_cases import face
from PIL import Image
from test_page import get, serving
from test_page_in_browser import REST, browser, pixels

from lightfield_gs import Panel, Rig, encode, encode_eyes
from lightfield_gs.cli import main
from lightfield_gs.encoding.eyes import EyesDrawing
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.page import PageOut
from lightfield_gs.live.sources import Frame
from lightfield_gs.live.steering import LiveStage, SteeredRenderer
from lightfield_gs.show.page.stage import Controls, StagedScene
from lightfield_gs.video.decoding import decode
from lightfield_gs.video.rendering import EyesRenderer, FrameOptions, NativeRenderer

pytest.importorskip("av", reason="live sources need the extra `video`")
PANEL = Panel.load("toy-8v")


class Live:
    """A live picture by hand: each call draws a scene, and puts it on the page."""

    def __init__(self, panel: Panel, renderer=None):
        gaussians = scene()
        self.rig, self.page = Rig.frame(gaussians, panel), PageOut(panel, Health())
        staged = StagedScene(gaussians, self.rig, "camera", (0.2, 0.3, 0.4))
        options = FrameOptions(background=staged.background)
        self.stage = LiveStage(staged, panel, lambda: self.page.newest()[1])
        native = lambda options: NativeRenderer(panel, options, False)
        self._draw = SteeredRenderer(self.stage, options, renderer or native)
        self._count = 0

    def __call__(self, gaussians) -> np.ndarray:
        self._count += 1
        drawn = Drawn(self._draw(gaussians, self.rig, self._count))
        self.page.put(Frame(self._count, time.monotonic(), lambda scaling: None), drawn)
        return drawn.pixels

    @property
    def routes(self):
        return {**self.stage.routes(), **self.page.routes()}


def picture(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def test_controls_of_the_page_act_on_the_pictures_that_follow():
    live, other = Live(PANEL), scene(seed=5)
    with serving(live.routes) as server:
        facts = json.loads(get(server, "/scene.json")[1])
        assert facts["qualities"] == [] and facts["follow_ms"] > 0 and facts["exports"] == []
        before = live(other)
        np.testing.assert_array_equal(before, encode(other, PANEL, live.rig, background=(0.2, 0.3, 0.4)).numpy())
        words = "zoom=1.4&depth_amount=0.5&focus=3&background=%23ff8000"
        assert get(server, "/rest", "POST", words, X_Token=facts["token"])[0] == 204
        after = live(other)
        rig = Controls(zoom=1.4, depth_amount=0.5, focus=3).rig(live.rig, PANEL)
        np.testing.assert_array_equal(after, encode(other, PANEL, rig, background=(1, 128 / 255, 0)).numpy())
        np.testing.assert_array_equal(picture(get(server, "/panel.png")[1]), after)
        crop = picture(get(server, "/frame?show=native&width=480&height=240&x=0.5&y=0.5&still=1")[1])
        np.testing.assert_array_equal(crop, after)


@pytest.mark.not_sanitized
def test_the_page_of_a_live_picture_is_that_of_view(tmp_path):
    live = Live(PANEL)
    live(scene())
    with serving(live.routes) as server, browser(tmp_path, 1200, 800) as page:
        page.open(f"{server.url}/")
        page.wait(REST)
        assert page.run("document.querySelector('#saving').hidden")
        first = pixels(page, "eye").astype(int)
        typed = "document.querySelector('#zoom-typed')"
        page.run(f"{typed}.value = 200; {typed}.dispatchEvent(new Event('change'))")
        page.wait(REST)
        assert live.stage.resting().zoom == 2
        live(scene(seed=9))
        time.sleep(2)  # the page follows by itself
        now = pixels(page, "eye").astype(int)
        assert now.shape != first.shape or np.abs(now - first).max() > 50


def test_a_live_picture_for_tracked_eyes_is_drawn_for_where_they_will_be():
    asked = []
    at = lambda ahead: asked.append(ahead) or face(90, 20, 700)
    size = LENSES.width_px, LENSES.height_px
    live = Live(LENSES, partial(EyesRenderer, EyesDrawing(LENSES, False), size, eyes_mm=at))
    live(scene(seed=2))
    drawn = live(scene(seed=3))
    expected = encode_eyes(scene(seed=3), LENSES, live.rig, face(90, 20, 700), background=(0.2, 0.3, 0.4))
    np.testing.assert_array_equal(drawn, expected.numpy())
    assert asked[0] == 0 and asked[1] > 0


def test_live_follows_eyes_of_a_file(tmp_path, capsys):
    """From end to end: the recordings have pictures of the eyes in the files, each from another side."""
    colours = np.random.default_rng(0).integers(0, 256, (10, 15, 3), np.uint8)
    depths = np.broadcast_to(np.linspace(0, 255, 15).astype(np.uint8)[:, None], colours.shape)
    shot = np.concatenate([colours, depths], 1).repeat(8, 0).repeat(8, 1)
    Image.fromarray(shot).save(tmp_path / "shot.png")
    replace(LENSES, width_px=120, height_px=80).to_yaml(tmp_path / "p.yaml")
    (tmp_path / "shots").mkdir()
    (tmp_path / "shot.png").rename(tmp_path / "shots" / "shot.png")
    recorded = []
    for name, x in (("left", -150), ("again", -150), ("right", 150)):
        np.savetxt(tmp_path / f"{name}.txt", [[0, *face(x).ravel()]])
        words = f"live {tmp_path}/shots --rgbd right --no-open --seconds 1 -o {tmp_path}/{name}.mkv"
        assert main(f"{words} --panel {tmp_path}/p.yaml --eyes {tmp_path}/{name}.txt".split()) == 0
        said = capsys.readouterr().out
        assert "0.0 % of the other eye's picture" in said and "on panel p" in said
        recorded.append(next(iter(decode(tmp_path / f"{name}.mkv"))).astype(int))
    left, again, right = recorded
    assert left.shape == (80, 120, 3) and np.abs(left - right).mean() > 5 * np.abs(left - again).mean()


@pytest.mark.parametrize(
    "words, complained",
    [
        ("--eyes udp:5005 --quality fast --screen-size 24", "leave them out"),
        ("--eyes udp:5005 --virtual-camera /dev/video9", "leave out --eyes"),
        ("--eyes udp:5005 --stereo sbs", "leave out one"),
        ("--eyes udp:5005 --window --screen-size 24", "--window is of a display with lenses"),
        ("--eye-distance 60", "--eye-distance is for --stereo or --eyes"),
    ],
)
def test_options_that_exclude_each_other_are_refused(tmp_path, capsys, words, complained):
    assert complained in complaint(capsys, f"live {tmp_path} --depth flat --no-open {words}")
