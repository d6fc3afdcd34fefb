"""Sources of the positions of a viewer's eyes: a camera or a film in which faces are found, a socket, or a file."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.file_kinds import POSITION_TEXTS
from lightfield_gs.io.text_files import read_text
from lightfield_gs.live.opening import open_source
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.sources import Source
from lightfield_gs.tracking.camera import TrackerCamera
from lightfield_gs.tracking.faces import FaceDetector
from lightfield_gs.tracking.motion import EyeSample
from lightfield_gs.video.decoding import Scaling

TRACK = "track"  # the first camera
_FPS = 30.0  # that a screen is asked for
_PICTURE_PIXELS = 640 * 360  # in which faces are found: 50 pixels between the eyes at 600 mm
_MOST_BYTES, _MOST_DATAGRAM = 1 << 24, 4096
_POLL_S = 0.2  # between two looks at whether it shall end
_FARTHEST_MM = 1e5
_LINE = "x y z of the left eye and x y z of the right eye, mm"


class EyeSource(Protocol):
    """A source of positions.

    Attributes:
        name: For messages.
    """

    name: str

    def samples(self, stop: threading.Event) -> Iterator[EyeSample]:
        """Yield positions as they come, until stop is set or the source ends; without eyes where it sees none.

        The first one comes as soon as the source is open. Raises InputError where it cannot be opened.
        """


def open_eyes(words: str, camera: TrackerCamera, say: Callable[[str], None]) -> EyeSource:
    """Return the source that the command line names. Raises InputError.

    Args:
        words: "track", udp:PORT, udp:ADDRESS:PORT, a text file, or what open_source takes.
        camera: The camera of pictures.
        say: Called with a line where something is to be said, from any thread.
    """
    if _is_socket(words):
        return SocketEyes(words, say)
    if not takes_pictures(words):
        return FileEyes(checked_path(words))
    try:
        pictures = open_source("camera:0" if words == TRACK else words, _FPS)
    except InputError as error:
        raise InputError(f"eyes: {error} (or {TRACK}, udp:PORT, or a .txt of positions)") from None
    return PictureEyes(pictures, FaceDetector(say), camera, say)


def takes_pictures(words: str) -> bool:
    """Return whether a source of the command line has pictures, in which faces are to be found."""
    return not _is_socket(words) and Path(words).suffix.lower() not in POSITION_TEXTS


def _is_socket(words: str) -> bool:
    return words.lower().startswith("udp:") and not words.lower().startswith("udp://")  # which is a stream


class PictureEyes:
    """Eyes of the nearest face in the pictures of a live source; a camera that is pulled out is opened again.

    Args:
        source: The pictures.
        detector: Finds faces.
        camera: The camera that took them.
        say: See open_eyes.
    """

    def __init__(self, source: Source, detector: FaceDetector, camera: TrackerCamera, say: Callable[[str], None]):
        self.name, self._source, self._detector, self._camera, self._say = source.name, source, detector, camera, say

    def samples(self, stop: threading.Event) -> Iterator[EyeSample]:
        """See EyeSource."""
        reader = Reader(self._source, lambda frame: None, self._say)
        reader.start()
        try:
            for frame in reader.newest.within(_POLL_S):
                if stop.is_set():
                    return
                if frame is None:
                    continue
                pixels = frame.picture(Scaling(_PICTURE_PIXELS)).pixels
                picture = np.ascontiguousarray(
                    pixels[..., :3] if pixels.shape[2] >= 3 else pixels[..., :1].repeat(3, 2)
                )
                eyes = self._detector.eyes_px(picture)
                size = picture.shape[1], picture.shape[0]
                yield EyeSample(frame.taken, None if eyes is None else self._camera.eyes_mm(eyes, size))
        finally:
            reader.stop()
        if reader.failed is not None:
            raise reader.failed


class SocketEyes:
    """Positions that another program sends: datagrams of UDP, each with a line of six numbers.

    Args:
        words: udp:PORT, for programs on this machine alone, or udp:ADDRESS:PORT, the address that is listened at.
        say: See open_eyes.
    """

    def __init__(self, words: str, say: Callable[[str], None]):
        found = re.fullmatch(r"(?i)udp:(?:(.+):)?(\d{1,5})", words)
        if found is None or not 0 < int(found[2]) < 65536:
            raise InputError(f"{words}: expected udp:PORT or udp:ADDRESS:PORT, as udp:5005")
        self.name, self._say, self._address = words, say, (found[1] or "127.0.0.1", int(found[2]))

    def samples(self, stop: threading.Event) -> Iterator[EyeSample]:
        """See EyeSource. An empty datagram tells that no eyes are seen; the first with other words is complained of."""
        is_told = False
        family = socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
        with socket.socket(family, socket.SOCK_DGRAM) as listening:
            try:
                listening.bind(self._address)
            except OSError as error:
                raise InputError(f"{self.name}: it cannot be listened at ({error.strerror or error})") from None
            listening.settimeout(_POLL_S)
            yield EyeSample(time.monotonic(), None)
            while not stop.is_set():
                try:
                    words = listening.recv(_MOST_DATAGRAM).decode("utf-8", "replace")
                except TimeoutError:
                    continue
                numbers = words.replace(",", " ").split()
                try:
                    eyes = positions(numbers) if numbers else None
                except InputError as error:
                    if not is_told:
                        self._say(f"eyes: {self.name}: {error}; such words are left out")
                    is_told, eyes = True, None
                yield EyeSample(time.monotonic(), eyes)


class FileEyes:
    """Positions in a text file, of a line each: seconds from the beginning, then six numbers; played once.

    Args:
        path: The file.
    """

    def __init__(self, path: Path):
        self.name = str(path)
        lines = read_text(path, _MOST_BYTES, "text of positions of eyes").splitlines()
        rows = [(number, line.replace(",", " ").split()) for number, line in enumerate(lines, 1)]
        self._rows: list[tuple[float, np.ndarray]] = []
        for number, words in rows:
            if words and not words[0].startswith("#"):
                with named(f"{path}: line {number}"):
                    self._rows.append((_seconds(words[0]), positions(words[1:])))
        if not self._rows:
            raise InputError(f"{path}: expected lines of seconds and {_LINE}; got none")

    def samples(self, stop: threading.Event) -> Iterator[EyeSample]:
        """See EyeSource."""
        began = time.monotonic() - self._rows[0][0]
        for seconds, eyes in self._rows:
            if stop.wait(max(0.0, began + seconds - time.monotonic())):
                return
            yield EyeSample(began + seconds, eyes)


def positions(words: list[str]) -> np.ndarray:
    """Return the positions [2, 3] that six words tell. Raises InputError."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.empty(0)
    if values.shape != (6,) or not (np.abs(values) <= _FARTHEST_MM).all():
        raise InputError(f"expected {_LINE}; got {' '.join(words)[:60]!r}")
    eyes = values.reshape(2, 3)
    if not (eyes[:, 2] > 0).all():
        raise InputError(f"expected eyes before the panel, z above 0; got z = {eyes[:, 2].min():g}")
    return eyes


def _seconds(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
    if not abs(value) < 1e9:
        raise InputError(f"expected seconds at the beginning of the line, got {word[:20]!r}")
    return value
