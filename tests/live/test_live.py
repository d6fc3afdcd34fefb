"""A live picture from end to end: what is shown, when, and how it ends."""

import http.client
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import pytest
import torch
from chromium import Browser
from command_line import complaint, heed_ctrl_c, run
from live_sources import Clock, clock, read_clock, write_film
from photo_cases import photo, tiny_net
from PIL import Image

from lightfield_gs.app.options import FLAT, LookOptions, PhotoOptions, RenderOptions
from lightfield_gs.base.cli_messages import capturable_streams
from lightfield_gs.cli import main
from lightfield_gs.io.images import Picture
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.drawing import LiveRenderer
from lightfield_gs.live.health import Health, Span, Took
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.page import PageOut
from lightfield_gs.live.pipeline import Pipeline
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.sources import FilmSource, FolderSource, Frame
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.page.server import Server
from lightfield_gs.video.decoding import decode, timeline
from lightfield_gs.video.rendering import FrameOptions, NativeRenderer

pytest.importorskip("av", reason="live sources need the extra `video`")
PANEL = Panel.load("toy-8v")
WHITE = FrameOptions()


def scenes_of(source, photo_options: PhotoOptions, health: Health, pixels: int = 240 * 120) -> LiveScenes:
    how = RenderOptions(), LookOptions(), PANEL, "cpu", Detail(30, pixels), health
    return LiveScenes(source, photo_options, *how)


@contextmanager
def shown(
    source, health: Health, page: PageOut, outs=(), photo: PhotoOptions = PhotoOptions(depth=FLAT)
) -> Iterator[threading.Event]:
    """A source whose pictures are on a page, flat unless options say otherwise; yields what is set at its end."""
    over = threading.Event()
    with capturable_streams():
        reader = Reader(source, health.has_taken, print)
        scenes = scenes_of(source, photo, health)
        reader.start()
        scenes.settle(iter(reader.newest))
        drawer = LiveRenderer(PANEL, WHITE, scenes.detail)
        pipeline = Pipeline(reader, scenes, drawer, [page, *outs], health, over.set)
        pipeline.start()
        try:
            yield over
        finally:
            pipeline.stop()


def test_latency_is_what_a_clock_in_the_picture_says():
    source, health = Clock(10, 40), Health()
    page = PageOut(PANEL, health)
    server = Server(page.routes())
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=30)

    def get(path: str) -> tuple[bytes, http.client.HTTPResponse]:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.read(), answer

    seen: list[tuple[int, float]] = []
    with shown(source, health, page) as over:
        health.take()
        version = json.loads(get("/panel.json?after=-1")[0])["version"]
        while not over.is_set():
            version = json.loads(get(f"/panel.json?after={version}")[0])["version"]
            body, answer = get("/panel.png")
            here = time.monotonic()
            version = int(answer.headers["X-Version"])
            seen.append((read_clock(np.asarray(Image.open(io.BytesIO(body))), PANEL), here))
            if len(seen) >= 8:
                break
    server.shutdown()
    server.server_close()
    numbers = [number for number, _ in seen]
    assert numbers == sorted(set(numbers)) and len(numbers) >= 4  # each once, in their order
    true = median(here - source.taken[number] for number, here in seen)
    span = health.take()
    told = median(span.latencies_s)
    assert abs(true - told) < 0.1, (true, told)


def test_a_picture_at_rest_is_shown_and_drawn_again_where_its_state_changes(tmp_path):
    """A folder whose newest picture stays: its owner zooms, or the eyes that it is drawn for move."""
    Image.fromarray(clock(5)).save(tmp_path / "only.png")
    health, state, source = Health(), [0], FolderSource(tmp_path)
    page, reader = PageOut(PANEL, health), Reader(source, health.has_taken, print)
    scenes = scenes_of(source, PhotoOptions(depth=FLAT), health)

    def version(wanted: int) -> int:
        until = time.monotonic() + 10
        while page.newest()[0] < wanted and time.monotonic() < until:
            time.sleep(0.01)
        return page.newest()[0]

    with capturable_streams():
        reader.start()
        scenes.settle(iter(reader.newest))
        draw = NativeRenderer(PANEL, WHITE, False)
        pipeline = Pipeline(reader, scenes, draw, [page], health, lambda: None, lambda: state[0])
        pipeline.start()
        try:
            assert version(1) == 1 and read_clock(page.newest()[1], PANEL) == 5
            state[0] = 1
            assert version(2) == 2
            time.sleep(0.2)
            assert version(2) == 2  # once for each change
            assert health.drawn == 1  # else the health line would ask whether the page is open
        finally:
            pipeline.stop()


