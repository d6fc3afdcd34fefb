"""How every command begins that draws a scene: it loads it, and places the cameras as the options want them."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.camera import Given, choose_rig
from lightfield_gs.commands.options.depth_map import has_depth
from lightfield_gs.commands.options.drawn import settle_drawing
from lightfield_gs.commands.options.look import apply_look, report_depth
from lightfield_gs.commands.options.scene import read_source, scene_of
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.commands.options.photo import ReadPhoto
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.files import SceneFile
    from lightfield_gs.scene.gaussians import Gaussians

_READ = ("input", "rig", "panel", "mask", "depth", "checkpoint", "cameras", "view_map", "path")


@dataclass
class Framed:
    """A scene on the device, and the cameras that look at it, in its coordinates.

    file: what else its file holds; None of a photo. messages: lines on what was decided.
    """

    gaussians: Gaussians
    file: SceneFile | None
    rig: Rig
    messages: list[str] = field(default_factory=list)

    @property
    def rig_of_file(self) -> Rig:
        """In the coordinates of the scene's file, as files of cameras are."""
        return self.rig.relative_to([-part for part in self.gaussians.origin])


def load_framed(args: argparse.Namespace, panel: Panel, given: Given, device: str, watch: Stopwatch) -> Framed:
    """Loads the scene of a command, settles how it is drawn, and frames it. Raises InputError."""
    gaussians, file, messages = load_drawn(args, panel, device, watch)
    rig, how = frame_scene(args, panel, given, gaussians, file)
    return Framed(gaussians, file, rig, messages + how)


def load_drawn(
    args: argparse.Namespace, panel: Panel, device: str, watch: Stopwatch
) -> tuple[Gaussians, SceneFile | None, list[str]]:
    """The Gaussians, on the device, what else their file holds (None of a photo), and lines on how they are drawn,
    which is settled in args. panel: see scene_of. Raises InputError."""
    return drawn_of(args, read_source(args), panel, device, watch)


def drawn_of(
    args: argparse.Namespace, source: SceneFile | ReadPhoto, panel: Panel, device: str, watch: Stopwatch
) -> tuple[Gaussians, SceneFile | None, list[str]]:
    """What load_drawn returns, of an input that was read."""
    gaussians, file = scene_of(args, source, device, watch, panel)
    return gaussians, file, settle_drawing(args, file)


def frame_scene(
    args: argparse.Namespace, panel: Panel, given: Given, gaussians: Gaussians, file: SceneFile | None
) -> tuple[Rig, list[str]]:
    """The rig as the options want it, in the coordinates of the Gaussians, and lines on how it came about and on how
    deep the scene is. Raises InputError."""
    chosen, how = choose_rig(given, args, panel, gaussians, file)
    rig, looks = apply_look(args, chosen, panel, gaussians)
    # Framing leaves room around the object of a photo, as around no other scene
    may_fill = file is not None or given.rig is not None or has_depth(args)
    return rig, [*how, *looks, *report_depth(args, rig, panel, gaussians, may_fill)]


def files_read(args: argparse.Namespace) -> tuple[Path | str | None, ...]:
    """The files that the options name to be read, which no output may be; None for what was not given."""
    camera = getattr(args, "camera", None)
    return (*(getattr(args, name, None) for name in _READ), camera and camera[0])
