"""`lightfield-gs view`: a page in the browser that shows scenes as the panel would, and steers them."""

from __future__ import annotations

import argparse
import time
import webbrowser
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import torch

from lightfield_gs.app.cameras import read_camera
from lightfield_gs.app.openable import OPENED_SUFFIXES, depth_map_beside, photos_and_scenes
from lightfield_gs.app.options import (
    CameraOptions,
    EyesOptions,
    LookOptions,
    PanelOptions,
    PhotoOptions,
    RenderOptions,
    SceneOptions,
    StereoOptions,
)
from lightfield_gs.app.panel import connected_position
from lightfield_gs.app.scene import check_scene_options, load_framed
from lightfield_gs.app.scene_film import frame_scenes
from lightfield_gs.app.stereo import panel_of, refuse_files
from lightfield_gs.app.tracked_eyes import TrackedScreen, refuse_eyes, tracked_screen
from lightfield_gs.app.video import DEFAULT_FPS
from lightfield_gs.base.cli_messages import Stopwatch, note, say, say_now
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.arguments.view import add_arguments
from lightfield_gs.commands.options.parser import Parser, read_options
from lightfield_gs.commands.options.serving import ServingOptions, serve
from lightfield_gs.commands.tracking import open_tracker
from lightfield_gs.commands.view_command import ShownPicture
from lightfield_gs.io.atomic import scratch_folder
from lightfield_gs.io.scenes.files import is_scene_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.display_browser import DisplayBrowser, find_browser
from lightfield_gs.show.page.exports import exports
from lightfield_gs.show.page.gallery import Gallery
from lightfield_gs.show.page.looks import LookStore, looks_path
from lightfield_gs.show.page.stage import Controls, Film, Stage, StagedScene
from lightfield_gs.show.page.steering import steering_routes
from lightfield_gs.show.page.stereo_stage import StereoStage
from lightfield_gs.show.page.tracked_stage import TrackedStage
from lightfield_gs.tracking.tracker import EyeTracker
from lightfield_gs.video.scene_sequence import SceneSequence, find_scene_sequence
from lightfield_gs.webgpu.devices import choose_drawing_device

_MANY_FRAMES = 100  # for the choice of a device, whose start they outweigh
# Options that hold for photos that are dropped on the page, too: the others are of the input
_GENERAL = {"panel", "device_serial", "viewing_distance", "antialiased", "view_filter", "background", "device"}
_GENERAL |= {"checkpoint", "depth_model", "detail", "detail_budget", "remove_background", "clean_edges"}


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """A scene that a page shows, or a folder of them.

    Attributes:
        fps: of scenes in a row.
        device: Device that draws the scene.
        stereo: for a screen of two eyes, in place of a panel.
        eyes: that are tracked, for which two views take the place of the panel's.
        stats: whether to print the times of the stages.
        words: the words of the command line after `view`.
    """

    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    serving: ServingOptions
    fps: Fraction | None = None
    device: str = "auto"
    stereo: StereoOptions = field(default_factory=StereoOptions)
    eyes: EyesOptions = field(default_factory=EyesOptions)
    stats: bool = False
    words: tuple[str, ...] = ()

    def of(self, path: Path, is_dropped: bool) -> ViewOptions:
        """Return the options by which a picture opens: a dropped one without those that are the input's own.

        Photos of a folder, and dropped ones, take the depth maps beside them, as in a batch.
        """
        if path == self.scene.input:
            return self
        photo = self.scene.photo
        if is_dropped:
            fresh = PhotoOptions(**{name: getattr(photo, name) for name in PhotoOptions.__slots__ if name in _GENERAL})
            own = replace(self, scene=SceneOptions(path, photo=fresh), camera=CameraOptions(), look=LookOptions())
        else:
            own = replace(self, scene=replace(self.scene, input=path))
        if own.scene.photo.depth is None and not is_scene_path(path) and (beside := depth_map_beside(path)):
            own = replace(own, scene=replace(own.scene, photo=replace(own.scene.photo, depth=beside)))
        return own


