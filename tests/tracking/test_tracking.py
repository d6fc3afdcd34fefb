"""Where a viewer's eyes are: by faces in pictures, by another program, by a file; without noise, and ahead of time."""

import math
import socket
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from eye_cases import PANEL as LENSES

from lightfield_gs import InputError, Panel, weave_eyes
from lightfield_gs.io.images import Picture
from lightfield_gs.live.sources import Frame
from lightfield_gs.panels.simulate import simulate
from lightfield_gs.tracking import faces
from lightfield_gs.tracking import tracker as tracker_module
from lightfield_gs.tracking.camera import TrackerCamera, above
from lightfield_gs.tracking.faces import FaceDetector
from lightfield_gs.tracking.motion import EyeMotion, EyeSample
from lightfield_gs.tracking.sources import FileEyes, PictureEyes, open_eyes
from lightfield_gs.tracking.tracker import EyeTracker

PANEL = Panel.load("toy-8v")
CAMERA = TrackerCamera(60.0, (0.0, 190.0, 0.0), 63.0)
SIZE = (640, 360)


def head(t: float) -> np.ndarray:
    """Eyes of a head that sways 100 mm to both sides and 40 mm to and fro, in two and three seconds."""
    x, y, z = 100 * math.sin(math.pi * t), 10 * math.sin(2 * t), 600 + 40 * math.sin(2 * math.pi / 3 * t)
    return np.array([[x - 31.5, y, z], [x + 31.5, y, z]])


def pixels_of(eyes_mm: np.ndarray) -> np.ndarray:
    """Where a pinhole camera above the panel, which looks at the viewer, has the eyes in its picture: the other way of
    TrackerCamera, written down on its own."""
    focal = SIZE[0] / (2 * math.tan(math.radians(30)))
    x, y, z = (eyes_mm - np.array([0, 190, 0])).T
    return np.stack([SIZE[0] / 2 - focal * x / z, SIZE[1] / 2 - focal * y / z], 1)


def test_motion_is_foretold_over_the_delay_of_a_camera():
    """30 pictures a second with noise, each known 60 ms late; half of them are lost for a while."""
    noise, motion, errors, lags = np.random.default_rng(0), EyeMotion(), [], []
    for number in range(240):
        taken = number / 30
        if 100 < number < 140 and number % 2:
            continue
        motion.update(taken, head(taken) + noise.normal(0, (0.5, 0.5, 4), (2, 3)))
        if number > 30:
            errors.append(motion.at(taken + 0.06) - head(taken + 0.06))
            lags.append(head(taken) - head(taken + 0.06))
    off, late = (np.sqrt((np.array(one) ** 2).mean((0, 1))) for one in (errors, lags))
    assert late[0] > 12  # mm: what a tracker without foresight would be off
    assert off[0] < 3.5 and off[1] < 1.2 and off[2] < 4.5, off


def test_eyes_of_another_face_begin_anew_and_old_measures_are_left_out():
    motion = EyeMotion()
    for number in range(20):
        motion.update(number / 30, head(0) + (3 * number, 0, 0))
    other = head(0) + (-400, 0, 100)
    motion.update(0.7, other)
    np.testing.assert_allclose(motion.at(0.75), other)  # without the speed of the first
    motion.update(0.65, head(0))
    np.testing.assert_allclose(motion.at(0.7), other)


def test_pixels_of_eyes_tell_their_place_before_the_panel():
    for eyes in (head(0), head(0.4), head(1.3) + (0, -70, -100)):
        np.testing.assert_allclose(CAMERA.eyes_mm(pixels_of(eyes), SIZE), eyes, atol=1e-9)
    high = 0.18 * 240 / 2
    assert above(PANEL) == (0, pytest.approx(high + 10), 0)


