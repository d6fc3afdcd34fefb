"""`show` of many: which files are slides of which screen, the page that shows them in turn, and wall mode."""

import io
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from chromium import Browser, find
from command_line import PANEL, complaint, heed_ctrl_c, run
from PIL import Image
from test_page import get, serving

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.playlist import find_slides
from lightfield_gs.app.slide_pixels import native_frames, read_slide
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.stereo import join_eyes
from lightfield_gs.encoding.weave import weave
from lightfield_gs.io.images import write_image
from lightfield_gs.show.display_browser import browser_command
from lightfield_gs.show.page.slides import SlideOptions, SlidePixels, slide_routes
from lightfield_gs.view_sets.view_set import open_views

WEBGL = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--use-gl=angle")
NATIVE = {"panel": json.dumps(PANEL.to_dict())}


def plain(*colour: int) -> np.ndarray:
    return np.full((PANEL.height_px, PANEL.width_px, 3), colour, np.uint8)


def routes_of(playlist, options=SlideOptions()):
    return slide_routes(playlist, options, SlidePixels(lambda slide: read_slide(slide, playlist), native_frames))


def smooth(height: int, width: int, seed: int) -> np.ndarray:
    """A picture that codecs keep."""
    small = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


def film(path: Path, frames: list[np.ndarray], codec: str, pixel_format: str, **options: str) -> Path:
    av = pytest.importorskip("av", reason="films need the extra `video`")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pixel_format
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    return path


@pytest.fixture
def folder(tmp_path) -> Path:
    """Slides of a panel, and files that are none."""
    write_image(tmp_path / "10.png", plain(0, 255, 0), NATIVE)
    write_image(tmp_path / "9.png", plain(255, 0, 0), NATIVE)
    write_image(tmp_path / "quilt_qs4x2a1.6.png", smooth(80, 256, 1))
    film(tmp_path / "native.mkv", [plain(0, 0, 9 * n) for n in range(3)], "ffv1", "bgr0")
    (tmp_path / "notes.txt").write_text("")
    write_image(tmp_path / "photo.png", smooth(90, 120, 2))
    write_image(tmp_path / "10_depth.png", plain(1, 1, 1))
    write_image(tmp_path / "pair_2x1.png", smooth(90, 240, 3))
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0 cut")
    return tmp_path


def test_a_folder_shows_what_is_for_its_screen_in_natural_order(folder):
    playlist = find_slides([folder], PanelOptions(), None)
    assert [slide.path.name for slide in playlist.slides] == ["9.png", "10.png", "native.mkv", "quilt_qs4x2a1.6.png"]
    assert playlist.panel.name == PANEL.name and playlist.layout is None
    told = " ".join(playlist.messages)
    assert all(name in told for name in ("photo.png", "pair_2x1.png", "broken.jpg")) and "notes.txt" not in told
    pairs = find_slides([folder / "pair_2x1.png"], PanelOptions(), None)
    assert pairs.layout == "sbs" and pairs.slides[0].pair.kind == "sbs"


def test_files_that_are_named_are_shown_or_refused(folder, capsys):
    for names, words in (
        (("9.png", "photo.png"), "photo.png is 120 x 90 pixels .* encode it first"),
        (("9.png", "pair_2x1.png"), "for a screen of two eyes, and .* for a panel"),
        (("9.png", "missing.png"), "missing.png"),
    ):
        with pytest.raises(InputError, match=words):
            find_slides([folder / name for name in names], PanelOptions(), None)
    assert "says that it is stereo" in complaint(capsys, f"show {folder / '9.png'} --stereo sbs")
    (folder / "empty").mkdir()
    assert "nothing in it can be shown" in complaint(capsys, f"show {folder / 'empty'}")


def test_films_come_in_parts(folder):
    path = film(folder / "f_qs4x2a1.6.mp4", [smooth(80, 256, 1)] * 2, "libx264", "yuv420p")
    data = path.read_bytes()
    with serving(routes_of(find_slides([folder / "9.png", path], PanelOptions(), None))) as server:
        for wanted, start, end in (
            ("bytes=0-", 0, len(data)),
            ("bytes=10-19", 10, 20),
            ("bytes=-5", len(data) - 5, len(data)),
            (f"bytes=7-{10 * len(data)}", 7, len(data)),
        ):
            status, body, answer = get(server, "/film?n=1", Range=wanted)
            assert (status, body) == (206, data[start:end])
            assert answer.headers["Content-Range"] == f"bytes {start}-{end - 1}/{len(data)}"
        for wanted in (f"bytes={len(data)}-", "bytes=-", "lines=1-2", "bytes=9-3"):
            assert get(server, "/film?n=1", Range=wanted)[0] == 416
        assert get(server, "/film?n=0")[0] == get(server, "/slide.png?n=1")[0] == get(server, "/film?n=2")[0] == 400


def shown(page: Browser) -> np.ndarray:
    return page.screenshot()[: PANEL.height_px, : PANEL.width_px]


