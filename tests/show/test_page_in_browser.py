"""The pages in a headless Chromium: what is seen, what moves, and that wrong pixels are told."""

import io
import json
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager
from dataclasses import asdict, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from chromium import SWIFTSHADER_CANVAS, Browser, find
from command_line import PANEL, heed_ctrl_c, scene
from test_page import serving

from lightfield_gs import encode
from lightfield_gs.io.images import write_image
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.exports import exports
from lightfield_gs.show.page.routes import shown_routes
from lightfield_gs.show.page.stage import Controls, Stage, StagedScene
from lightfield_gs.show.page.steering import steering_routes
from lightfield_gs.show.preview import write_preview

pytestmark = pytest.mark.not_sanitized  # a sanitizer that is loaded before a browser stops it
REST = "document.querySelector('#panes')?.getAttribute('aria-busy') === 'false'"
PIXELS = """(pane) => {
  const canvas = document.querySelector(`[data-pane=${pane}] canvas`);
  const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  return {width: canvas.width, data: Array.from(data)};
}"""


@contextmanager
def browser(tmp_path, width=1000, height=700, scale=1.0, **more):
    find()
    opened = Browser(tmp_path, width, height, scale, **more)
    try:
        yield opened
    finally:
        opened.close()


def pixels(page: Browser, pane: str) -> np.ndarray:
    got = page.run(f"({PIXELS})('{pane}')")
    return np.array(got["data"], np.uint8).reshape(-1, got["width"], 4)[..., :3]


@pytest.fixture
def stage() -> Stage:
    gaussians = scene()
    return Stage(StagedScene(gaussians, Rig.frame(gaussians, PANEL), "s.ply"), PANEL)


def test_sliders_and_mouse_steer_what_is_seen(tmp_path, stage):
    with serving(steering_routes(stage, exports(stage))) as server, browser(tmp_path) as page:
        page.open(server.url)
        page.wait(REST)
        np.testing.assert_array_equal(pixels(page, "eye"), stage.eye(Controls(), 64, still=True).pixels)

        page.run("(s => {s.value = 40; s.dispatchEvent(new Event('input'))})(document.querySelector('#depth_amount'))")
        page.wait(REST)
        less = stage.eye(Controls(depth_amount=0.4), 64, still=True).pixels
        np.testing.assert_array_equal(pixels(page, "eye"), less)

        box = page.run("document.querySelector('[data-pane=eye] canvas').getBoundingClientRect().toJSON()")
        page.mouse("mouseMoved", box["x"] + 0.8 * box["width"], box["y"] + box["height"] / 2)
        page.wait(REST)
        assert float(page.run("document.querySelector('#eye').value")) == pytest.approx(0.3, abs=0.01)
        assert np.abs(pixels(page, "eye").astype(int) - less).max() > 20

        page.mouse("mousePressed", 400, 300, button="left", buttons=1, clickCount=1)
        page.mouse("mouseMoved", 460, 300, button="left", buttons=1)
        page.mouse("mouseReleased", 460, 300, button="left")
        page.wait(REST)
        assert page.run("document.querySelector('#yaw_deg-typed').value") == "-18"

        page.run("document.querySelector('#reset').click()")
        page.run("document.querySelector('[data-mode=split]').click()")
        page.wait(REST)
        np.testing.assert_array_equal(pixels(page, "native"), encode(stage.gaussians, PANEL, stage.base).numpy())
        assert pixels(page, "sheet").any()
        assert page.run("document.querySelector('#trouble').hidden")


DRAWN = """(async (controls, pane, ...how) => {
  const drawing = await (await import("/drawing.js")).openDrawing(), {bitmap} = await drawing[pane](controls, ...how);
  const canvas = Object.assign(document.createElement("canvas"), {width: bitmap.width, height: bitmap.height});
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  const {data} = canvas.getContext("2d").getImageData(0, 0, bitmap.width, bitmap.height);
  return [bitmap.width, Array.from(data)];
})"""


def drawn(page: Browser, controls: Controls, *how) -> np.ndarray:
    """What the browser draws for a pane."""
    width, data = page.run(f"{DRAWN}({', '.join(map(json.dumps, (asdict(controls), *how)))})")
    return np.array(data, np.uint8).reshape(-1, width, 4)[..., :3].astype(int)


