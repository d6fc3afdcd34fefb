"""The scene of a command: a file of Gaussians, or what is made of a photo."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.depth_map import add_depth, has_depth
from lightfield_gs.commands.options.detail import add_detail
from lightfield_gs.commands.options.estimated import depth_file, is_estimated
from lightfield_gs.commands.options.photo import ReadPhoto, photo_scene, quilt_in_name, read_photo
from lightfield_gs.commands.options.values import within
from lightfield_gs.io.atomic import check_output_path
from lightfield_gs.io.scenes.stored import check_written_suffix, is_scene_path
from lightfield_gs.io.unread import refuse_unread

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.scene.files import SceneFile
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


def add_scene(
    add: Callable[..., argparse.Action],
    cutting: str,
    mask: str = "cut-out of a photo, of its size: bright or opaque on the object",
    of_mask: str = "IMAGE",
) -> None:
    """What is made of a photo, and what is left out of a file. cutting: help on --remove-background; mask, of_mask:
    help and placeholder of --mask."""
    add("--mask", type=Path, metavar=of_mask, help=mask)
    add("--remove-background", action="store_true", help=cutting)
    add_depth(add)
    add_detail(add)
    add("--checkpoint", type=Path, metavar="FILE", help="weights of the network, .safetensors (default: those inside)")
    add_reading(add)


def add_reading(add: Callable[..., argparse.Action]) -> None:
    """How a file of Gaussians is read."""
    add(
        "--skip-invalid",
        action="store_true",
        help="leave out Gaussians whose values have no meaning (not finite, a rotation of zeros), and say how many",
    )
    add(
        "--time",
        type=within(-1e6, 1e6),
        metavar="T",
        help="the time at which Gaussians that move (Spacetime Gaussians) are drawn, mostly 0..1 of their film "
        "(default: in its middle, which is said)",
    )


def check_scene_options(args: argparse.Namespace) -> None:
    """Raises InputError where options of the scene do not go together, or not with the input."""
    if _is_scene_file(args):
        _refuse(args, _PHOTO_OPTIONS, f"is for photos, and {args.input} is a file of Gaussians")
    else:
        refuse_unread(args.input)
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
    from lightfield_gs.scene.files import read_scene

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