def test_a_moving_viewer_sees_little_of_the_other_eyes_picture():
    """Cameras see them with noise and 60 ms late; without foresight much of the other picture would be seen."""
    noise, motion, crosstalk = np.random.default_rng(1), EyeMotion(), {"foretold": 0.0, "late": 0.0}
    white = np.full((LENSES.height_px, LENSES.width_px, 3), 255, np.uint8)
    for number in range(120):
        taken = number / 30
        motion.update(taken, head(taken) + noise.normal(0, (0.5, 0.5, 4), (2, 3)))
        if number < 30 or number % 6:
            continue
        true = head(taken + 0.06)
        for name, eyes in (("foretold", motion.at(taken + 0.06)), ("late", head(taken))):
            woven = weave_eyes(0 * white, white, LENSES, eyes).numpy()  # the left eye is to see black
            seen = simulate(woven, LENSES, true[0])[2:-2, 2:-2].max()
            crosstalk[name] = max(crosstalk[name], float(seen))
    assert crosstalk["foretold"] < 0.01 and crosstalk["late"] > 0.03, crosstalk


class DotDetector:
    """Stands in for OpenCV's network: the eyes of each face are a red and a green dot."""

    def setInputSize(self, size: tuple[int, int]) -> None:  # noqa: N802
        self.size = size

    def detect(self, picture: np.ndarray) -> tuple[int, np.ndarray | None]:
        assert picture.shape[1::-1] == self.size
        dots = [np.argwhere(picture[..., channel] > 200)[:, ::-1].astype(np.float32) for channel in (2, 1)]
        rows = [np.concatenate([np.zeros(4), red, green, np.zeros(7)]) for red, green in zip(*dots)]
        return 1, np.array(rows, np.float32) if rows else None


def picture_of(*eyes_mm: np.ndarray) -> np.ndarray:
    """Faces before the camera: a red dot on each right eye, which the network gives first, and a green on the left."""
    picture = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    for left, right in map(pixels_of, eyes_mm):
        for (x, y), channel in ((right, 0), (left, 1)):
            picture[round(y), round(x), channel] = 255
    return picture


class Faces:
    """A camera whose pictures have these faces, ten a second."""

    name, pair, ends = "faces", None, True

    def __init__(self, *pictures: np.ndarray):
        self._pictures = pictures

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        for number, picture in enumerate(self._pictures):
            yield Frame(number, time.monotonic(), partial(lambda picture, scaling: Picture(picture), picture))
            if stop.wait(0.1):
                return


@pytest.fixture
def detector(monkeypatch) -> FaceDetector:
    monkeypatch.setattr(faces, "open_network", lambda say: DotDetector())
    return FaceDetector(print)


def test_the_nearest_face_of_a_picture_is_the_viewers(detector):
    near, far = head(0.2), head(0.9) + (150, 0, 900)
    found = detector.eyes_px(picture_of(far, near))
    np.testing.assert_allclose(found, pixels_of(near), atol=0.51)
    assert found[0, 0] > found[1, 0]  # the left eye first, at the right of the picture
    assert detector.eyes_px(picture_of()) is None


def test_a_lost_face_keeps_the_picture_and_is_said_once(detector):
    seen, said = picture_of(head(0)), []
    pictures = [*[seen] * 3, *[picture_of()] * 14, *[seen] * 3]
    tracker = EyeTracker(PictureEyes(Faces(*pictures), detector, CAMERA, said.append), PANEL, said.append)
    moved: list[np.ndarray] = []
    tracker.start()
    tracker.follow(moved.append, lambda: 0.0)
    until = time.monotonic() + 10
    while "eyes: they are seen again" not in said and time.monotonic() < until:
        time.sleep(0.01)
    tracker.stop()
    assert said == ["eyes: they are not seen; the picture stays for where they were", "eyes: they are seen again"]
    assert np.abs(moved[-1] - head(0)).max() < 15 and len(moved) < 20  # half a pixel of 55 between the eyes


def test_a_source_that_opens_late_and_fails_then_says_so(monkeypatch):
    said, is_late = [], threading.Event()

    class Late:
        name = "late"

        def samples(self, stop: threading.Event) -> Iterator[EyeSample]:
            is_late.wait(10)
            raise InputError("late: no such camera")
            yield

    monkeypatch.setattr(tracker_module, "_OPENING_S", 0.01)
    tracker = EyeTracker(Late(), PANEL, said.append)
    assert "none are seen yet by late" in tracker.start()[0]
    is_late.set()
    until = time.monotonic() + 10
    while not said and time.monotonic() < until:
        time.sleep(0.01)
    assert said == ["eyes: late: no such camera; the picture stays for where they were"]