@pytest.mark.slow
def test_a_browser_with_webgpu_draws_the_bytes_of_the_server(tmp_path, stage):
    """What an eye sees while it moves and at rest, the sheet of views, native pixels, and the panel's page."""
    controls = Controls(yaw_deg=7.0, zoom=1.2, focus=stage.base.zero_depth * 1.1, depth_amount=0.7, eye=0.3)
    controls = replace(controls, background="#3060a0")
    with serving(steering_routes(stage, exports(stage))) as server, browser(tmp_path, gpu=SWIFTSHADER_CANVAS) as page:
        page.open(server.url + "/#software")
        page.wait("document.body?.dataset.draws", 60)
        if not page.run("(async () => Boolean(navigator.gpu && await navigator.gpu.requestAdapter()))()"):
            pytest.skip("this Chromium has no adapter for WebGPU")
        assert page.run("document.body.dataset.draws") == "here"
        page.run("document.querySelector('#advanced').open = true")
        page.run("document.querySelector('[data-mode=native]').click()")
        page.wait(f"{REST} && document.querySelector('#times').innerText.includes('in the browser')", 90)
        expected = encode(stage.gaussians, PANEL, stage.base).numpy()
        assert np.abs(pixels(page, "native").astype(int) - expected).max() <= 1

        assert np.abs(drawn(page, controls, "eye", 64, False) - stage.eye(controls, 64, still=False).pixels).max() <= 1
        through_lenses = stage.eye(controls, 64, still=True)
        assert through_lenses.description.startswith("through the lenses")
        assert np.abs(drawn(page, controls, "eye", 64, True) - through_lenses.pixels).max() <= 1
        for still in (False, True):
            assert np.abs(drawn(page, controls, "sheet", still) - stage.sheet(controls, still).pixels).max() <= 1

        stage.settle(controls)
        page.resize(PANEL.width_px, PANEL.height_px)
        page.open(server.url + "/panel#software")
        page.wait("document.body?.dataset.draws === 'here' && document.body.dataset.exact === 'true'", 60)
        blue = (0x30 / 255, 0x60 / 255, 0xA0 / 255)
        expected = encode(stage.gaussians, PANEL, controls.rig(stage.base, PANEL), background=blue).numpy()
        assert np.abs(page.screenshot().astype(int) - expected).max() <= 1


class Elsewhere(BaseHTTPRequestHandler):
    """A page of another origin that shows the picture and the page of the address in its query, and posts to it."""

    def do_GET(self):
        there = self.path.partition("?")[2]
        words = f"""<!doctype html><script>const seen = {{}};</script>
          <img src="{there}/frame?show=eye&still=1&width=64&yaw_deg=120"
            onload="seen.image = 'loaded'" onerror="seen.image = 'refused'">
          <iframe src="{there}/" onload="seen.frame = this.contentDocument === null"></iframe>
          <form action="{there}/rest" method="post" target="answer"><input name="yaw_deg" value="120"></form>
          <iframe name="answer"></iframe><script>document.forms[0].submit();
          fetch("{there}/scene.json").then(() => seen.token = "read", () => seen.token = "refused");</script>"""
        self.send_response(200)
        self.end_headers()
        self.wfile.write(words.encode())

    def log_message(self, *_):
        pass


def test_pages_from_elsewhere_do_not_steer_the_panel(tmp_path, stage):
    with serving(steering_routes(stage, exports(stage))) as server, browser(tmp_path) as page:
        with ThreadingHTTPServer(("127.0.0.1", 0), Elsewhere) as other:
            threading.Thread(target=other.serve_forever, daemon=True).start()
            page.open(f"http://localhost:{other.server_port}/?{server.url}")
            page.wait("typeof seen === 'object' && seen.image && seen.token && seen.frame !== undefined")
            seen = page.run("seen")
            other.shutdown()
        assert seen == {"image": "refused", "token": "refused", "frame": True} and stage.version == 0
        page.open(server.url)  # and its own page does
        page.wait(REST)
        version = stage.version
        page.run("(s => {s.value = 40; s.dispatchEvent(new Event('input'))})(document.querySelector('#depth_amount'))")
        page.wait(REST)
        assert stage.version == version + 1 and page.run("document.querySelector('#trouble').hidden")