def test_a_clock_is_read_back_from_the_panels_picture():
    """The test's own reader: each number that differs in one bit is told apart."""
    scenes = scenes_of(Clock(1, 1), PhotoOptions(depth=FLAT), Health())
    draw = NativeRenderer(PANEL, WHITE, False)
    numbers = [0, 1, 2, 341, 512, 1023]
    with capturable_streams(), torch.inference_mode():
        frames = [Frame(n, 0.0, lambda scaling, n=n: Picture(clock(n))) for n in numbers]
        scenes.settle(iter(frames[3:4]))
        drawn = [draw(scene, scenes.rig, 0).numpy() for _, scene in scenes(iter(frames))]
    assert [read_clock(image, PANEL) for image in drawn] == numbers


@pytest.fixture
def film(tmp_path) -> Path:
    frames = [clock(number, (40, 80)) for number in range(12)]
    for number, frame in enumerate(frames):
        frame[8 + 2 * number :: 7, number::9] = 200, 30, 90
    return write_film(tmp_path / "film.mkv", frames)


def test_a_recording_has_frames_of_video_in_their_time(film, tmp_path, capsys):
    """`video` draws all frames of the film; `live` records some of them, to the bit, when they were there."""
    flat = "--depth flat --panel toy-8v"
    run(capsys, f"video {film} -o {tmp_path}/all.mkv {flat}")
    said = run(capsys, f"live {film} -o {tmp_path}/live.mkv {flat} --quality exact --fps 5 --no-open")
    every = [frame.tobytes() for frame in decode(tmp_path / "all.mkv")]
    found = [every.index(frame.tobytes()) for frame in decode(tmp_path / "live.mkv")]
    assert found == sorted(set(found)) and found[0] == 0 and found[-1] > 9 and 1 < len(found) <= len(every) == 12
    times = timeline(tmp_path / "live.mkv").order
    assert abs(len(times) - (found[-1] - found[0] + 1)) <= 1  # frames that were left out leave their time
    assert said.count("whole picture, flat") == 1  # of the first, not of each
    assert "frames a second shown" in said and f"next: lightfield-gs show {tmp_path}/live.mkv" in said


def test_a_film_waits_while_its_first_pictures_settle_how_all_are_shown(film):
    taken: list[int] = []
    reader = Reader(FilmSource(film), lambda frame: taken.append(frame.number), print, holds_film=True)
    reader.start()
    first = reader.first()
    assert [next(first).number, next(first).number] == [0, 1]
    time.sleep(0.3)  # of 12 frames, 5 a second
    assert taken == [0, 1]
    reader.go_on()
    assert next(first).number == 2
    reader.stop()


def test_ctrl_c_ends_with_a_whole_recording(film, tmp_path):
    command = [sys.executable, "-m", "lightfield_gs", "live", str(film), "--loop", "--depth", "flat"]
    command += ["--panel", "toy-8v", "--no-open", "-o", str(tmp_path / "out.mkv")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c) as process:
        assert process.stdout is not None
        next(line for line in process.stdout if "frames a second" in line and not line.startswith("0.0"))
        os.kill(process.pid, signal.SIGINT)
        rest = process.stdout.read()
    assert process.returncode == 0 and "ended" in rest
    assert len(list(decode(tmp_path / "out.mkv"))) >= 1


def test_pictures_without_an_object_are_counted_and_left_out(tmp_path):
    weights = tmp_path / "tiny.safetensors"
    tiny_net().save(weights)
    rgba = photo(96, 128)
    subject = (255 * (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])).astype(np.uint8)
    nothing = np.full_like(subject, 255)
    frames = [
        Frame(n, 0.0, lambda scaling, p=p: Picture(p)) for n, p in enumerate((nothing, subject, nothing, subject))
    ]
    health = Health()
    scenes = scenes_of(Clock(1, 1), PhotoOptions(checkpoint=weights, detail="none"), health)
    with capturable_streams(), torch.inference_mode():
        scenes.settle(iter(frames))
        made = [frame.number for frame, _ in scenes(iter(frames))]
    assert made == [1, 3]
    span = health.take()
    assert list(span.unused.values()) == [2] and "2 not used: " in span.line()


def span_of(seconds: float, taken: int, before_s: float = 0.0, **busy: tuple[float, int]) -> Span:
    """Stages with their seconds of work and their number of pictures, which came now, or so long ago."""
    span, moment = Span(seconds=seconds, taken=taken), time.monotonic() - before_s
    span.busy_s = {name: each for name, (each, _) in busy.items()}
    span.took = {name: [Took(each / count, moment)] * count for name, (each, count) in busy.items()}
    return span


