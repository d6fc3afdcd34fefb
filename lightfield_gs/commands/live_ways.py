"""The ways out of `lightfield-gs live`: the page, a window, a virtual camera and a recording."""

from __future__ import annotations

import threading
import webbrowser
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path

from lightfield_gs.app.options import PanelOptions, StereoOptions
from lightfield_gs.app.panel import BROWSER_OPENS, connected_position, where_to_show
from lightfield_gs.app.stereo import panel_of, refuse_files
from lightfield_gs.app.tracked_eyes import TrackedScreen
from lightfield_gs.base.cli_messages import say
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CodecName
from lightfield_gs.commands.options.serving import ServingOptions, serve
from lightfield_gs.io.stereo_names import stereo_paths
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.drawing import LiveRenderer
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Out
from lightfield_gs.live.page import PageOut
from lightfield_gs.live.recording import Recording
from lightfield_gs.live.virtual_camera import VirtualCamera, find_virtual_camera
from lightfield_gs.live.window import WindowOut
from lightfield_gs.show.display_browser import DisplayBrowser, find_browser
from lightfield_gs.show.page.server import Route
from lightfield_gs.show.window.native_window import NativeWindow
from lightfield_gs.video.rendering import FrameOptions, FrameRenderer, StereoRenderer, pair_size_px
from lightfield_gs.video.video_file import choose_codec

_CAMERA_EYE = 1280, 720  # pixels of an eye's picture: calls seldom send more
_WAIT_S = 0.5  # after which Ctrl-C is heeded on any system


@dataclass(frozen=True, slots=True)
class WayOptions:
    """Where the pictures go.

    Attributes:
        output: Of the recording. None: nothing is recorded.
        window: Whether a window shows them, in place of the page.
        virtual_camera: Path or name of the device that takes them, in place of the page.
        stereo: For two eyes, in place of a panel.
        serving: Of the page.
    """

    output: Path | None = None
    codec: CodecName | None = None
    window: bool = False
    virtual_camera: str | None = None
    stereo: StereoOptions = field(default_factory=StereoOptions)
    serving: ServingOptions = field(default_factory=ServingOptions)