def test_panel_shows_its_pixels_as_they_are(tmp_path):
    panel = replace(PANEL, width_px=640, height_px=480)
    picture = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    with serving(shown_routes(panel, picture)) as server, browser(tmp_path, 640, 480) as page:
        page.call(
            "Emulation.setDeviceMetricsOverride",
            width=640,
            height=480,
            deviceScaleFactor=1,
            mobile=False,
            screenWidth=640,
            screenHeight=480,
        )
        page.open(server.url + "/panel")
        page.wait("document.body?.dataset.exact === 'true'")
        np.testing.assert_array_equal(page.screenshot(), picture)
        assert page.run("document.querySelector('#word').hidden")


def test_a_stereo_picture_fills_the_screen(tmp_path):
    """Both halves are stretched over it, as screens of two eyes take them, whatever the picture's pixels."""
    panel = replace(PANEL, width_px=400, height_px=100)
    picture = np.zeros((100, 400, 3), np.uint8)
    picture[:, :200, 0] = 255
    with serving(shown_routes(panel, picture, fills=True)) as server, browser(tmp_path, 640, 480) as page:
        size = dict(width=640, height=480, screenWidth=640, screenHeight=480)
        page.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=1, mobile=False)
        page.open(server.url + "/panel")
        page.wait("document.body?.dataset.exact === 'true'")
        shown = page.screenshot()
        assert (shown[:, :316] == [255, 0, 0]).all() and (shown[:, 324:] == 0).all()
        assert page.run("document.querySelector('#word').hidden")


@pytest.mark.parametrize(
    "scale, screen, word",
    [
        (1.25, (512, 384), "set the zoom of the browser to 100 %"),
        (2, (640, 480), "This screen has 1280 × 960 pixels"),
        (1, (800, 600), "This screen has 800 × 600 pixels"),
    ],
    ids=["zoom", "ratio", "size"],
)
def test_wrong_pixels_are_told_aloud(tmp_path, scale, screen, word):
    panel = replace(PANEL, width_px=640, height_px=480)
    with serving(shown_routes(panel, np.zeros((480, 640, 3), np.uint8))) as server:
        with browser(tmp_path, *screen, scale) as page:
            page.open(server.url + "/panel")
            page.wait("document.body?.dataset.exact === 'false'")
            assert page.run("devicePixelRatio") == scale
            assert word in page.run("document.querySelector('#word').innerText")
            assert not page.run("document.querySelector('#word').hidden")
            width = page.run("document.querySelector('#picture').getBoundingClientRect().width")
            assert width * scale == 640  # one pixel of the picture is one of the screen all the same


def test_look_around_page_follows_the_mouse(tmp_path, stage):
    write_preview(tmp_path / "v", stage.native(Controls())[0], stage.gaussians, PANEL, stage.base)
    page_file = tmp_path / "v" / "look-around.html"
    assert "http" not in page_file.read_text()  # nothing of the network
    with browser(tmp_path) as page:
        page.open(page_file.as_uri())
        page.wait("document.querySelector('canvas')?.dataset.view")
        box = page.run("document.querySelector('canvas').getBoundingClientRect().toJSON()")
        assert box["width"] == page.run("innerWidth") and box["height"] > 0.8 * page.run("innerHeight")
        assert "This page can be sent" in page.run("document.body.innerText")
        shown = []
        for share in (0.0, 1.0):
            page.mouse("mouseMoved", box["x"] + share * (box["width"] - 1), box["y"] + 5)
            page.wait(f"document.querySelector('canvas').dataset.view == {round(share * 23)}")
            shown.append(page.screenshot().astype(int))
        assert np.abs(shown[0] - shown[1]).max() > 50


def test_show_opens_an_encoded_image(tmp_path):
    write_image(tmp_path / "i.png", np.full((60, 96, 3), 7, np.uint8), {"panel": json.dumps(PANEL.to_dict())})
    process = subprocess.Popen(
        [sys.executable, "-m", "lightfield_gs", "show", str(tmp_path / "i.png"), "--no-open"],
        stdout=subprocess.PIPE,
        preexec_fn=heed_ctrl_c,
    )
    try:
        lines = io.TextIOWrapper(process.stdout)
        url = next(line for line in lines if line.startswith("open ")).split()[1]
        with browser(tmp_path) as page:
            page.open(url)
            page.wait("document.querySelector('#picture')?.naturalWidth === 96")
            assert "the panel small has 96 × 60" in page.run("document.querySelector('#word').innerText")
        process.send_signal(signal.SIGINT)  # Ctrl-C
        assert process.wait(10) == 0
        assert lines.read().strip() == "ended"
    finally:
        process.kill()
        process.wait(10)