def test_a_camera_without_pictures_is_let_go_at_the_end(detector):
    is_free = threading.Event()

    class Dark(Faces):
        def frames(self, stop: threading.Event) -> Iterator[Frame]:
            stop.wait(10)
            is_free.set()
            return iter(())

    stop, began = threading.Event(), time.monotonic()
    stop.set()
    assert list(PictureEyes(Dark(), detector, CAMERA, print).samples(stop)) == [] and is_free.wait(5)
    assert time.monotonic() - began < 8


def test_another_program_sends_positions():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    said: list[str] = []
    tracker = EyeTracker(open_eyes(f"udp:{port}", CAMERA, said.append), PANEL, said.append)
    assert "none are seen yet" in tracker.start()[0] and tracker.now()[:, 2].tolist() == [1000, 1000]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        for words in (b"hello", b"1 2 3", b"-21.5 5 500, 41.5 5 500\n"):
            sending.sendto(words, ("127.0.0.1", port))
    until = time.monotonic() + 10
    while tracker.now()[0, 2] != 500 and time.monotonic() < until:
        time.sleep(0.01)
    tracker.stop()
    np.testing.assert_allclose(tracker.now(), [[-21.5, 5, 500], [41.5, 5, 500]])
    assert len(said) == 1 and "got 'hello'; such words are left out" in said[0]


def test_positions_of_a_file_come_in_their_time(tmp_path):
    path = tmp_path / "path.txt"
    path.write_text("# a head\n5.0 -31 0 600 32 0 600\n5.1,-21,0,600,42,0,600\n")
    began = time.monotonic()
    samples: list[EyeSample] = list(FileEyes(path).samples(threading.Event()))
    assert [one.eyes_mm[0, 0] for one in samples] == [-31, -21] and 0.09 < time.monotonic() - began < 2
    assert samples[1].taken - samples[0].taken == pytest.approx(0.1)
    said: list[str] = []
    tracker = EyeTracker(FileEyes(path), PANEL, said.append)
    tracker.start()
    until = time.monotonic() + 10
    while not said and time.monotonic() < until:
        time.sleep(0.01)
    time.sleep(1.1)  # from then on they would be lost
    tracker.now()
    assert said == [f"eyes: {path} has ended; the picture stays for where they were"]


@pytest.mark.parametrize(
    "words, complaint",
    [
        ("udp:0", "expected udp:PORT"),
        ("udp:99999", "expected udp:PORT"),
        ("none.txt", "none.txt"),
        ("bad.txt", "bad.txt: line 1: expected x y z of the left eye"),
        ("behind.txt", "z above 0"),
        ("empty.csv", "got none"),
    ],
)
def test_sources_that_tell_nothing_are_refused(tmp_path, monkeypatch, words, complaint):
    monkeypatch.chdir(tmp_path)
    Path("bad.txt").write_text("0 1 2 3\n")
    Path("behind.txt").write_text("0 1 2 3 1 2 -3\n")
    Path("empty.csv").write_text("# nothing\n")
    with pytest.raises(InputError, match=complaint):
        open_eyes(words, CAMERA, print)


def test_weights_that_cannot_be_had_are_refused_with_the_way_out(monkeypatch, tmp_path):
    torch = pytest.importorskip("torch")
    pytest.importorskip("cv2", reason="faces are found by OpenCV")
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *_, **__: (_ for _ in ()).throw(OSError("offline")))
    with pytest.raises(InputError, match="could not be fetched .offline.: save https:.*yunet.*udp:PORT"):
        FaceDetector(print)
    (tmp_path / "checkpoints" / faces.WEIGHTS.path.name).write_bytes(b"no network")
    with pytest.raises(InputError, match="expected the weights of YuNet"):
        FaceDetector(print)