class WaysOut:
    """The ways out of a run.

    Args:
        options: Where the pictures go.
        panel: That of the command.
        tracked: The screen of --eyes, in place of both. None: eyes are not tracked.
        fps: Of the recording.
        health: Counts.
        stack: Closes what is opened.
        say_now: Prints a line at once.

    Attributes:
        panel: For which scenes are framed: of the display, or of a screen of two eyes.
        screen: It, in words.
        outs: They take the pictures.
        hint: Words of the health line where nobody takes the pictures.
        output: The file of the recording.
        page: The page; None where a window or a virtual camera takes its place.

    Raises:
        InputError: Options exclude each other, or there is no such way here.
    """

    def __init__(
        self,
        options: WayOptions,
        panel: PanelOptions,
        tracked: TrackedScreen | None,
        fps: Fraction,
        health: Health,
        stack: ExitStack,
        say_now: Callable[[str], None],
    ):
        self._options = options = _settled(options)
        self._layout, self._stack = options.stereo.stereo, stack
        self.page: PageOut | None = None
        self._is_plain = tracked is not None and tracked.is_plain
        if tracked is None:
            self.panel, lines = panel_of(options.stereo, panel, "--stereo or --eyes")
        else:
            self.panel, lines = tracked.drawn_panel, tracked.messages
        if self._is_plain and options.window:
            raise InputError(
                "--window is of a display with lenses, and a plain screen has none: name the display by --panel, or "
                "leave it out"
            )
        say(*lines)
        self.size_px = self.panel.width_px, self.panel.height_px
        if self._layout is not None:
            self.size_px = pair_size_px(self.panel, self._layout)
        self.screen = f"panel {self.panel.name}" if self._layout is None else f"a screen of two eyes, {self._layout}"
        if self._is_plain:
            self.screen = "a plain screen"
        self._names_display = panel.panel is None and not self.fills_screen
        self.outs: list[Out] = []
        if options.virtual_camera is not None:
            path = find_virtual_camera(options.virtual_camera)
            camera = VirtualCamera(path, self.size_px, health)
            stack.callback(camera.close)
            self.outs.append(camera)
            width, height = self.size_px
            say(f"virtual camera: {path}, {width} x {height}, {self._layout} (another: --stereo, --eye-size)")
        self.hint = ""
        if options.window:
            self._run = self._open_window(health, say_now)
        elif options.virtual_camera is not None:
            self._run = _wait
        else:
            self.hint = " (is the page open?)"
            self._run = self._open_page(health)
        self._owners: Mapping[str, Route] = {}
        self._recording: Recording | None = None
        self.output = options.output
        if options.output is not None:
            self._recording = self._open_recording(options.output, fps, health)

    @property
    def fills_screen(self) -> bool:
        """Whether the page shows the picture as large as the screen, not pixel for pixel."""
        return self._layout is not None or self._is_plain

    def drawer(self, drawing: FrameOptions, detail: Detail) -> FrameRenderer:
        """Return what draws the pictures; detail: see LiveRenderer."""
        if self._layout is not None:
            return StereoRenderer(self.panel, drawing, self._layout)
        return LiveRenderer(self.panel, drawing, detail)

    def run(self, start: Callable[[Callable[[], None]], None], owners: Mapping[str, Route]) -> None:
        """Take pictures until the end, or Ctrl-C; in the main thread.

        Args:
            start: Called when pictures can be taken, with what ends this, from another thread.
            owners: Addresses of the owner's page, beside those of the display's page.
        """
        self._owners = owners
        if self._recording is not None:
            self._recording.begin()
            self._stack.callback(self._recording.end)
        try:
            self._run(start)
        except KeyboardInterrupt:
            print("\nended")

    def _open_recording(self, output: Path, fps: Fraction, health: Health) -> Recording:
        if self._layout is not None:
            self.output = output = stereo_paths(output, self._layout)[0]
        codec = choose_codec(output, "native" if self._layout is None else "stereo", self._options.codec)
        recording = Recording(output, self.size_px, fps, codec, self._layout, health)
        self.outs.append(recording)
        return recording

    def _open_window(self, health: Health, say_now: Callable[[str], None]) -> _Run:
        position = connected_position() if self._layout is None else None
        window = NativeWindow(self.size_px, position, say_now)
        self._stack.callback(window.close)
        if self._names_display:
            say(*where_to_show(self.panel, "the window opens there"))
        out = WindowOut(window, health)
        self.outs.append(out)

        def run(start: Callable[[Callable[[], None]], None]) -> None:
            window.open()
            is_over = threading.Event()
            start(is_over.set)
            out.run(is_over)

        return run

    def _open_page(self, health: Health) -> _Run:
        """Open the page, which a browser of its own shows on the display where that is found, else the usual one."""
        page = self.page = PageOut(self.panel, health, self.fills_screen)
        self.outs.append(page)
        serving = self._options.serving
        position = None if serving.no_open or self.fills_screen else connected_position()
        has_browser = position is not None and find_browser() is not None
        if self._names_display:
            say(*where_to_show(self.panel, BROWSER_OPENS if has_browser else None))
        browser = DisplayBrowser(position, self.size_px) if has_browser else None
        if browser is not None:
            self._stack.callback(browser.close)
        opened = webbrowser.open if browser is None else browser.open

        def run(start: Callable[[Callable[[], None]], None]) -> None:
            say("depth, focus, size and more are steered at the address below without its end, panel")
            serve(serving, {**self._owners, **page.routes()}, "/panel", opened, start)

        return run


_Run = Callable[[Callable[[Callable[[], None]], None]], None]  # see WaysOut.run


def _settled(options: WayOptions) -> WayOptions:
    """Return the options with what a virtual camera takes. Raises InputError where they exclude each other."""
    refuse_files(options.stereo.stereo, "a live picture")
    own = "--window" if options.window else "--virtual-camera"
    if (options.window or options.virtual_camera) and replace(options.serving, no_open=False) != ServingOptions():
        raise InputError(f"{own} takes the place of the page, of which --host and --port are; leave them out")
    if options.virtual_camera is None:
        return options
    stereo = options.stereo
    stereo = replace(stereo, stereo=stereo.stereo or "half-sbs", eye_size=stereo.eye_size or _CAMERA_EYE)
    return replace(options, stereo=stereo)


def _wait(start: Callable[[Callable[[], None]], None]) -> None:
    """Wait for the end."""
    is_over = threading.Event()
    start(is_over.set)
    print("Ctrl-C ends it", flush=True)
    while not is_over.wait(_WAIT_S):
        pass
