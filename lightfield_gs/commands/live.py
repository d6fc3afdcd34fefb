"""`lightfield-gs live`: a camera, the screen, a stream or a film on the panel while it happens."""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import torch

from lightfield_gs.app.options import AUTO, EyesOptions, LookOptions, PanelOptions, PhotoOptions, RenderOptions
from lightfield_gs.app.scene import check_photo_options
from lightfield_gs.app.tracked_eyes import TrackedScreen, refuse_eyes, tracked_screen
from lightfield_gs.app.video import DEFAULT_FPS
from lightfield_gs.base.cli_messages import as_options, capturable_streams, say, say_next, say_now
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import QualityName, Views
from lightfield_gs.commands.live_ways import WayOptions, WaysOut
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.tracking import open_tracker
from lightfield_gs.encoding.eyes import EyesDrawing
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.health import Health
from lightfield_gs.live.opening import open_source
from lightfield_gs.live.pipeline import Pipeline
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.steering import LiveStage, SteeredRenderer
from lightfield_gs.photo.side_by_side import is_rgbd_name
from lightfield_gs.show.page.stage import StagedScene
from lightfield_gs.tracking.tracker import EyeTracker
from lightfield_gs.video.rendering import EyesRenderer, FrameOptions, FrameRenderer
from lightfield_gs.webgpu.devices import choose_drawing_device

_MANY_FRAMES = 100  # for the choice of a device, whose start they outweigh
_LINE_S = 1.0  # between two lines on how it fares
# Options of a photo that a live picture cannot have, with what takes their place
_NOT_LIVE = {
    "mask": "a live picture has no mask in a file: use --remove-background",
    "map_orientation": "a live picture has no map in a file",
    "intrinsics": "the pictures may be taken smaller: give --fov",
}


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """A source, and how it is shown.

    Attributes:
        source: As `open_source` takes it.
        ways: Where it goes.
        eyes: That are tracked, for which two views take the place of the panel's.
        loop: Whether a film begins again.
        seconds: After which it ends. None: at Ctrl-C, or at the end of a film.
        fps: Frames a second that are to be held.
        pixels: Of a picture, at most. None: as many as hold the rate, and no more than the panel shows.
        network_px: To the shorter side of what the network for depths sees. None: as many as hold the rate.
        quality: Of the drawing. None: exact, or fast where that is too slow.
        remember: Whether what was seen behind things stays, while the camera stands still.
    """

    source: str
    panel: PanelOptions
    look: LookOptions
    photo: PhotoOptions
    render: RenderOptions
    ways: WayOptions
    loop: bool = False
    seconds: float | None = None
    fps: Fraction | None = None
    pixels: int | None = None
    network_px: int | None = None
    remember: bool = True
    views: Views = "integer"
    quality: QualityName | None = None
    device: str = "auto"
    eyes: EyesOptions = field(default_factory=EyesOptions)


def run(args: argparse.Namespace) -> None:
    """Show args.source until Ctrl-C. Raises InputError."""
    with capturable_streams(), ExitStack() as stack:
        _show(read_options(LiveOptions, args), stack)


def _show(options: LiveOptions, stack: ExitStack) -> None:
    _check(options)
    fps = options.fps or DEFAULT_FPS
    source = open_source(options.source, float(fps), options.loop)
    health, tracked = Health(), _tracked(options)
    ways = WaysOut(options.ways, options.panel, tracked, fps, health, stack, say_now)
    panel = ways.panel
    device = choose_drawing_device(options.device, panel.width_px * panel.height_px, _MANY_FRAMES)
    quality = "exact" if _has_two_eyes(options) else options.quality
    is_slow = device.torch == "cpu" and device.webgpu is None
    detail = Detail(float(fps), options.pixels, quality, options.network_px, is_slow)
    reader = Reader(source, health.has_taken, say_now, holds_film=True)
    taken = options.photo, options.render, options.look, panel, device.torch, detail, health
    scenes = LiveScenes(source, *taken, options.remember)
    reader.start()
    stack.callback(reader.stop)
    say_now(f"{source.name}: waiting for its first picture")
    try:
        with torch.inference_mode():
            scenes.settle(reader.first())
    except InputError as error:
        raise reader.failed or error from None
    if tracked is not None:
        scenes.rig = tracked.deepened(scenes.rig, options.look)
    how = scenes.drawn_as
    drawing = FrameOptions(
        options.views, how.background, detail.quality, how.antialiased, how.view_filter, device.webgpu
    )
    height, width = detail.size_px
    tracker, lines = (None, []) if tracked is None else open_tracker(options.eyes, tracked, say_now)
    if tracker is not None:
        stack.callback(tracker.stop)
    say(f"{source.name}: {width} x {height}, on {ways.screen}", *device.messages, *lines, *scenes.messages)
    health.take()  # the start is no part of how it fares
    end = _End(health, detail, options.seconds, ways.hint)
    opening = StagedScene(scenes.first[1], scenes.rig, source.name, how.background, how.antialiased, how.view_filter)
    drawer = _Drawer.of(opening, drawing, detail, ways, tracker)
    pipeline = Pipeline(reader, scenes, drawer.draw, ways.outs, health, end.now, drawer.state)
    began = time.monotonic()

    def start(end_showing: Callable[[], None]) -> None:
        if source.ends:
            scenes.begin_now()
        pipeline.start()
        reader.go_on()
        end.start(end_showing)

    try:
        ways.run(start, {} if drawer.stage is None else drawer.stage.routes())
    finally:
        end.now()
        pipeline.stop()
    seconds = time.monotonic() - began
    say(f"{health.drawn} frames in {seconds:.1f} s, of {health.taken} that came")
    if ways.output is not None and health.drawn:
        say_next("show", ways.output)


