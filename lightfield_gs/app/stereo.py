"""A scene as the pictures of two eyes, in the files that players and screens take."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.cameras import read_camera
from lightfield_gs.app.options import EncodeOptions, PanelOptions, StereoOptions
from lightfield_gs.app.own_eyes import OwnEyes, own_eyes
from lightfield_gs.app.panel import load_panel, software
from lightfield_gs.app.scene import check_scene_options, load_framed
from lightfield_gs.base.cli_messages import Stopwatch, note, say
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_PANEL, StereoLayout
from lightfield_gs.io.atomic import check_output_path, check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.io.stereo_names import stereo_paths
from lightfield_gs.panels.comfort import COMFORT_DEG, depth_report
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.stereo_screen import StereoScreen, eye_geometry
from lightfield_gs.webgpu.devices import choose_drawing_device

if TYPE_CHECKING:
    from torch import Tensor

    from lightfield_gs.scene.gaussians import Gaussians

_JPEG = (".jpg", ".jpeg", ".jps")
# Options of `encode` that are about the sub-pixels or the lenses of a panel, and their defaults
_OF_PANELS = {
    "cameras": None,
    "view_map": None,
    "memory_budget": None,
    "method": "direct",
    "views": "integer",
    "quality": "exact",
    "bit_depth": None,
    "save_rig": None,
    "save_gaussians": None,
    "preview": None,
}


@dataclass(frozen=True)
class StereoTarget:
    """What pictures of two eyes are for.

    Attributes:
        layout: How they are stored.
        screen: Where they are seen.
        own: The user's numbers, where options leave them open.
    """

    layout: StereoLayout
    screen: StereoScreen
    own: OwnEyes = OwnEyes()

    @staticmethod
    def of(options: StereoOptions, viewing_distance_mm: float | None) -> StereoTarget:
        """Return the target of the options; raise InputError where there is none."""
        assert options.stereo is not None
        width, height = options.eye_size or (StereoScreen.width_px, StereoScreen.height_px)
        is_open = options.screen_size is None or options.eye_distance is None
        own = own_eyes() if is_open else OwnEyes()
        size, eyes = options.screen_size or own.diagonal_in, options.eye_distance or own.eye_distance_mm
        return StereoTarget(options.stereo, StereoScreen(width, height, size, eyes, viewing_distance_mm), own)

    def line(self, options: StereoOptions, viewing_distance_mm: float | None) -> str:
        """Return a line on the screen and the eyes, with the options that were left to their defaults."""
        given = (options.eye_distance is not None, options.screen_size is not None)
        names = [
            name
            for name, is_given in (
                ("--eye-distance MM", given[0]),
                ("--screen-size INCHES", given[1]),
                ("--viewing-distance MM", viewing_distance_mm is not None),
            )
            if not is_given
        ]
        source = "assumed" if self.own.kept_in is None else f"as kept in {self.own.kept_in}; else"
        return f"stereo: {self.screen.words()}" + (f" ({source}: {', '.join(names)})" if names else "")


def refuse_stereo(options: StereoOptions, names: str = "--stereo") -> None:
    """Raise InputError for options of stereo without --stereo; names: of the options that have these."""
    if options.stereo is not None:
        return
    default = StereoOptions()
    for name in ("eye_distance", "screen_size", "eye_size"):
        if getattr(options, name) != getattr(default, name):
            raise InputError(f"--{name.replace('_', '-')} is for {names}; give it too, or leave this one out")


def refuse_panel(panel: str | None) -> None:
    """Raise InputError for a panel beside --stereo."""
    if panel not in (None, DEFAULT_PANEL):
        raise InputError("--panel is one of many views, and this picture is for another screen; leave it out")


def panel_of(stereo: StereoOptions, panel: PanelOptions, names: str = "--stereo") -> tuple[Panel, list[str]]:
    """Return the panel of a screen of two eyes where --stereo asks for one, else that of --panel; and a line on it.

    Args:
        stereo: The options.
        panel: Of --panel.
        names: See refuse_stereo.

    Raises:
        InputError: Options exclude each other, or the panel cannot be used.
    """
    refuse_stereo(stereo, names)
    if stereo.stereo is None:
        return load_panel(panel), []
    refuse_panel(panel.panel)
    target = StereoTarget.of(stereo, panel.viewing_distance)
    return target.screen.panel(), [target.line(stereo, panel.viewing_distance)]


def refuse_files(layout: StereoLayout | None, words: str) -> None:
    """Raise InputError for a layout of several pictures, which no screen takes; words: of the purpose."""
    if layout in ("mpo", "left-right"):
        raise InputError(f"--stereo {layout} is for pictures; {words} takes sbs, half-sbs, tab or anaglyph")


def write_stereo(options: EncodeOptions, watch: Stopwatch) -> tuple[Path, ...]:
    """Draw the pictures of two eyes of the input, write them, and return their files. Raises InputError."""
    paths = _check_stereo(options)
    target = StereoTarget.of(options.stereo, options.panel.viewing_distance)
    panel = target.screen.panel()
    check_scene_options(options.scene, options.camera)
    pixels = 2 * panel.width_px * panel.height_px
    device, webgpu, decisions = choose_drawing_device(options.device, pixels)
    choice = read_camera(options.camera, panel)
    import torch

    from lightfield_gs.encoding.stereo import render_eyes

    watch.lap("start")
    with torch.inference_mode():
        look = replace(options.look, depth_report=False)
        framed = load_framed(options.scene, choice, options.render, look, panel, device, watch)
        gaussians, rig = framed.scene.gaussians, framed.rig
        eyes = render_eyes(gaussians, panel, rig, **framed.scene.render.arguments(), device=webgpu).cpu()
        comfort = comfort_line(gaussians, panel, rig)
        watch.lap("eyes")
        _write(paths, eyes, target.layout, _metadata(options, target, panel, rig), options)
        watch.lap("write")
    names = " and ".join(map(str, paths))
    height, width = eyes.shape[1:3]
    print(f"{names}: {target.layout}, two eyes of {width} x {height}, {gaussians.count} Gaussians")
    watch.say_if(options.stats)
    say(target.line(options.stereo, options.panel.viewing_distance), comfort, *decisions, *framed.messages)
    return paths


def _check_stereo(options: EncodeOptions) -> tuple[Path, ...]:
    """Return the files to write. Raise InputError for options of panels, and for files that cannot be written."""
    refuse_panel(options.panel.panel)
    for name, default in _OF_PANELS.items():
        if getattr(options, name) != default:
            raise InputError(f"--{name.replace('_', '-')} is about a panel, and --stereo draws two eyes; leave out one")
    layout, path = options.stereo.stereo, options.output
    assert layout is not None
    paths = stereo_paths(path, layout)
    suffix = paths[0].suffix.lower()
    if suffix in (".heic", ".heif"):
        raise InputError(
            f"cannot write {path}: pi-heif has no encoder, and that of pillow-heif (GPL) writes no group of two eyes "
            "('ster'), without which Apple's programs show one picture; give --stereo mpo with .mpo, or sbs with .png"
        )
    if (layout == "mpo") != (suffix == ".mpo") or suffix == ".jps" and layout != "sbs":
        ways = ".mpo" if layout == "mpo" else ".png, .jpg or .tif" + (", or .jps" if layout == "sbs" else "")
        raise InputError(f"cannot write {path}: --stereo {layout} goes into {ways}, not '{suffix}'")
    for each in paths:
        if suffix in (*_JPEG, ".mpo"):
            check_output_path(each)
        elif check_image_path(each).suffix.lower() == ".exr":
            raise InputError(f"cannot write {each}: pictures of eyes have 8 bits; give .png, .jpg or .tif")
    check_outputs(paths, options.inputs())
    return paths


def comfort_line(gaussians: Gaussians, panel: Panel, rig: Rig) -> str:
    """Return a line on how far the eyes must turn, and note what strains them. Raises InputError."""
    report = depth_report(gaussians, panel, rig)
    for words in report.warnings():
        note(words)
    near, far = (part.angle_deg or 0.0 for part in (report.near, report.far))
    return f"comfort: {near:+.2f} to {far:+.2f} degrees between the eyes, {COMFORT_DEG:g} is the most"


def _write(
    paths: tuple[Path, ...], eyes: Tensor, layout: StereoLayout, metadata: dict[str, str], options: EncodeOptions
) -> None:
    from lightfield_gs.encoding.stereo import join_eyes
    from lightfield_gs.io.jpeg_pairs import write_jpeg, write_mpo

    if layout == "mpo":
        write_mpo(paths[0], [eye.numpy() for eye in eyes], metadata)
        return
    pictures = [*eyes] if layout == "left-right" else [join_eyes(eyes, layout)]
    for path, picture in zip(paths, pictures):
        if path.suffix.lower() in _JPEG:
            write_jpeg(path, picture.numpy(), metadata)
        else:
            write_image(path, picture.numpy(), metadata, options.compression)


def _metadata(options: EncodeOptions, target: StereoTarget, panel: Panel, rig: Rig) -> dict[str, str]:
    """Return how the eyes' pictures hang together, by which the depth of a pair can be read again."""
    stereo = {"layout": target.layout, **eye_geometry(panel, rig)}
    return {"software": software(), "input": options.scene.input.name, "stereo": json.dumps(stereo)}
