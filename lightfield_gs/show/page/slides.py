"""The routes of `lightfield-gs show`: a page that shows pictures and films in turn, and their data."""

from __future__ import annotations

import itertools
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from queue import Full, Queue
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.weave_geometry import Fan, find_window
from lightfield_gs.io.png import stored_png
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.page.server import (
    Answer,
    Query,
    Reservation,
    Route,
    as_json,
    file_route,
    number,
    page_file,
    text,
)
from lightfield_gs.show.playlist import Playlist, Slide

_MOST_PACKED = 3  # pictures that are kept: the one that is shown, and its neighbours
_AHEAD = 3  # frames that are read before they are asked for
_MOST_READERS = 2  # of films at a time


@dataclass(frozen=True, slots=True)
class SlideOptions:
    """How slides follow each other.

    Attributes:
        seconds: Of a picture; 0: until a key is pressed.
        fade: Seconds in which one goes over into the next.
        loop: Whether the first follows the last.
        shuffle: Whether the order is by chance.
    """

    seconds: float = 10.0
    fade: float = 0.5
    loop: bool = True
    shuffle: bool = False


@dataclass(frozen=True, slots=True)
class SlidePixels:
    """What reads slides.

    Attributes:
        picture: Returns the picture of a slide as the screen takes it, uint8 [H, W, 3].
        frames: Yields those of a film of native frames, likewise.
    """

    picture: Callable[[Slide], np.ndarray]
    frames: Callable[[Slide], Iterator[np.ndarray]]


def slide_routes(
    playlist: Playlist, options: SlideOptions, pixels: SlidePixels, seen: Callable[[], object] = lambda: None
) -> dict[str, Route]:
    """Return the addresses of the page.

    Args:
        playlist: The slides and their screen.
        options: How they follow each other.
        pixels: What reads them.
        seen: Called whenever the page shows that it is alive.
    """
    packed, readers, run = (
        _PackedSlides(playlist, pixels.picture),
        _Readers(playlist, pixels.frames),
        secrets.token_hex(8),
    )
    panel = playlist.panel

    def state(query: Query) -> Answer:
        seen()
        size = {"name": panel.name, "width_px": panel.width_px, "height_px": panel.height_px}
        how = {"seconds": options.seconds, "fade": options.fade, "loop": options.loop, "shuffle": options.shuffle}
        slides = [_described(slide, playlist) for slide in playlist.slides]
        return as_json({"run": run, "panel": {**size, "fills": playlist.layout is not None}, **how, "slides": slides})

    def index(query: Query) -> int:
        return round(number(query, "n", 0, len(playlist.slides) - 1))

    def film(query: Query) -> Path:
        slide = playlist.slides[index(query)]
        if not slide.is_film or slide.is_native:
            raise InputError("n must be a film that the browser plays")
        return slide.path

    def view_map(query: Query) -> Answer:
        return Answer(_view_map(panel), "application/octet-stream")

    names = ("panel.css", "slides.css", "slides.js", "films.js", "display.js", "pixel_word.js")
    return {
        "/": page_file("slides.html"),
        **{f"/{name}": page_file(name) for name in names},
        "/slides.json": Route(state),
        "/slide.png": Route(lambda query: packed.answer(index(query)), place=lambda q: Reservation(True, index(q))),
        "/film": file_route(film),
        "/frame.rgb": Route(lambda query: readers.answer(index(query), query), place=lambda q: Reservation(True)),
        "/view_map.bin": Route(view_map, place=lambda query: Reservation(True, "view_map.bin")),
        "/favicon.ico": Route(lambda query: text("", 204)),
    }


def _described(slide: Slide, playlist: Playlist) -> dict[str, Any]:
    """Return what the page knows of a slide."""
    if not slide.is_film:
        return {"kind": "picture", "name": slide.path.name}
    if slide.quilt is not None:
        return {"kind": "quilt", "name": slide.path.name, **_weaving(slide, playlist.panel)}
    if slide.pair is not None:
        way = {"from": slide.pair.kind.removeprefix("half-"), "swapped": slide.pair.is_swapped, "to": playlist.layout}
        return {"kind": "eyes", "name": slide.path.name, **way}
    return {"kind": "frames", "name": slide.path.name, "fps": float(slide.fps or 30), "frames": slide.frames}