def test_a_picture_on_a_page_and_in_a_recording_counts_once():
    health = Health()
    for number in (0, 0, 1, 0, 2):
        health.has_sent(Frame(number, time.monotonic(), lambda scaling: Picture(clock(0))))
    assert health.take().shown == health.shown == 3


def test_the_busiest_stage_is_the_bound_or_else_the_source():
    assert span_of(2, 60, depth=(1.9, 20), encode=(1.0, 20)).bound == "depth"
    assert span_of(2, 60, depth=(0.9, 60), encode=(1.0, 60)).bound == "source"


def test_pictures_become_smaller_until_the_rate_holds_and_never_for_more_than_the_source_has():
    detail = Detail(30, None)
    detail.size_px = 720, 1280
    slow = dict(depth=(1.0, 10), encode=(0.2, 10))
    assert detail.adapt(span_of(1, 30, depth=(0.1, 1))) == []  # the first picture of a size takes longer
    (line,) = detail.adapt(span_of(1, 30, **slow))
    assert "the depth takes 100 ms" in line and "not 1280 x 720" in line
    assert detail.scaling.most_pixels == pytest.approx(720 * 1280 * 0.3)
    assert detail.adapt(span_of(1, 30, before_s=60, **slow)) == []  # of pictures before the change
    assert detail.adapt(span_of(1, 10, depth=(0.9, 10))) == []  # the source gives no more than ten
    detail.size_px = 180, 320
    better = span_of(1, 30, depth=(0.8, 10))
    assert "give --fps 12" in detail.adapt(better)[0] and detail.adapt(span_of(1, 30, **slow)) == []  # said once
    in_vain = Detail(30, None)
    in_vain.size_px = 720, 1280
    said = [in_vain.adapt(span_of(1, 30, encode=(0.98, 5))) for _ in range(3)]
    assert "do not help" in said[1][0] and said[2] == [] and in_vain.scaling == Detail(30, None).scaling
    automatic = Detail(30, None, None)
    automatic.size_px = 720, 1280
    said = [automatic.adapt(span_of(1, 30, encode=(0.98, 5))) for _ in range(2)]
    assert "--quality fast" in said[0][0] and automatic.quality == "fast" and "not 1280 x 720" in said[1][0]
    far = Detail(30, None, None)
    assert "--quality fast" in far.adapt(span_of(2, 60, encode=(2.0, 1)))[0]  # even the first picture
    unfinished = Detail(30, None, None)
    begun = span_of(1, 30)
    begun.works = {"encode": Took(2.0, time.monotonic())}
    assert "--quality fast" in unfinished.adapt(begun)[0]
    easy, hard = (Detail(30, None, None, is_slow=True) for _ in range(2))
    assert easy.quality == "fast" and "--quality exact" in easy.adapt(span_of(1, 30, encode=(0.1, 30)))[0]
    assert hard.adapt(span_of(1, 30, encode=(0.5, 30))) == [] and (easy.quality, hard.quality) == ("exact", "fast")
    assert Detail(30, None, "exact", is_slow=True).scaling.most_pixels < 500_000 < Detail(30, None).scaling.most_pixels
    wide = Detail(30, None)
    wide.size_px = 720, 1280
    wide.limit(0.25)
    assert wide.scaling.most_pixels == pytest.approx(720 * 1280 * (1.4 * 0.25) ** 2, abs=1)
    fixed = Detail(30, 1_000_000, network_px=98)
    fixed.network_took(98, 0.09)
    assert [fixed.adapt(span_of(1, 30, **slow)) for _ in range(3)] == [[]] * 3
    assert fixed.scaling.most_pixels == 1_000_000 and fixed.most_network_px == 98