def run(args: argparse.Namespace) -> None:
    """Serve the page of args.input until Ctrl-C. Raises InputError."""
    _view(read_options(ViewOptions, args), Stopwatch(args.began))


def _view(options: ViewOptions, watch: Stopwatch) -> None:
    given = options.scene.input
    is_folder = given.is_dir() and not is_shown_alone(given)
    paths = photos_and_scenes(given) if is_folder else [given]
    if not paths:
        raise InputError(f"{given} is a folder without photos and scenes; give one that has them, or a file")
    if not is_folder and find_scene_sequence(given) is None:
        check_scene_options(options.scene, options.camera)
    refuse_files(options.stereo.stereo, "a screen")
    panel, screen, tracked = _screen(options)
    device = choose_drawing_device(options.device, panel.width_px * panel.height_px, _MANY_FRAMES)
    watch.lap("start")
    reader = _Reader(options, panel, tracked, device.torch)
    shown, scene = _first(reader, paths)
    tracker, lines = (None, []) if tracked is None else open_tracker(options.eyes, tracked, say_now)
    with ExitStack() as stack:
        dropped = stack.enter_context(scratch_folder())
        if tracker is not None:
            stack.callback(tracker.stop)
        stage, where = _stage(options, scene, panel, tracker, tracked is not None and tracked.is_plain, device.webgpu)
        drawn_on = device.webgpu or device.torch
        print(f"{paths[shown]}: {scene.gaussians.count} Gaussians on {where}, drawn on {drawn_on}")
        watch.say_if(options.stats)
        say(*device.messages, *screen, *lines, *reader.messages)
        gallery = Gallery(paths, shown, reader.read, photos_and_scenes, is_shown_alone, OPENED_SUFFIXES, dropped)
        on_display = None if stage.fills_screen else _OnDisplay.found(panel, options)
        if on_display is not None:
            stack.callback(on_display.browser.close)
        looks, display = LookStore(looks_path()), None if on_display is None else on_display.show
        command = None if tracker is not None else reader.command
        routes = steering_routes(stage, exports(stage), gallery, looks, command, display)
        serve(options.serving, routes, "/", None if on_display is None else on_display.open_page)


def _screen(options: ViewOptions) -> tuple[Panel, list[str], TrackedScreen | None]:
    """Return the panel, lines on it, and the screen of tracked eyes, where they are. Raises InputError."""
    if options.eyes.eyes is None:
        refuse_eyes(options.eyes)
        return *panel_of(options.stereo, options.panel, "--stereo or --eyes"), None
    tracked = tracked_screen(options.eyes, options.stereo.stereo, options.panel, options.render.view_filter)
    return tracked.drawn_panel, tracked.messages, tracked


def _stage(
    options: ViewOptions,
    scene: StagedScene,
    panel: Panel,
    tracker: EyeTracker | None,
    is_plain: bool,
    device: str | None,
) -> tuple[Stage, str]:
    """Return what draws the scene, and words on where."""
    if tracker is not None:
        stage = TrackedStage(scene, panel, tracker.now(), is_plain, device)
        tracker.follow(stage.look, lambda: stage.drawing.seconds)
        return stage, "a plain screen" if is_plain else f"panel {panel.name}, for two eyes"
    if (layout := options.stereo.stereo) is not None:
        return StereoStage(scene, panel, layout, device), f"a screen of two eyes, {layout}"
    return Stage(scene, panel, device), f"panel {panel.name}"


@dataclass
class _OnDisplay:
    """The panel's page, which the page of the scene has opened on the display.

    Attributes:
        browser: Of the display.
        url: Address of the page of the scene, as soon as it is served.
    """

    browser: DisplayBrowser
    url: str = ""

    @staticmethod
    def found(panel: Panel, options: ViewOptions) -> _OnDisplay | None:
        """Return the connected display; None where its place is not known, or no browser can be told to open there."""
        position = None if options.serving.no_open else connected_position()
        if position is None or find_browser() is None:
            return None
        return _OnDisplay(DisplayBrowser(position, (panel.width_px, panel.height_px)))

    def open_page(self, url: str) -> None:
        """Open the page of the scene in the usual browser."""
        self.url = url
        webbrowser.open(url)

    def show(self) -> None:
        """Open the panel's page on the display, unless it is there."""
        if not self.browser.is_open():
            self.browser.open(f"{self.url}panel")


