"""Where live pictures go: the panel's page, and a recording."""

from __future__ import annotations

import threading
from collections import deque
from fractions import Fraction
from pathlib import Path
from typing import Protocol

import numpy as np

from lightfield_gs.base.options import CodecName
from lightfield_gs.live.health import Health
from lightfield_gs.live.sources import Frame
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.page.routes import WAIT_S, panel_routes
from lightfield_gs.show.page.server import Route
from lightfield_gs.video.video_file import VideoFile

_REMEMBERED = 8  # pictures, which slow readers may still be sent


class Out(Protocol):
    """A way out."""

    def put(self, frame: Frame, pixels: np.ndarray) -> None:
        """Take the picture of the panel, uint8 [H, W, 3], that was made of a frame. Raises InputError."""


class PageOut:
    """The picture of the panel's page: the newest alone."""

    def __init__(self, panel: Panel, health: Health):
        self._panel, self._health, self._changed = panel, health, threading.Condition()
        self._version, self._pixels = 0, np.zeros((panel.height_px, panel.width_px, 3), np.uint8)
        self._frames: deque[tuple[int, Frame]] = deque(maxlen=_REMEMBERED)

    def put(self, frame: Frame, pixels: np.ndarray) -> None:
        """See Out."""
        with self._changed:
            self._version += 1
            self._pixels = pixels
            self._frames.append((self._version, frame))
            self._changed.notify_all()

    def routes(self) -> dict[str, Route]:
        """Return the addresses of the page."""
        routes = panel_routes(self._panel, self._now, self._wait_for, sent=self._sent)
        return {**routes, "/": routes["/panel"]}

    def _now(self) -> tuple[int, np.ndarray]:
        with self._changed:
            return self._version, self._pixels

    def _wait_for(self, after: int) -> int:
        """Return the version once it differs. The page asks again as soon as it shows one: until then it is busy."""
        with self._changed:
            if after >= 0:
                self._health.end("page")
            self._changed.wait_for(lambda: self._version != after, WAIT_S)
            if after >= 0:
                self._health.begin("page")
            return self._version

    def _sent(self, version: int) -> None:
        with self._changed:
            sent = [frame for number, frame in self._frames if number == version]
        for frame in sent:  # one, or none of a picture that a slow page had long ago
            self._health.has_sent(frame)


class Recording:
    """A video, each frame shown from when it was taken until the next.

    Args:
        path: The file.
        panel: The panel.
        fps: Steps of time a second: of frames that are nearer to each other, the first is kept.
        codec: See VideoFile.
        health: Counts the frames.
    """

    def __init__(self, path: Path, panel: Panel, fps: Fraction, codec: CodecName, health: Health):
        self._video = VideoFile(path, 0, (panel.width_px, panel.height_px), fps, codec)
        self._fps, self._health = fps, health
        self._start: float | None = None
        self._last = -1

    def begin(self) -> None:
        """Begin the file."""
        self._video.__enter__()

    def put(self, frame: Frame, pixels: np.ndarray) -> None:
        """See Out. Waits while the file's encoder is behind."""
        if self._start is None:
            self._start = frame.taken
        number = round((frame.taken - self._start) * self._fps)
        if number <= self._last:
            return
        with self._health.busy("recording"):
            self._video.put(number, pixels)
        self._last = number
        self._health.has_sent(frame)

    def end(self) -> None:
        """Finish the file; nothing is kept where there was no frame. Raises InputError where it cannot be written."""
        kind = None if self._last >= 0 else KeyboardInterrupt
        self._video.__exit__(kind, None, None)
