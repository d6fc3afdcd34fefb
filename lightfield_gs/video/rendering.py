"""Render frames one after the other while earlier ones are written: panel images, quilts or 2D views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from torch import Tensor
from tqdm import tqdm

from lightfield_gs.base.arrays import Colour, to_bytes
from lightfield_gs.base.cuda import to_numpy
from lightfield_gs.base.options import QualityName, Views
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.encoding.quilt import quilt
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout
from lightfield_gs.panels.rig import Rig, reduced
from lightfield_gs.scene.gaussians import Gaussians

_EYE_WIDTH_PX = 1920
# What frames show: of these numbers, which increase, each with its Gaussians and its rig
FrameSource = Callable[[list[int]], Iterator[tuple[int, Gaussians, Rig]]]


@dataclass
class Drawing:
    """How a scene is drawn; see `encode`."""

    views: Views = "integer"
    background: Colour = (1.0, 1.0, 1.0)
    quality: QualityName = "exact"
    antialiased: bool = False
    view_filter: float = 0.0

    def of_views(self) -> dict[str, Any]:
        """What of it concerns views that are pictures by themselves."""
        return {name: getattr(self, name) for name in ("background", "antialiased", "view_filter")}


class NativeFrames:
    """The picture of the panel, uint8 [H, W, 3]: what `encode` draws by its method direct.

    is_one_scene: all frames show the same Gaussians, so that an Encoder keeps what does not change; on CUDA it may then
    round colours otherwise than `encode`. Else each frame is one call of `encode`: an Encoder would make a CUDA graph
    for every scene.
    """

    def __init__(self, panel: Panel, drawing: Drawing, is_one_scene: bool):
        self.size_px = panel.width_px, panel.height_px
        self._panel, self._drawing, self._is_one_scene = panel, drawing, is_one_scene
        self._encoder: Encoder | None = None

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """The picture, on the device of the Gaussians; on CUDA the next call may draw over it."""
        how = vars(self._drawing)
        if not self._is_one_scene:
            return encode(gaussians, self._panel, rig, **how)
        if self._encoder is None:
            self._encoder = Encoder(self._panel, rig, **how)
        self._encoder.rig = rig
        return self._encoder(gaussians)


class QuiltFrames:
    """All views as tiles of one picture, uint8 [H, W, 3].

    panel: whose picture the rig is for, of the views' aspect. layout: with its size.
    """

    def __init__(self, panel: Panel, drawing: Drawing, layout: QuiltLayout):
        self.size_px = layout.width_px or 0, layout.height_px or 0
        self._panel, self._drawing, self._layout = panel, drawing, layout

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """The quilt, on the device of the Gaussians."""
        tile, fan = self._layout.fitted(self._panel, rig)
        return quilt(gaussians, self._layout, fan, tile, **self._drawing.of_views())


class EyeFrames:
    """What one eye sees, of 1920 pixels in width at most and of even sides, as 2D video needs; uint8 [h, w, 3].

    sway: frames in which the eye goes from the middle to the right, to the left and back; None: it stays in the middle.
    """

    def __init__(self, panel: Panel, drawing: Drawing, sway: float | None = None):
        width = min(_EYE_WIDTH_PX, panel.width_px)
        height = round(panel.height_px * width / panel.width_px)
        self.size_px = max(2, width - width % 2), max(2, height - height % 2)
        self._panel, self._drawing, self._sway = panel, drawing, sway

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """The view, on the device of the Gaussians."""
        small, rig = reduced(self._panel, rig, self.size_px[0])
        small = replace(small, width_px=self.size_px[0], height_px=self.size_px[1])
        share = 0.0 if self._sway is None else math.sin(2 * math.pi * number / self._sway)
        side = -1 if self._panel.invert_views else 1
        place = small.views / 2 - side * share * (small.views - 1) / 2
        return to_bytes(render_views(gaussians, small, rig, [place], **self._drawing.of_views())[0])


class Draw(Protocol):
    """See video.pictures; size_px: (width, height) of a frame."""

    size_px: tuple[int, int]

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor: ...


class Sink(AbstractContextManager, Protocol):
    """A FrameFolder or a VideoFile. fetch: a frame on the host as `put` takes it."""

    missing: list[int]

    def fetch(self, image: Tensor) -> Any: ...
    def put(self, number: int, image: Any) -> None: ...


class NoFiles:
    """Frames that go nowhere, for measurements of the drawing alone."""

    def __init__(self, count: int):
        self.missing = list(range(count))

    def __enter__(self) -> NoFiles:
        return self

    def fetch(self, image: Tensor) -> np.ndarray:
        """The frame on the host."""
        return to_numpy(image)

    def put(self, number: int, image: np.ndarray) -> None:
        """Nothing is done with it."""

    def __exit__(self, *_: object) -> None:
        return None


@dataclass
class Timings:
    """How many frames were drawn, and the seconds that went into the scene of each, into drawing and copying it to the
    host, into waiting for what writes, at the end into what was not written yet, and in all."""

    frames: int = 0
    scene_s: float = 0.0
    draw_s: float = 0.0
    wait_s: float = 0.0
    finish_s: float = 0.0
    total_s: float = 0.0

    def words(self) -> str:
        """For example "8.0 frames/s: scene 0.10 s, draw 2.00 s, wait for the writers 1.50 s, finish 0.10 s"."""
        rate = self.frames / max(self.total_s, 1e-9)
        return (
            f"{rate:.3g} frames/s: scene {self.scene_s:.2f} s, draw {self.draw_s:.2f} s, "
            f"wait for the writers {self.wait_s:.2f} s, finish {self.finish_s:.2f} s"
        )


def make_video(shots: FrameSource, draw: Draw, sink: Sink, count: int, *, shown: bool = False) -> Timings:
    """Draws the frames that the sink misses, of `count`, and hands them over; returns what took how long.

    While the sink writes, the next frame is drawn. It is entered here, and left when all is written. shown: with a bar
    that tells frames a second and the time left, where there is a terminal. Raises InputError where the sink does.
    """
    made, began = Timings(), time.perf_counter()
    there, hidden = count - len(sink.missing), None if shown else True
    with sink, tqdm(total=count, initial=there, unit="frame", dynamic_ncols=True, disable=hidden) as bar:
        last = began
        for number, gaussians, rig in shots(sink.missing):
            at_scene = time.perf_counter()
            image = sink.fetch(draw(gaussians, rig, number))
            at_image = time.perf_counter()
            sink.put(number, image)
            made.frames += 1
            made.scene_s += at_scene - last
            made.draw_s += at_image - at_scene
            last = time.perf_counter()
            made.wait_s += last - at_image
            bar.update()
    made.total_s = time.perf_counter() - began
    made.finish_s = made.total_s - made.scene_s - made.draw_s - made.wait_s
    return made