def is_shown_alone(path: Path) -> bool:
    """Tell whether a path is a scene, or a folder of scenes in a row, which the page shows as one thing."""
    return is_scene_path(path) or find_scene_sequence(path) is not None


def _first(reader: _Reader, paths: list[Path]) -> tuple[int, StagedScene]:
    """Return the first picture that can be read, and its place. Raises InputError where none can."""
    for place, path in enumerate(paths):
        try:
            return place, reader.read(path)
        except InputError as error:
            if len(paths) == 1:
                raise
            note(f"{error}; it is left out")
    raise InputError(f"none of the {len(paths)} photos and scenes can be read")


class _Reader:
    """Reads the pictures of a page, and knows the command line of the one that was read last."""

    def __init__(self, options: ViewOptions, panel: Panel, tracked: TrackedScreen | None, device: str):
        parser = Parser("lightfield-gs view")
        add_arguments(parser)
        self._typed = parser.typed(options.words)
        self._options, self._panel, self._tracked, self._device = options, panel, tracked, device
        self.messages: list[str] = []

    def read(self, path: Path, is_dropped: bool = False) -> StagedScene:
        """Read a picture, and print what is to be said of it later. Raises InputError."""
        own = self._options.of(path, is_dropped)
        if (sequence := find_scene_sequence(path)) is not None:
            return self._read_film(own, sequence)
        if own.fps is not None and not is_dropped:
            raise InputError(f"--fps is of numbered scenes in a folder, and {path} is none; leave it out")
        check_scene_options(own.scene, own.camera)
        choice, watch = read_camera(own.camera, self._panel), Stopwatch(time.perf_counter())
        with torch.no_grad():
            framed = load_framed(own.scene, choice, own.render, own.look, self._panel, self._device, watch, True)
        render, self.messages = framed.scene.render, framed.messages
        typed = [(name, words) for name, words in self._typed if name in _GENERAL or not is_dropped]
        if own.scene.photo.depth != self._options.scene.photo.depth:
            typed.append(("depth", (f"--depth={own.scene.photo.depth}",)))
        self._shown = ShownPicture(path, self._panel, framed.rig, own.look, typed)
        rig = self._deepened(framed.rig, own.look)
        return StagedScene(
            framed.scene.gaussians, rig, path.name, render.background, render.antialiased, render.view_filter
        )

    def _read_film(self, own: ViewOptions, sequence: SceneSequence) -> StagedScene:
        """Open scenes in a row. Raises InputError."""
        check_scene_options(replace(own.scene, input=sequence.files[0]), own.camera)
        choice = read_camera(own.camera, self._panel)
        with torch.no_grad():
            framed = frame_scenes(
                sequence, own.scene, choice, own.render, own.look, self._panel, self._device, holds_many=True
            )
        count, reader, render = len(sequence.files), framed.reader, framed.scene.render

        @lru_cache(2)  # a picture that moves and one at rest
        def at(number: int) -> Gaussians:
            return reader.at(number, [(number + step) % count for step in (1, 2)]).to(self._device)

        self.messages = framed.messages
        self._shown = ShownPicture(
            sequence.path, self._panel, framed.rig, own.look, list(self._typed), frames=sequence.files
        )
        film = Film(count, float(own.fps or DEFAULT_FPS), at)
        name, rig = sequence.path.name, self._deepened(framed.rig, own.look)
        return StagedScene(at(0), rig, name, render.background, render.antialiased, render.view_filter, film)

    def _deepened(self, rig: Rig, look: LookOptions) -> Rig:
        return rig if self._tracked is None else self._tracked.deepened(rig, look)

    def command(self, controls: Controls) -> list[str]:
        """Return the command line of the picture that was read last."""
        if self._options.stereo.stereo is not None:
            controls = replace(controls, quality="exact")  # which pictures of eyes always are
        return self._shown.command(controls)
