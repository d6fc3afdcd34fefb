"""Sources of live pictures: films, folders, streams and the screen, and cameras that are pulled out."""

import http.server
import threading
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from live_sources import Clock
from screen_cases import edid
from virtual_screen import virtual_screen

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import write_image
from lightfield_gs.live import cameras, opening, sources
from lightfield_gs.live.cameras import Device
from lightfield_gs.live.opening import open_source
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.slot import Slot, in_thread
from lightfield_gs.live.sources import DeviceSource
from lightfield_gs.video.decoding import Scaling

av = pytest.importorskip("av", reason="live sources need the extra `video`")
ALL = Scaling(1 << 24)


@pytest.fixture
def film(tmp_path):
    """Six frames at 20 a second, each of its own grey."""
    path = tmp_path / "film.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=20)
        stream.height, stream.width, stream.pix_fmt = 24, 32, "bgr0"
        for number in range(6):
            grey = np.full((24, 32, 3), 40 * number, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def greys(frames) -> list[int]:
    return [int(frame.picture(ALL).pixels[0, 0, 0]) for frame in frames]


def test_a_film_comes_at_its_own_rate_and_begins_again(film):
    frames = list(open_source(str(film), 30).frames(threading.Event()))
    steps = np.diff([frame.taken for frame in frames])
    assert greys(frames) == [0, 40, 80, 120, 160, 200]
    assert 0.2 < steps.sum() < 1 and steps.max() > 0.03  # five steps of 50 ms
    looped = open_source(str(film), 30, is_looped=True).frames(threading.Event())
    again = [next(looped) for _ in range(8)]
    assert greys(again)[-2:] == [0, 40] and [frame.number for frame in again] == list(range(8))


def test_a_thread_of_their_own_makes_items_and_its_errors_are_raised_here():
    threads, goes_on = [], threading.Event()

    def items():
        for number in range(3):
            threads.append(threading.current_thread().name)
            yield number
            goes_on.wait(5)
            goes_on.clear()
        raise InputError("broken")

    found = []
    with pytest.raises(InputError, match="broken"):
        for item in in_thread("maker", items()):
            found.append(item)
            goes_on.set()
    assert found == [0, 1, 2] and threads == ["maker"] * 3


def test_who_puts_a_thing_can_wait_until_it_is_taken_or_nobody_will():
    slot: Slot[int] = Slot()
    slot.wait_taken()
    order = []
    thread = threading.Thread(target=lambda: (slot.put(1), slot.wait_taken(), order.append("taken"), slot.put(2)))
    thread.start()
    time.sleep(0.1)
    assert order == [] and next(iter(slot)) == 1
    thread.join(5)
    assert order == ["taken"]
    slot.close()
    slot.wait_taken()


def test_only_the_newest_waits():
    slot: Slot[int] = Slot()
    for item in range(5):
        slot.put(item)
    slot.close()
    assert list(slot) == [4]


def test_pictures_are_reduced_by_whole_halves(film):
    frame = next(open_source(str(film), 30).frames(threading.Event()))
    assert frame.picture(Scaling(200)).pixels.shape == (12, 16, 3)
    values = np.arange(64, dtype=np.uint16).reshape(8, 8, 1)
    assert sources.reduced(values, Scaling(16)).tolist() == [
        [[9 // 2 + 16 * row + 2 * column] for column in range(4)] for row in range(4)
    ]
    nearest = sources.reduced(values, Scaling(16, is_nearest=True))
    assert set(nearest.ravel()) <= set(values.ravel()) and nearest.shape == (4, 4, 1)


def test_a_camera_is_a_device_of_ffmpeg(film, monkeypatch):
    camera = Device("Desk camera", str(film), "matroska", ({"no_such_option": "1"},), crop=(8, 4, 16, 12))
    monkeypatch.setattr(opening, "find_camera", lambda which: {"desk": camera}[which])
    frames = list(open_source("camera:desk", 30).frames(threading.Event()))
    assert len(frames) == 6 and frames[2].picture(ALL).pixels.shape == (12, 16, 3)


def test_a_camera_that_is_not_there_is_refused_with_those_that_are(monkeypatch):
    found = [("/dev/video2", "Desk camera"), ("/dev/video0", "Lid camera")]
    listed = [SimpleNamespace(name=name, description=words, media_types=["video"]) for name, words in found]
    monkeypatch.setattr(cameras.sys, "platform", "linux")
    monkeypatch.setattr(av, "enumerate_input_devices", lambda kind: listed, raising=False)
    assert cameras.find_camera("2").address == cameras.find_camera("desk").address == "/dev/video2"
    with pytest.raises(InputError, match=r"camera:7.*camera:0 \(Lid camera\), camera:2 \(Desk camera\)"):
        cameras.find_camera("7")
    listed.clear()
    with pytest.raises(InputError, match="no camera was found; is it plugged in"):
        cameras.find_camera("window")


def test_windows_and_macs_have_their_own_addresses(monkeypatch):
    listed = [SimpleNamespace(name="Cam", description="USB Cam", media_types=["video"])]
    listed.insert(0, SimpleNamespace(name="Mic", description="USB Mic", media_types=["audio"]))
    monkeypatch.setattr(av, "enumerate_input_devices", lambda kind: listed, raising=False)
    monkeypatch.setattr(cameras.sys, "platform", "win32")
    assert (cameras.find_camera("0").format, cameras.find_camera("0").address) == ("dshow", "video=Cam")
    assert cameras.find_screen("10,20,64x48", 30).wishes[0]["offset_x"] == "10"
    monkeypatch.setattr(cameras.sys, "platform", "darwin")
    assert cameras.find_camera("usb").address == "Cam:none"
    assert cameras.find_screen("10,20,64x48", 30).crop == (10, 20, 64, 48)


def test_a_camera_that_is_pulled_out_is_opened_again():
    class Loose(Clock):
        opened = 0

        def frames(self, stop):
            self.opened += 1
            if self.opened in (2, 3):
                raise InputError("clock: no such device")
            yield from super().frames(stop)

    said: list[str] = []
    back = threading.Event()
    camera = Loose(500, 3, ends=False)
    reader = Reader(camera, lambda frame: camera.opened == 4 and back.set(), said.append, first_pause_s=0.01)
    reader.start()
    assert back.wait(10)
    reader.stop()
    assert said[:4] == [
        "clock: it sends no more pictures; it is opened again in 0.01 s",
        "clock: no such device; it is opened again in 0.02 s",
        "clock: no such device; it is opened again in 0.04 s",
        "clock: it is back",
    ]
    assert reader.failed is None


def test_a_camera_that_never_was_there_is_an_error():
    class Absent(Clock):
        def frames(self, stop):
            raise InputError("clock: no such device")

    reader = Reader(Absent(1, 1, ends=False), lambda frame: None, print)
    reader.start()
    assert list(reader.newest) == [] and "no such device" in str(reader.failed)


def test_a_folder_shows_its_newest_complete_picture(tmp_path):
    def grey(name: str, value: int) -> bytes:
        write_image(tmp_path / "whole.png", np.full((64, 64, 3), value, np.uint8))
        return (tmp_path / "whole.png").rename(tmp_path / name).read_bytes()

    (tmp_path / "in").mkdir()
    grey("in/old.png", 10)
    time.sleep(0.02)
    grey("in/new.png", 20)
    frames = open_source(str(tmp_path / "in"), 30).frames(threading.Event())
    first = next(frames)
    assert greys([first]) == [20] and 0 <= time.monotonic() - first.taken < 5
    data = grey("half.png", 30)
    growing = tmp_path / "in" / "growing.png"
    growing.write_bytes(data[: len(data) // 2])
    threading.Timer(0.3, growing.write_bytes, [data]).start()
    began = time.monotonic()
    assert greys([next(frames)]) == [30] and time.monotonic() - began > 0.25


def test_a_stream_is_read_over_http(film):
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(film.parent))
    handler.func.log_message = lambda *words: None
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        source = open_source(f"http://user:secret@127.0.0.1:{server.server_address[1]}/film.mkv", 30)
        frames = list(source.frames(threading.Event()))
        server.shutdown()
    assert greys(frames) == [0, 40, 80, 120, 160, 200]
    assert "secret" not in source.name and source.ends  # it states its length


def test_a_part_of_the_screen(tmp_path, monkeypatch):
    with virtual_screen(tmp_path, 320, 200, edid("LKG-P00671", "P00671", (320, 200))) as screen:
        monkeypatch.setenv("DISPLAY", screen.display)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        part = next(open_source("screen:16,8,64x48", 30).frames(threading.Event())).picture(ALL).pixels
        whole = next(open_source("screen:", 30).frames(threading.Event())).picture(ALL).pixels
    assert part.shape == (48, 64, 3) and whole.shape == (200, 320, 3)


@pytest.mark.parametrize(
    "words, expected",
    [
        ("camera:", "its number or a part of its name"),
        ("screen:1,2,3", "screen:100,50,1280x720"),
        ("nothing.mp4", "No such file"),
        ("nothing", "expected a video, a folder, camera:N"),
    ],
)
def test_what_is_no_source_is_refused(words, expected, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    with pytest.raises(InputError, match=expected):
        list(open_source(words, 30).frames(threading.Event()))


def test_wayland_shows_no_screen(monkeypatch):
    monkeypatch.setattr(cameras.sys, "platform", "linux")
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    with pytest.raises(InputError, match="X11"):
        open_source("screen:", 30)


def test_device_source_takes_the_first_options_that_fit(film):
    refused = Device("x", str(film), "v4l2", ({}, {}))
    with pytest.raises(InputError, match="x is not a video"):
        next(DeviceSource(refused).frames(threading.Event()))
