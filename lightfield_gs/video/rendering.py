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
from lightfield_gs.base.options import QualityName, StereoLayout, Views
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.encoding.eyes import EyesDrawing
from lightfield_gs.encoding.quilt import quilt
from lightfield_gs.encoding.stereo import join_eyes, render_eyes
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

_EYE_WIDTH_PX = 1920
# Yields number, Gaussians and rig of the frames of these increasing numbers
FrameSource = Callable[[list[int]], Iterator[tuple[int, Gaussians, Rig]]]


@dataclass
class FrameOptions:
    """Options of rendering a scene; see `encode`."""

    views: Views = "integer"
    background: Colour = (1.0, 1.0, 1.0)
    quality: QualityName = "exact"
    antialiased: bool = False
    view_filter: float = 0.0
    device: str | None = None

    def for_views(self) -> dict[str, Any]:
        """Return the options of views that are images by themselves."""
        return {name: getattr(self, name) for name in ("background", "antialiased", "view_filter", "device")}


class NativeRenderer:
    """Renders the image of the panel, uint8 [H, W, 3], as `encode` does by its method direct.

    Args:
        panel: the panel.
        options: of the rendering.
        is_one_scene: whether all frames show the same Gaussians. Then an Encoder keeps everything that does not
            change; on CUDA it may round colours differently from `encode`. Else each frame is one call of `encode`,
            since an Encoder would capture a CUDA graph for every scene.
    """

    def __init__(self, panel: Panel, options: FrameOptions, is_one_scene: bool):
        self.size_px = panel.width_px, panel.height_px
        self._panel, self._options, self._is_one_scene = panel, options, is_one_scene
        self._encoder: Encoder | None = None

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """Render on the device of the Gaussians; on CUDA the next call may write over the image."""
        how = vars(self._options)
        if not self._is_one_scene:
            return encode(gaussians, self._panel, rig, **how)
        if self._encoder is None:
            self._encoder = Encoder(self._panel, rig, **how)
        self._encoder.rig = rig
        return self._encoder(gaussians)


class QuiltRenderer:
    """Renders all views as tiles of one image, uint8 [H, W, 3].

    Args:
        panel: the panel that the rig is for, of the views' aspect.
        options: of the rendering.
        layout: with its size.
    """

    def __init__(self, panel: Panel, options: FrameOptions, layout: QuiltLayout):
        self.size_px = layout.width_px or 0, layout.height_px or 0
        self._panel, self._options, self._layout = panel, options, layout

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """Render the quilt on the device of the Gaussians."""
        tile, fan = self._layout.fitted(self._panel, rig)
        return quilt(gaussians, self._layout, fan, tile, **self._options.for_views())


class EyeRenderer:
    """Renders the view of one eye, uint8 [h, w, 3], of limited width and of even sides, as 2D video needs.

    Args:
        panel: the panel.
        options: of the rendering.
        sway: frames in which the eye moves from the middle to the right, to the left and back; None: no movement.
        most_px: width at most.
    """

    def __init__(self, panel: Panel, options: FrameOptions, sway: float | None = None, most_px: int = _EYE_WIDTH_PX):
        width = min(most_px, panel.width_px)
        height = round(panel.height_px * width / panel.width_px)
        self.size_px = max(2, width - width % 2), max(2, height - height % 2)
        self._panel, self._options, self._sway = panel, options, sway

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """Render the view on the device of the Gaussians."""
        small, rig = rig.reduced(self._panel, self.size_px[0])
        small = replace(small, width_px=self.size_px[0], height_px=self.size_px[1])
        swing = 0.0 if self._sway is None else math.sin(2 * math.pi * number / self._sway)
        side = -1 if self._panel.invert_views else 1
        view = small.views / 2 - side * swing * (small.views - 1) / 2
        return to_bytes(render_views(gaussians, small, rig, [view], **self._options.for_views())[0])


def pair_size_px(panel: Panel, layout: StereoLayout) -> tuple[int, int]:
    """Return width and height of the pictures of two eyes in one image; the panel is of a StereoScreen."""
    across, down = {"sbs": (2, 1), "tab": (1, 2)}.get(layout, (1, 1))
    return across * panel.width_px, down * panel.height_px