def _tracked(options: LiveOptions) -> TrackedScreen | None:
    """Return the screen of --eyes; None without. Raises InputError."""
    if options.eyes.eyes is None:
        refuse_eyes(options.eyes)
        return None
    if options.ways.virtual_camera is not None:
        raise InputError("--virtual-camera is for viewers elsewhere, whose eyes are not seen; leave out --eyes")
    return tracked_screen(options.eyes, options.ways.stereo.stereo, options.panel, options.render.view_filter)


@dataclass(frozen=True)
class _Drawer:
    """What draws the pictures, and what decides how.

    Attributes:
        draw: Draws.
        tracker: Of eyes. None: they are not tracked.
        stage: Of the owner's page. None: there is none.
    """

    draw: FrameRenderer
    tracker: EyeTracker | None
    stage: LiveStage | None

    @staticmethod
    def of(
        opening: StagedScene, options: FrameOptions, detail: Detail, ways: WaysOut, tracker: EyeTracker | None
    ) -> _Drawer:
        """Return it, with the scene by which the owner's page opens."""
        renderer: Callable[[FrameOptions], FrameRenderer] = lambda drawing: ways.drawer(drawing, detail)
        if tracker is not None:
            eyes, now = EyesDrawing(ways.panel, ways.fills_screen), tracker.now
            renderer = lambda drawing: EyesRenderer(eyes, ways.size_px, drawing, now)
        if (page := ways.page) is None:
            return _Drawer(renderer(options), tracker, None)
        stage = LiveStage(opening, ways.panel, lambda: page.newest()[1], options.device, ways.fills_screen)
        return _Drawer(SteeredRenderer(stage, options, renderer), tracker, stage)

    def state(self) -> object:
        """Return what a picture depends on beside its scene."""
        eyes = None if self.tracker is None else self.tracker.steady().tobytes()
        return eyes, None if self.stage is None else self.stage.resting()


def _has_two_eyes(options: LiveOptions) -> bool:
    ways = options.ways
    return bool(ways.stereo.stereo or ways.virtual_camera or options.eyes.eyes)


def _check(options: LiveOptions) -> None:
    """Raise InputError for options that a live picture cannot have."""
    photo = options.photo
    for name, way in _NOT_LIVE.items():
        if getattr(photo, name) is not None:
            raise InputError(as_options(f"{name}=: {way}; leave it out"))
    if options.network_px is not None and photo.depth != AUTO:
        raise InputError("--network-px is for the network of --depth auto; give --depth auto too, or leave it out")
    if photo.depth_file is not None:
        raise InputError(
            f"--depth {photo.depth_file}: a live picture has no depth map in a file; give --depth auto or flat, or "
            "--rgbd where the depths are a half of it"
        )
    has_pair = photo.stereo_in not in (None, "none")
    is_deep = photo.depth is not None or photo.rgbd is not None or has_pair or is_rgbd_name(Path(options.source))
    check_photo_options(photo, is_deep)
    if _has_two_eyes(options) and (options.views != "integer" or options.quality not in (None, "exact")):
        raise InputError("--views and --quality are of panels, and the picture is of two eyes; leave them out")
    if options.ways.output is not None:
        check_outputs((options.ways.output,), (options.source,))


class _End:
    """Says each second how it fares, and ends the serving after some seconds, or when it is told.

    Args:
        health: What is said.
        detail: Adapted to it.
        seconds: After which it ends. None: never.
        hint: See Span.line.
    """

    def __init__(self, health: Health, detail: Detail, seconds: float | None, hint: str):
        self._health, self._detail, self._seconds, self._hint = health, detail, seconds, hint
        self._is_over = threading.Event()

    def start(self, end_serving: Callable[[], None]) -> None:
        """Begin."""
        threading.Thread(target=self._run, args=(end_serving,), name="health", daemon=True).start()

    def now(self) -> None:
        """End the serving."""
        self._is_over.set()

    def _run(self, end_serving: Callable[[], None]) -> None:
        began = time.monotonic()
        while True:
            left = _LINE_S if self._seconds is None else min(_LINE_S, began + self._seconds - time.monotonic())
            if self._is_over.wait(max(0.0, left)) or left < _LINE_S:
                end_serving()
                return
            span = self._health.take()
            say_now(span.line(self._hint))
            for words in self._detail.adapt(span):
                say_now(words)