def test_the_network_for_depths_sees_less_where_it_takes_most_of_the_time():
    detail = Detail(5, 1_000_000)
    detail.network_took(518, 0.5)
    (line,) = detail.adapt(span_of(1, 90, depth=(1.2, 2)))
    assert "the network for depths takes 500 ms" in line and "not 518" in line
    assert detail.most_network_px == int(518 * (0.08 / 0.5) ** 0.5)  # the rest of the depth takes 100 ms of 180
    detail.network_took(196, 0.3)
    assert "126 pixels" in detail.adapt(span_of(3, 90, depth=(2.5, 5)))[0]
    detail.network_took(126, 0.2)
    assert detail.adapt(span_of(3, 90, depth=(2.5, 5))) == [] and detail.most_network_px == 126
    in_vain = Detail(5, 1_000_000)
    in_vain.network_took(518, 2.3)  # a network that takes one size
    said = [in_vain.adapt(span_of(3, 90, depth=(2.4, 1))) for _ in range(3)]
    assert "do not help, and it sees 518 again" in said[1][0] and said[2] == [] and in_vain.most_network_px is None
    even = Detail(5, 1_000_000)
    even.network_took(518, 0.9)
    assert even.adapt(span_of(3, 90, depth=(2.4, 1))) == [] and even.most_network_px is None
    foreseen = Detail(30, None)
    assert foreseen.foresee_network(518, 126, 0.0005) == [] and foreseen.most_network_px is None
    assert "126 pixels to the shorter side, not 518" in foreseen.foresee_network(518, 126, 0.1)[0]
    both = Detail(5, None, None)
    both.network_took(518, 2.3)
    assert len(both.adapt(span_of(3, 90, depth=(2.4, 1), encode=(2.4, 1)))) == 2


@pytest.mark.parametrize(
    "options, words",
    [
        ("--mask m.png", "--remove-background"),
        ("--depth map.png", "--depth auto"),
        ("--intrinsics 1,1,1,1", "--fov"),
        ("--detail 2 --depth flat", "--detail"),
        ("-o out.png", ".mkv"),
        ("-o out.mp4 --codec h264", "h264-rgb"),
        ("--depth-model X --depth flat", "--depth auto"),
        ("--network-px 98 --depth flat", "--depth auto"),
    ],
)
def test_what_a_live_picture_cannot_have_is_refused(film, options, words, capsys):
    assert words in complaint(capsys, f"live {film} --panel toy-8v --no-open {options}")


def test_a_film_without_an_object_is_refused_with_the_ways_that_a_live_picture_has(tmp_path, capsys, monkeypatch):
    random = np.random.default_rng(0)
    film = write_film(tmp_path / "noise.mkv", random.integers(0, 256, (20, 40, 80, 3), np.uint8))
    monkeypatch.setattr("lightfield_gs.photo.depth_network.is_installed", lambda: False)
    assert main(f"live {film} --panel toy-8v --no-open".split()) == 2
    said = capsys.readouterr().err
    assert f"error: {film} has no cut-out" in said and "--depth auto" in said and "--remove-background" in said
    assert "FILE" not in said and "partial" not in said


@pytest.mark.slow
def test_the_page_follows_pixel_for_pixel(tmp_path):
    health = Health()
    panel = replace(PANEL, width_px=640, height_px=480)
    page, random = PageOut(panel, health), np.random.default_rng(0)
    server = Server(page.routes())
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    browser = Browser(tmp_path, 640, 480)
    try:
        size = dict(width=640, height=480, screenWidth=640, screenHeight=480)
        browser.call("Emulation.setDeviceMetricsOverride", deviceScaleFactor=1, mobile=False, **size)
        browser.open(server.url + "/panel")
        for number in (1, 2, 3):
            pixels = random.integers(0, 256, (480, 640, 3), np.uint8)
            page.put(
                Frame(number, time.monotonic(), lambda scaling, p=pixels: Picture(p)), Drawn(torch.from_numpy(pixels))
            )
            browser.wait(f"document.body?.dataset.version === '{number}'")
            np.testing.assert_array_equal(browser.screenshot(), pixels)
    finally:
        browser.close()
        server.shutdown()
        server.server_close()
    assert health.take().shown == 3


def held() -> tuple[float, int, int]:
    """MiB of memory of this process, and its most threads and open files within a second: drawing has short ones."""
    most = [0, 0]
    for _ in range(100):
        time.sleep(0.01)
        most = [max(n, len(os.listdir(f"/proc/self/{name}"))) for n, name in zip(most, ("task", "fd"))]
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20, most[0], most[1]


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.not_sanitized
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("photo", [PhotoOptions(depth=FLAT), PhotoOptions(rgbd="right")], ids=["flat", "layers"])
def test_nothing_grows_in_half_a_minute(photo):
    health = Health()
    page = PageOut(PANEL, health)
    with shown(Clock(20, 1 << 20), health, page, photo=photo):
        time.sleep(8)
        before = held()
        time.sleep(20)
        after = held()
    assert health.drawn > 50 and after[0] - before[0] < 15, (before, after)
    assert after[1] <= before[1] and after[2] <= before[2], (before, after)