class StereoRenderer:
    """Renders the pictures of two eyes in one image, uint8.

    Args:
        panel: of a StereoScreen.
        options: of the rendering.
        layout: "sbs", "half-sbs", "tab" or "anaglyph".
    """

    def __init__(self, panel: Panel, options: FrameOptions, layout: StereoLayout):
        self.size_px = pair_size_px(panel, layout)
        self._panel, self._options, self._layout = panel, options, layout

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """Render both eyes on the device of the Gaussians."""
        return join_eyes(render_eyes(gaussians, self._panel, rig, **self._options.for_views()), self._layout)


class EyesRenderer:
    """Renders the picture of a screen for tracked eyes, uint8 [H, W, 3].

    Args:
        drawing: of the screen.
        size_px: width and height of the screen.
        options: of the rendering; there are no views to choose or to average.
        eyes_mm: returns the eyes [2, 3], see encode_eyes, as they are so many seconds later.
    """

    def __init__(
        self,
        drawing: EyesDrawing,
        size_px: tuple[int, int],
        options: FrameOptions,
        eyes_mm: Callable[[float], np.ndarray],
    ):
        self.size_px = size_px
        how = dict(background=options.background, antialiased=options.antialiased, device=options.device)
        self._draw, self._how, self._eyes_mm = drawing, how, eyes_mm

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """Render on the device of the Gaussians, for where the eyes are when it is finished."""
        return self._draw(gaussians, rig, self._eyes_mm(self._draw.seconds), **self._how)


class FrameRenderer(Protocol):
    """Renders a frame.

    Attributes:
        size_px: Width and height.
    """

    size_px: tuple[int, int]

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor: ...


class Sink(AbstractContextManager, Protocol):
    """A FrameFolder or a VideoFile."""

    missing: list[int]

    def fetch(self, image: Tensor) -> Any: ...
    def put(self, number: int, image: Any) -> None: ...


@dataclass
class Timings:
    """Number of rendered frames, and seconds.

    Attributes:
        frames: rendered.
        scene_s: spent on the scene of each frame.
        draw_s: rendering, and copying to the host.
        wait_s: waiting for the writers.
        finish_s: finishing files at the end.
        total_s: in all.
    """

    frames: int = 0
    scene_s: float = 0.0
    draw_s: float = 0.0
    wait_s: float = 0.0
    finish_s: float = 0.0
    total_s: float = 0.0

    def words(self) -> str:
        """Return a line such as "8.0 frames/s: scene 0.10 s, draw 2.00 s, wait for the writers 1.50 s, ..."."""
        rate = self.frames / max(self.total_s, 1e-9)
        return (
            f"{rate:.3g} frames/s: scene {self.scene_s:.2f} s, draw {self.draw_s:.2f} s, "
            f"wait for the writers {self.wait_s:.2f} s, finish {self.finish_s:.2f} s"
        )


def render_frames(source: FrameSource, draw: FrameRenderer, sink: Sink, count: int, *, shown: bool = False) -> Timings:
    """Render the missing frames of a sink, each while earlier ones are written.

    Args:
        source: yields number, Gaussians and rig of these frames, whose numbers increase.
        draw: renders a frame.
        sink: takes the frames; it is entered here, and left when all are written.
        count: of all frames.
        shown: whether to show a progress bar, on a terminal.

    Returns:
        The time of each stage.

    Raises:
        InputError: where the sink does.
    """
    timings, began = Timings(), time.perf_counter()
    there, hidden = count - len(sink.missing), None if shown else True
    with sink, tqdm(total=count, initial=there, unit="frame", dynamic_ncols=True, disable=hidden) as bar:
        last = began
        for number, gaussians, rig in source(sink.missing):
            at_scene = time.perf_counter()
            image = sink.fetch(draw(gaussians, rig, number))
            at_image = time.perf_counter()
            sink.put(number, image)
            timings.frames += 1
            timings.scene_s += at_scene - last
            timings.draw_s += at_image - at_scene
            last = time.perf_counter()
            timings.wait_s += last - at_image
            bar.update()
    timings.total_s = time.perf_counter() - began
    timings.finish_s = timings.total_s - timings.scene_s - timings.draw_s - timings.wait_s
    return timings