def test_slides_follow_each_other_with_their_own_pixels(folder):
    """Pictures and native frames keep every byte; quilts are woven in the browser as `weave` does."""
    frames = [smooth(80, 256, seed) for seed in (4, 4)]
    moving = film(folder / "moving_qs4x2a1.6.mp4", frames, "libx264", "yuv444p", crf="1")
    inputs = [folder / name for name in ("9.png", "quilt_qs4x2a1.6.png", "native.mkv", moving.name)]
    playlist = find_slides(inputs, PanelOptions(), None)
    find()
    with serving(routes_of(playlist, SlideOptions(seconds=0, fade=0))) as server:
        page = Browser(folder, 640, 480, gpu=WEBGL)
        try:
            page.open(server.url)

            def at(index: int) -> np.ndarray:
                page.wait(f"document.body?.dataset.slide === '{index}'")
                time.sleep(0.3)
                return shown(page)

            def press(key: str) -> None:
                page.run(f"dispatchEvent(new KeyboardEvent('keydown', {{key: {json.dumps(key)}}}))")

            at(0)
            page.run("document.querySelector('#hide').click()")
            assert (at(0) == [255, 0, 0]).all()
            press("ArrowRight")
            quilt = open_views(inputs[1])
            assert (at(1) == weave(quilt.views, PANEL, aspect=1.6).numpy()).all()
            press("n")
            at(2)
            press(" ")  # stops
            time.sleep(0.3)
            still = shown(page)
            number = int(page.run("document.querySelector('#picture').dataset.frame"))
            assert (still == [0, 0, 9 * number]).all() and (shown(page) == still).all()
            press(" ")
            press("End")
            tiles = frames[0].reshape(2, 40, 4, 64, 3)[::-1].transpose(0, 2, 1, 3, 4).reshape(8, 40, 64, 3)
            woven = weave(np.ascontiguousarray(tiles), PANEL, aspect=1.6).numpy()
            assert np.abs(at(3).astype(int) - woven).max() <= 6  # what the codec leaves
            press("ArrowRight")  # and begins again
            assert (at(0) == [255, 0, 0]).all()
            press("h")
            assert page.run("!document.querySelector('#keys').hidden")
        finally:
            page.close()


def test_films_of_two_eyes_fill_the_screen_as_it_takes_them(tmp_path):
    eyes = [smooth(60, 96, 5), smooth(60, 96, 6)]
    path = film(tmp_path / "film_LRF_Full_SBS.mp4", [np.concatenate(eyes, 1)] * 2, "libx264", "yuv444p", crf="1")
    playlist = find_slides([path], PanelOptions(), "anaglyph")
    find()
    with serving(routes_of(playlist)) as server:
        page = Browser(tmp_path, 640, 480, gpu=WEBGL)
        try:
            page.open(server.url)
            page.wait("document.body?.dataset.slide === '0'")
            page.run("document.querySelector('#hide').click()")
            seen = Image.fromarray(page.screenshot()).resize((96, 60), Image.Resampling.BOX)
        finally:
            page.close()
    import torch

    expected = join_eyes(torch.from_numpy(np.stack(eyes)), "anaglyph").numpy().astype(int)
    assert np.abs(np.asarray(seen).astype(int) - expected).mean() < 4


def test_the_browser_is_told_where_the_display_is():
    command = browser_command("chromium", "http://127.0.0.1:1/", "/tmp/profile", (1920, 0), (96, 60), is_kiosk=True)
    assert "--window-position=1920,0" in command and "--window-size=97,61" in command
    assert "--kiosk" in command and "--force-device-scale-factor=1" in command
    command = browser_command("chromium", "http://127.0.0.1:1/", "/tmp/profile", None, None, is_kiosk=False)
    assert "--start-fullscreen" in command and not any("position" in word for word in command)


def test_lines_say_what_is_shown(folder, capsys, monkeypatch):
    monkeypatch.setattr("lightfield_gs.commands.show.serve", lambda *_: None)
    words = run(capsys, f"show {folder} --shuffle --seconds 4")
    assert "3 pictures and 1 film: 96 x 60, for panel small" in words and "4 s each, by chance" in words
    assert "3 files are left out" in words and "for a screen of two eyes" in words


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="finds processes by /proc")
def test_a_wall_begins_again_by_itself(folder):
    """Its server is killed, and the page is there again."""
    process = subprocess.Popen(
        [sys.executable, "-m", "lightfield_gs", "show", str(folder / "9.png"), "--wall", "--no-open"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        preexec_fn=heed_ctrl_c,
    )

    def run_number(url: str, other_than: str | None = None) -> str:
        end = time.monotonic() + 120
        while time.monotonic() < end:
            try:
                found = json.load(opener.open(url + "slides.json", timeout=5))["run"]
            except OSError:
                found = other_than
            if found != other_than:
                return found
            time.sleep(0.2)
        raise AssertionError("the server does not answer")

    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        url = (
            next(line for line in io.TextIOWrapper(process.stdout) if line.startswith("wall mode"))
            .split()[3]
            .rstrip(":")
        )
        first = run_number(url)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        servers = [pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
        os.kill(int(servers[0]), signal.SIGKILL)
        assert run_number(url, first) != first
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
    finally:
        process.kill()
        process.wait(10)