def _weaving(slide: Slide, panel: Panel) -> dict[str, Any]:
    """Return how the browser weaves a film of quilts, as `weave` does: the place of each view, and what is seen."""
    quilt = slide.quilt
    assert quilt is not None
    shape = round(1000 * quilt.aspect), 1000  # of a view as it is seen
    window = find_window(panel, shape, quilt.aspect, "cover", (0.0, 0.0, 0.0, 0.0), 0.0)
    places = Fan(panel, quilt.views, False, None, 1.0).places()
    return {
        "columns": quilt.columns,
        "rows": quilt.rows,
        "places": [round(float(place), 6) for place in places],
        "window": [window.left, window.top, window.width, window.height],
    }


def _view_map(panel: Panel) -> bytes:
    """Return the view of each sub-pixel [H, W, 3], in one byte where that is enough, else in two, the low one first."""
    views = panel.view_map()
    return views.astype(np.uint8 if panel.views <= 256 else np.dtype("<u2")).tobytes()


class _PackedSlides:
    """Pictures as PNG: each is packed once, and a few are kept."""

    def __init__(self, playlist: Playlist, picture: Callable[[Slide], np.ndarray]):
        self._playlist, self._picture, self._turn = playlist, picture, threading.Lock()
        self._kept: OrderedDict[int, Answer] = OrderedDict()

    def answer(self, index: int) -> Answer:
        with self._turn:
            if index not in self._kept:
                slide = self._playlist.slides[index]
                if slide.is_film:
                    raise InputError("n must be a picture")
                pixels = self._picture(slide)
                self._kept[index] = Answer(stored_png(pixels), "image/png")
            self._kept.move_to_end(index)
            while len(self._kept) > _MOST_PACKED:
                self._kept.popitem(last=False)
            return self._kept[index]


class _Reader:
    """The frames of a film one after the other, read by a thread a little before they are asked for."""

    def __init__(self, frames: Iterator[np.ndarray], name: str, panel: Panel):
        self._given, self._name, self._panel = frames, name, panel
        self._queue: Queue[np.ndarray | InputError | None] = Queue(_AHEAD)
        self._is_closed = threading.Event()
        self.next = 0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for frame in itertools.chain(self._frames(), [None]):
            while not self._is_closed.is_set():
                try:
                    self._queue.put(frame, timeout=1)
                    break
                except Full:
                    continue
            if self._is_closed.is_set():
                return

    def _frames(self) -> Iterator[np.ndarray | InputError]:
        try:
            for frame in self._given:
                if frame.shape[:2] != (self._panel.height_px, self._panel.width_px):
                    raise InputError(f"{self._name}: its frame has {frame.shape[1]} x {frame.shape[0]} pixels")
                yield frame
        except InputError as error:
            yield error

    def take(self) -> np.ndarray | None:
        """Return the next frame; None at the end. Raises InputError."""
        frame = self._queue.get()
        if isinstance(frame, InputError):
            raise frame
        self.next += 1
        return frame

    def close(self) -> None:
        self._is_closed.set()


class _Readers:
    """The readers of the pages: each page reads for itself, and few at a time."""

    def __init__(self, playlist: Playlist, frames: Callable[[Slide], Iterator[np.ndarray]]):
        self._playlist, self._frames, self._turn = playlist, frames, threading.Lock()
        self._readers: OrderedDict[tuple[int, str], _Reader] = OrderedDict()

    def answer(self, index: int, query: Query) -> Answer:
        """Return the frame `at` of a film, bytes of RGB; nothing after its end."""
        at, slide = round(number(query, "at", 0, 1 << 31)), self._playlist.slides[index]
        if not slide.is_film or not slide.is_native:
            raise InputError("n must be a film of native frames")
        with self._turn:
            key = index, query.get("who", "")[:40]
            if key not in self._readers or self._readers[key].next > at:
                if key in self._readers:
                    self._readers.pop(key).close()
                self._readers[key] = _Reader(self._frames(slide), str(slide.path), self._playlist.panel)
            reader = self._readers[key]
            self._readers.move_to_end(key)
            while len(self._readers) > _MOST_READERS:
                self._readers.popitem(last=False)[1].close()
            frame = reader.take()
            while frame is not None and reader.next <= at:
                frame = reader.take()
        body = b"" if frame is None else np.ascontiguousarray(frame).tobytes()
        return Answer(body, "application/octet-stream")
