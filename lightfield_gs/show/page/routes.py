"""The routes of the panel's own page."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

import numpy as np

from lightfield_gs.io.png import stored_png
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.page.server import Answer, Query, Reservation, Route, as_json, number, page_file, text

WAIT_S = 10.0  # for another picture of the panel, before the page asks again


def panel_routes(
    panel: Panel,
    native: Callable[[], tuple[int, np.ndarray]],
    version: Callable[[int], int],
    fills: bool = False,
    controls: Callable[[], dict[str, object]] | None = None,
    sent: Callable[[int], None] | None = None,
) -> dict[str, Route]:
    """Return the addresses of the panel's own page.

    Args:
        native: Returns the current picture, uint8 [H, W, 3], and its version.
        version: Returns the picture's version once it differs from the given number, or after a while.
        fills: Whether the picture fills the screen, as of two eyes, instead of being shown pixel for pixel.
        controls: Returns those of the picture, for browsers that draw it themselves. None: they cannot.
        sent: Called with the version of a picture whose last byte is on its way to a browser.
    """

    def drawn_by() -> dict[str, object]:
        return {} if controls is None else {"controls": controls()}

    def state(query: Query) -> Answer:
        after = int(number(query, "after", -1, 1 << 53))
        size = {"width_px": panel.width_px, "height_px": panel.height_px}
        return as_json({"name": panel.name, **size, "version": version(after), "fills": fills, **drawn_by()})

    packed = _Packed(native, sent)
    return {
        "/panel": page_file("panel.html"),
        "/panel.css": page_file("panel.css"),
        "/panel.js": page_file("panel.js"),
        "/display.js": page_file("display.js"),
        "/pixel_word.js": page_file("pixel_word.js"),
        "/panel.json": Route(state),
        "/panel.png": Route(
            lambda query: packed.answer(version(-1)), place=lambda query: Reservation(True, version(-1))
        ),
        "/favicon.ico": Route(lambda query: text("", 204)),
    }


class _Packed:
    """The panel's picture as a PNG, packed once for all who read it.

    Args:
        native: See panel_routes.
        sent: See there.
    """

    def __init__(self, native: Callable[[], tuple[int, np.ndarray]], sent: Callable[[int], None] | None):
        self._native, self._sent, self._turn = native, sent, threading.Lock()
        self._version, self._answer = -1, text("")

    def answer(self, version: int) -> Answer:
        """Return the picture of this version, or of a later one."""
        with self._turn:
            if self._version != version:
                self._version, pixels = self._native()
                sent = None if self._sent is None else partial(self._sent, self._version)
                numbered = {"X-Version": str(self._version)}
                self._answer = Answer(stored_png(pixels), "image/png", headers=numbered, sent=sent)
            return self._answer


def shown_routes(panel: Panel, pixels: np.ndarray, fills: bool = False) -> dict[str, Route]:
    """Return the routes of `lightfield-gs show`: the panel's page for one picture, uint8 [H, W, 3].

    Args:
        fills: See panel_routes.
    """
    never = threading.Event()

    def version(after: int) -> int:
        if after == 1:
            never.wait(WAIT_S)
        return 1

    routes = panel_routes(panel, lambda: (1, pixels), version, fills)
    return {**routes, "/": routes["/panel"]}
