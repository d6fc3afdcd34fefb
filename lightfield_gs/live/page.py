"""The way out to the panel's page in a browser."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.sources import Frame
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.page.routes import WAIT_S, panel_routes
from lightfield_gs.show.page.server import Route

_REMEMBERED = 8  # pictures, which slow readers may still be sent


class PageOut:
    """The picture of the panel's page: the newest alone.

    Args:
        panel: The panel, or a screen of two eyes.
        health: Counts.
        fills: See panel_routes.
    """

    def __init__(self, panel: Panel, health: Health, fills: bool = False):
        self._panel, self._health, self._fills, self._changed = panel, health, fills, threading.Condition()
        self._version, self._pixels = 0, np.zeros((panel.height_px, panel.width_px, 3), np.uint8)
        self._frames: deque[tuple[int, Frame]] = deque(maxlen=_REMEMBERED)

    def put(self, frame: Frame, drawn: Drawn) -> None:
        """See Out."""
        pixels = drawn.pixels
        with self._changed:
            self._version += 1
            self._pixels = pixels
            self._frames.append((self._version, frame))
            self._changed.notify_all()

    def routes(self) -> dict[str, Route]:
        """Return the addresses of the page."""
        return panel_routes(self._panel, self.newest, self._wait_for, self._fills, sent=self._sent)

    def newest(self) -> tuple[int, np.ndarray]:
        """Return the newest picture, uint8 [H, W, 3], and its number."""
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
