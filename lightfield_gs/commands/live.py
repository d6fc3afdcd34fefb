"""`lightfield-gs live`: a camera, the screen, a stream or a film on the panel while it happens."""

from __future__ import annotations

import argparse
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch

from lightfield_gs.app.options import EyesOptions, LookOptions, PanelOptions, PhotoOptions, RenderOptions
from lightfield_gs.app.panel import BROWSER_OPENS, connected_position, load_panel, where_to_show
from lightfield_gs.app.scene import check_photo_options
from lightfield_gs.app.tracked_eyes import TRACKER, TrackedScreen, refuse_eyes, tracked_screen
from lightfield_gs.app.video import DEFAULT_FPS
from lightfield_gs.base.cli_messages import as_options, capturable_streams, say, say_next, say_now
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CodecName, QualityName, Views
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.options.serving import ServingOptions, serve
from lightfield_gs.commands.tracking import open_tracker
from lightfield_gs.encoding.eyes import EyesDrawing
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Out
from lightfield_gs.live.page import PageOut
from lightfield_gs.live.pipeline import Drawing, Pipeline
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.recording import Recording
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.sources import open_source
from lightfield_gs.live.steering import LiveStage, SteeredRenderer
from lightfield_gs.live.window import WindowOut
from lightfield_gs.panels.panel import Panel
from lightfield_gs.photo.side_by_side import is_rgbd_name
from lightfield_gs.show.display_browser import DisplayBrowser, find_browser
from lightfield_gs.show.page.server import Route
from lightfield_gs.show.page.stage import StagedScene
from lightfield_gs.show.window.native_window import NativeWindow
from lightfield_gs.video.rendering import EyesRenderer, FrameOptions, FrameRenderer, NativeRenderer
from lightfield_gs.video.video_file import choose_codec
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
        eyes: That are tracked, for which two views take the place of the panel's.
        window: Whether a window shows it, in place of the page.
        output: Of the recording. None: nothing is recorded.
        loop: Whether a film begins again.
        seconds: After which it ends. None: at Ctrl-C, or at the end of a film.
        fps: Frames a second that are to be held.
        pixels: Of a picture, at most. None: as many as hold the rate.
    """

    source: str
    panel: PanelOptions
    look: LookOptions
    photo: PhotoOptions
    render: RenderOptions
    serving: ServingOptions
    window: bool = False
    output: Path | None = None
    codec: CodecName | None = None
    loop: bool = False
    seconds: float | None = None
    fps: Fraction | None = None
    pixels: int | None = None
    views: Views = "integer"
    quality: QualityName = "exact"
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
    tracked = None
    if options.eyes.eyes is not None:
        tracked = tracked_screen(options.eyes, options.panel, options.render.view_filter)
    panel = load_panel(options.panel) if tracked is None else tracked.panel
    device = choose_drawing_device(options.device, panel.width_px * panel.height_px, _MANY_FRAMES)
    health, detail = Health(), Detail(float(fps), options.pixels)
    is_plain = tracked is not None and tracked.is_plain
    if options.window and is_plain:
        raise InputError("--window is of a display with lenses, and none was found; give --panel, or leave it out")
    front = (_window if options.window else _page)(panel, options, health, stack, is_plain)
    outs: list[Out] = [front.out]
    recording = None
    if options.output is not None:
        codec = choose_codec(options.output, "native", options.codec)
        recording = Recording(options.output, panel, fps, codec, health)
        outs.append(recording)
    reader = Reader(source, health.has_taken, say_now)
    scenes = LiveScenes(source, options.photo, options.render, options.look, panel, device.torch, detail, health)
    reader.start()
    stack.callback(reader.stop)
    say_now(f"{source.name}: waiting for its first picture")
    try:
        with torch.inference_mode():
            scenes.settle(iter(reader.newest))
    except InputError as error:
        raise reader.failed or error from None
    how = scenes.drawn_as
    drawing = FrameOptions(
        options.views, how.background, options.quality, how.antialiased, how.view_filter, device.webgpu
    )
    height, width = detail.size_px
    renderer, lines = _renderer(options, panel, tracked, stack)
    where = "a plain screen" if is_plain else f"panel {panel.name}"
    say(f"{source.name}: {width} x {height}, on {where}", *device.messages, *lines, *scenes.messages)
    health.take()  # the start is no part of how it fares
    end = _End(health, detail, options.seconds, front.hint)
    draw, stage = renderer(drawing), None
    if front.newest is not None:
        how_seen = how.background, how.antialiased, how.view_filter
        scene = StagedScene(scenes.first, scenes.rig, source.name, *how_seen)
        stage = LiveStage(scene, panel, front.newest, options.quality, is_plain, device.webgpu)
        draw = SteeredRenderer(stage, drawing, renderer)
    drawings = [Drawing(draw, scenes.rig, outs)]
    pipeline = Pipeline(reader, scenes, drawings, health, end.now)
    if recording is not None:
        recording.begin()
        stack.callback(recording.end)
    began = time.monotonic()

    def start(end_front: Callable[[], None]) -> None:
        pipeline.start()
        end.start(end_front)

    try:
        front.run(start, {} if stage is None else stage.routes())
    finally:
        end.now()
        pipeline.stop()
    seconds = time.monotonic() - began
    say(f"{health.drawn} frames in {seconds:.1f} s, of {health.taken} that came")
    if options.output is not None and health.drawn:
        say_next("show", options.output)


def _check(options: LiveOptions) -> None:
    """Raise InputError for options that a live picture cannot have."""
    photo = options.photo
    for name, way in _NOT_LIVE.items():
        if getattr(photo, name) is not None:
            raise InputError(as_options(f"{name}=: {way}; leave it out"))
    if photo.depth_file is not None:
        raise InputError(
            f"--depth {photo.depth_file}: a live picture has no depth map in a file; give --depth auto or flat, or "
            "--rgbd where the depths are a half of it"
        )
    has_pair = photo.stereo_in not in (None, "none")
    is_deep = photo.depth is not None or photo.rgbd is not None or has_pair or is_rgbd_name(Path(options.source))
    check_photo_options(photo, is_deep)
    if options.window and replace(options.serving, no_open=False) != ServingOptions():
        raise InputError("--window takes the place of the page, of which --host and --port are; leave them out")
    if options.eyes.eyes is None:
        refuse_eyes(options.eyes, (*TRACKER, "eye_distance", "screen_size"))
    elif (options.views, options.quality) != ("integer", "exact"):
        raise InputError("--views and --quality are of the panel's views, and --eyes draws two exactly; leave them out")
    if options.output is not None:
        check_outputs((options.output,), (options.source,))


_Start = Callable[[Callable[[], None]], None]  # takes what ends


@dataclass(frozen=True)
class _Front:
    """What shows the picture to who sits here, and what the main thread does meanwhile.

    Attributes:
        out: Takes the pictures.
        hint: Words of the health line where nobody takes the pictures.
        run: Calls its argument with what ends it, from any thread; returns at the end, or at Ctrl-C. It takes the
            addresses of the owner's page, too.
        newest: Returns the newest picture for the owner's page. None: there is no page.
    """

    out: Out
    hint: str
    run: Callable[[_Start, Mapping[str, Route]], None]
    newest: Callable[[], np.ndarray] | None = None


def _window(panel: Panel, options: LiveOptions, health: Health, stack: ExitStack, is_plain: bool) -> _Front:
    """Return the window. Raises InputError."""
    position = connected_position()
    window = NativeWindow((panel.width_px, panel.height_px), position, say_now)
    stack.callback(window.close)
    if options.panel.panel is None:
        say(*where_to_show(panel, "the window opens there"))
    out, is_over = WindowOut(window, health), threading.Event()

    def run(start: _Start, routes: Mapping[str, Route]) -> None:
        window.open()
        start(is_over.set)
        try:
            out.run(is_over)
        except KeyboardInterrupt:
            print("\nended")

    return _Front(out, "", run)


def _page(panel: Panel, options: LiveOptions, health: Health, stack: ExitStack, is_plain: bool) -> _Front:
    """Return the page, which a browser of its own shows on the display where that is found, else the usual one."""
    page = PageOut(panel, health, is_plain)
    position = None if options.serving.no_open or is_plain else connected_position()
    has_browser = position is not None and find_browser() is not None
    if options.panel.panel is None and not is_plain:
        say(*where_to_show(panel, BROWSER_OPENS if has_browser else None))
    browser = DisplayBrowser(position, (panel.width_px, panel.height_px)) if has_browser else None
    if browser is not None:
        stack.callback(browser.close)
    opened = webbrowser.open if browser is None else browser.open

    def run(start: _Start, routes: Mapping[str, Route]) -> None:
        say("the page without /panel at its end has depth, focus, size and more, for the pictures that follow")
        serve(options.serving, {**routes, **page.routes()}, "/panel", opened, start)

    return _Front(page, " (is the page open?)", run, lambda: page.newest()[1])


def _renderer(
    options: LiveOptions, panel: Panel, tracked: TrackedScreen | None, stack: ExitStack
) -> tuple[Callable[[FrameOptions], FrameRenderer], list[str]]:
    """Return what makes the renderer of the panel's picture, and lines on tracked eyes. Raises InputError."""
    if tracked is None:
        return lambda drawing: NativeRenderer(panel, drawing, False), []
    tracker, lines = open_tracker(options.eyes, tracked, say_now)
    stack.callback(tracker.stop)
    eyes, size = EyesDrawing(panel, tracked.is_plain), (panel.width_px, panel.height_px)
    return lambda drawing: EyesRenderer(eyes, size, drawing, tracker.now), [*tracked.messages, *lines]


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
            if (words := self._detail.adapt(span)) is not None:
                say_now(words)
