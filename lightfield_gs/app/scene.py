"""The scene of a command, and the cameras that look at it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.cameras import Given, choose_rig
from lightfield_gs.app.look import apply_look, report_depth
from lightfield_gs.app.photo import ReadPhoto, photo_scene, quilt_in_name, read_photo
from lightfield_gs.app.photo_depth import depth_file, has_depth, is_estimated
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.io.atomic import check_output_path
from lightfield_gs.io.file_kinds import refuse_unsupported
from lightfield_gs.io.scenes.comments import antialiasing_source, find_fit_record, format_rgb
from lightfield_gs.io.scenes.files import check_written_suffix, is_scene_path
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.app.photo import ReadPhoto
    from lightfield_gs.io.scenes.files import SceneFile
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.gaussians import Gaussians

_PHOTO_OPTIONS = (
    "mask",
    "remove_background",
    "checkpoint",
    "depth",
    "depth_model",
    "rgbd",
    "map_orientation",
    "detail",
    "detail_budget",
)
_DEPTH_OPTIONS = (
    "depth_kind",
    "depth_range",
    "depth_scale",
    "depth_invalid",
    "pixel_aspect",
    "fov",
    "intrinsics",
    "fit",
)
_WHITE = (1.0, 1.0, 1.0)
_READ = ("input", "rig", "panel", "mask", "depth", "checkpoint", "cameras", "view_map", "path")


def check_scene_options(args: argparse.Namespace) -> None:
    """Raises InputError where options of the scene do not go together, or not with the input."""
    if _is_scene_file(args):
        _refuse(args, _PHOTO_OPTIONS, f"is for photos, and {args.input} is a file of Gaussians")
    else:
        refuse_unsupported(args.input)
        _refuse(args, ("skip_invalid", "time", "up", "camera"), f"is for files of Gaussians, and {args.input} is none")
    if _is_scene_file(args) or not has_depth(args):
        _refuse(args, _DEPTH_OPTIONS, "is about a depth map, and there is no --depth")
    else:
        _refuse(args, ("checkpoint", "detail", "detail_budget"), "is for the network, which --depth does without")
    if args.depth is not None:
        _refuse(args, ("rgbd",), "takes the place of --depth")
    if is_estimated(args):
        if args.depth_kind == "ray":
            raise InputError("--depth-kind: ray is for a depth map in a file; --depth auto estimates none of that kind")
        _refuse(args, ("depth_scale", "depth_invalid"), "is about a depth map in a file, and --depth auto has none")
    else:
        _refuse(args, ("depth_model",), "is for --depth auto")
    if args.mask is None and depth_file(args) is None:
        _refuse(args, ("map_orientation",), "is about a mask or a depth map in a file of its own, and there is none")
    if args.intrinsics is not None and min(args.intrinsics[:2]) <= 0:
        raise InputError(
            f"--intrinsics: expected focal lengths > 0 px, got {args.intrinsics[0]:g} and {args.intrinsics[1]:g}"
        )
    for one, other in (("depth_range", "depth_scale"), ("fov", "intrinsics"), ("pixel_aspect", "intrinsics")):
        if getattr(args, one) is not None:
            _refuse(args, (other,), f"takes the place of {_option(one)}")


def check_scene_path(path: Path) -> None:
    """Raises InputError where no Gaussians can be written. The name says the format, of those that are written."""
    check_output_path(path)
    check_written_suffix(path)


def read_noted(path: Path, skip_invalid: bool, time: float | None = None) -> SceneFile:
    """What a file of Gaussians holds; says what looks wrong in it, and what was left out."""
    from lightfield_gs.io.scenes.files import read_scene

    scene = read_scene(path, skip_invalid=skip_invalid, time=time)
    for words in scene.notes:
        note(f"{path}: {words}")
    return scene


def say_origin(path: Path, gaussians: Gaussians) -> None:
    if any(gaussians.origin):
        place = ", ".join(f"{part:.0f}" for part in gaussians.origin)
        print(f"{path}: origin {place}, taken off its double coordinates (rigs and cameras are in the file's)")


def read_source(args: argparse.Namespace) -> SceneFile | ReadPhoto:
    """What the files of the input hold; nothing is computed yet. Raises InputError."""
    if _is_scene_file(args):
        file = read_noted(args.input, args.skip_invalid, args.time)
        say_origin(args.input, file.gaussians)
        return file
    _note_quilt(args.input)
    return read_photo(args)


def scene_of(
    args: argparse.Namespace, source: SceneFile | ReadPhoto, device: str, watch: Stopwatch, panel: Panel
) -> tuple[Gaussians, SceneFile | None]:
    """The Gaussians of an input that was read, on the device, and what else its file holds; None of a photo.

    panel: where it will be shown, which decides how finely a photo is taken, and what one with depths is to fill.
    """
    if isinstance(source, ReadPhoto):
        return photo_scene(args, source, device, watch, panel), None
    gaussians = source.gaussians.to(device)
    watch.lap("load")
    return gaussians, source


def load_scene(
    args: argparse.Namespace, device: str, watch: Stopwatch, panel: Panel
) -> tuple[Gaussians, SceneFile | None]:
    """What scene_of makes of the input. Raises InputError."""
    return scene_of(args, read_source(args), device, watch, panel)


def _note_quilt(path: Path) -> None:
    """Says so where a photo's name is that of a quilt."""
    if name := quilt_in_name(path):
        note(
            f"{path}: this looks like a Looking Glass quilt of {name[1]} x {name[2]} views, and is taken for one "
            "photo; `lightfield-gs weave` takes its views"
        )


def _is_scene_file(args: argparse.Namespace) -> bool:
    return is_scene_path(args.input)


def _refuse(args: argparse.Namespace, names: tuple[str, ...], reason: str) -> None:
    """Raises InputError for the first of these options that was given."""
    for name in names:
        if getattr(args, name) not in (None, False):
            raise InputError(f"{_option(name)} {reason}; leave out one of them")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def settle_drawing(args: argparse.Namespace, file: SceneFile | None) -> list[str]:
    """Sets those of args.antialiased and args.background that the command has and that nobody gave; lines on what was
    taken from the file. file: None for a photo. Raises InputError where the file's word on its fit cannot be read."""
    open_ones = [name for name in ("antialiased", "background") if getattr(args, name, ()) is None]
    comments = file.comments if file is not None and open_ones else ()
    with named(args.input):
        fitted, trained = find_fit_record(comments), antialiasing_source(comments)
    messages = []
    if "antialiased" in open_ones:
        args.antialiased = trained is not None
        if args.antialiased:
            messages.append(
                f"drawn with anti-aliasing: the file says that it was {trained} so (without: --no-antialiased)"
            )
    if "background" in open_ones:
        args.background = (fitted and fitted.background) or _WHITE
        if fitted is not None and fitted.background is not None:
            messages.append(
                f"background: {format_rgb(fitted.background)}, which the scene was fitted before (--background)"
            )
    return messages


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
