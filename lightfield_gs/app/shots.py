"""What the frames of a video show: one scene with cameras that move, or a scene for each picture of a sequence."""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.app.cameras import axes_of, read_given
from lightfield_gs.app.look import apply_look, report_depth
from lightfield_gs.app.photo import photo_rig
from lightfield_gs.app.photo_depth import depth_file, depth_model, is_estimated
from lightfield_gs.app.provenance import scene_hash
from lightfield_gs.app.scene import check_scene_options, frame_scene, load_drawn, load_scene, settle_drawing
from lightfield_gs.app.video import DEFAULT_FPS, DEFAULT_SECONDS
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.io.atomic import scratch_folder, sha256
from lightfield_gs.io.file_kinds import refuse_video
from lightfield_gs.io.images import read_picture
from lightfield_gs.io.scenes.files import SceneFile
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.photo.side_by_side import depth_side, is_rgbd_name
from lightfield_gs.scene.axes import find_up, upright_rotation
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.video.camera_path import MOST_FRAMES, CameraPath, turntable
from lightfield_gs.video.rendering import FrameSource as FrameScenes
from lightfield_gs.video.sequence import Sequence, is_sequence, open_sequence, pictures_and_maps

_PHOTO_DEGREES = 20.0
# Options that decide what the scene of a picture is; of a folder of frames, they belong to its job
_OF_PICTURES = ("depth_kind", "depth_range", "depth_scale", "depth_invalid", "rgbd", "map_orientation", "fov", "fit")
_MORE_OF_PICTURES = (
    "intrinsics",
    "pixel_aspect",
    "remove_background",
    "reframe",
    "focus",
    "depth_amount",
    "cone",
    "zoom",
    "pan",
)


@dataclass
class Shots:
    """count: of frames; take: see video.make.Shots; rig_of_file: of a frame's metadata, in the coordinates of the
    scene's file, None where it is not known before the frame is drawn; job: what the frames hang on beside the options
    of drawing, JSON values; messages: lines on what was decided."""

    count: int
    fps: Fraction
    is_one_scene: bool
    take: FrameScenes
    rig_of_file: Callable[[int], Rig | None]
    job: dict[str, Any]
    messages: list[str] = field(default_factory=list)


def still_shots(args: argparse.Namespace, panel: Panel, device: str, watch: Stopwatch, stack: ExitStack) -> Shots:
    """One scene, or the scene of one photo, with cameras that move. Raises InputError."""
    if args.reframe:
        raise InputError(f"--reframe is for pictures in a row, and {args.input} is one scene; leave it out")
    check_scene_options(args)
    given = read_given(args, panel)
    path = None if args.path is None else CameraPath.load(args.path, panel)
    gaussians, file, messages = load_drawn(args, panel, device, watch)
    fps = args.fps or DEFAULT_FPS
    if path is not None:
        bare = path.relative_to(gaussians.origin).frames(float(fps), args.frames)
        rigs = [apply_look(args, rig, panel, gaussians)[0] for rig in bare]
        messages.append(f"path: {args.path}, {len(path.rigs)} keyframes in {path.seconds:g} s")
        messages += report_depth(args, rigs[0], panel, gaussians)
    else:
        rig, how = frame_scene(args, panel, given, gaussians, file)
        rigs, words = _turntable(args, panel, rig, file, fps)
        messages += [*how, words]
    back = [-part for part in gaussians.origin]
    of_file = [rig.relative_to(back) for rig in rigs]
    job = {
        "input": args.input.name,
        "device": device,  # which rounds in its own way
        "scene": scene_hash(gaussians),
        "rigs": hashlib.sha256(json.dumps([rig.to_dict() for rig in of_file]).encode()).hexdigest(),
    }
    watch.lap("cameras")
    return Shots(
        len(rigs),
        fps,
        True,
        lambda numbers: ((number, gaussians, rigs[number]) for number in numbers),
        of_file.__getitem__,
        job,
        messages,
    )


def _turntable(
    args: argparse.Namespace, panel: Panel, rig: Rig, file: SceneFile | None, fps: Fraction
) -> tuple[list[Rig], str]:
    """The rigs of --turntable, and a line on them."""
    seconds = DEFAULT_SECONDS if args.turntable is None else args.turntable
    frames = args.frames or max(1, round(seconds * fps))
    if frames > MOST_FRAMES:
        raise InputError(f"--turntable: expected at most {MOST_FRAMES} frames, got {frames}; give a smaller --fps")
    degrees = (_PHOTO_DEGREES if file is None else 360.0) if args.degrees is None else args.degrees
    up: np.ndarray | None = None
    axis = "the camera's vertical"
    if file is not None and (args.up or find_up(file.comments)):
        axis = axes_of(args.up, file).axis
        up = -upright_rotation(axis)[1]
    is_said = args.turntable is not None or args.degrees is not None
    assumed = "" if is_said else " (assumed; another: --turntable, --degrees, --path)"
    words = f"turntable: {degrees:g} degrees about {axis} in {float(frames / fps):g} s{assumed}"
    return turntable(rig, panel, frames, degrees, up), words


def sequence_shots(args: argparse.Namespace, panel: Panel, device: str, watch: Stopwatch, stack: ExitStack) -> Shots:
    """A scene for each picture of a folder or a video. Raises InputError."""
    for name in ("turntable", "degrees", "path"):
        if getattr(args, name) is not None:
            raise InputError(f"--{name} is for one scene, and {args.input} is a sequence; leave out one of them")
    pictures = open_sequence(args.input)
    paired = [] if args.rgbd is not None else _take_pairs(args, pictures)
    beside = {name: _beside(args, name, pictures.count) for name in ("depth", "mask")}
    folder = stack.enter_context(scratch_folder())
    parts = {"input": pictures, **{name: part for name, part in beside.items() if part is not None}}
    stack.enter_context(_said_of({"half": pictures, **parts}, folder))
    count = min(pictures.count, args.frames or pictures.count)
    shown, halved = _settle_half(args, pictures, count, folder)
    given = read_given(args, panel)

    def scenes(numbers: list[int]) -> Iterator[tuple[int, argparse.Namespace]]:
        """The arguments of each picture, as if it were alone."""
        rows = [part.pictures(numbers, _made(folder / name)) for name, part in parts.items()]
        for row in zip(*rows):
            own = argparse.Namespace(**vars(args))
            for name, (_, path) in zip(parts, row):
                setattr(own, name, path)
            yield row[0][0], own

    def loaded(own: argparse.Namespace) -> Gaussians:
        return load_scene(own, device, Stopwatch(0.0), panel)[0]

    _, first = next(scenes([shown]))
    check_scene_options(first)
    gaussians, file = load_scene(first, device, watch, panel)
    if file is not None:
        raise InputError(f"{first.input} is a file of Gaussians; a sequence takes pictures")
    if is_estimated(first):  # also where no object is cut out
        args.depth = first.depth
    messages = [*paired, *halved, *settle_drawing(args, None)]
    messages += [note for part in (pictures, *beside.values()) if part is not None for note in part.notes]
    rig, how = frame_scene(first, panel, given, gaussians, None)

    def take(numbers: list[int]) -> Iterator[tuple[int, Gaussians, Rig]]:
        for number, own in scenes(numbers) if numbers else ():
            # What is to be said of the first is said of it; of all others it would be the same again
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                with named(f"frame {number}"):
                    gaussians = loaded(own)
                    framed = rig
                    if args.reframe:
                        framed, _ = apply_look(args, photo_rig(own, panel, gaussians), panel, gaussians)
            yield number, gaussians, framed

    fps = args.fps or pictures.fps or DEFAULT_FPS
    job = {
        "input": args.input.name,
        "device": device,
        "pictures": pictures.digest(),
        "rig": None if args.reframe else rig.to_dict(),
        **{name: part.digest() for name, part in beside.items() if part is not None},
        **{name: getattr(args, name) for name in (*_OF_PICTURES, *_MORE_OF_PICTURES)},
        **({"depth_model": depth_model(args)} if is_estimated(args) else {}),
        "checkpoint": args.checkpoint and sha256(args.checkpoint),
    }
    name = first.input.name if pictures.files else args.input.name
    example = f"{name}, {f'frame {shown}' if shown else 'the first'}"
    words = "each by itself" if args.reframe else f"all as {example} (each by itself: --reframe)"
    watch.lap("first picture")
    return Shots(
        count,
        fps,
        False,
        take,
        lambda number: None if args.reframe else rig,
        job,
        [*messages, *how, f"framing: {words}"],
    )


class _Renaming:
    """In place of sys.stdout or sys.stderr: what is written goes there with other names in it."""

    def __init__(self, usual: Any, renamed: Callable[[str], str]):
        self._usual, self._renamed = usual, renamed

    def write(self, text: str) -> int:
        """Passes a text on."""
        self._usual.write(self._renamed(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._usual, name)


@contextlib.contextmanager
def _said_of(parts: dict[str, Sequence], folder: Path) -> Iterator[None]:
    """What is printed or complained of meanwhile names the videos, not the files of their frames in the folder."""
    names = {str(folder / name / f"{part.path.stem}.png"): str(part.path) for name, part in parts.items()}
    names |= {f"{part.path.stem}.png": part.path.name for part in parts.values() if not part.files}
    written = re.compile(r"(?<![^\s('\"])(" + "|".join(map(re.escape, names)) + ")")

    def renamed(text: str) -> str:
        return written.sub(lambda match: names[match[0]], text)

    try:
        with (
            contextlib.redirect_stdout(_Renaming(sys.stdout, renamed)),
            contextlib.redirect_stderr(_Renaming(sys.stderr, renamed)),
        ):
            yield
    except InputError as error:
        raise InputError(renamed(str(error))) from None


def _take_pairs(args: argparse.Namespace, pictures: Sequence) -> list[str]:
    """Has args.depth be the depth maps beside the pictures in their folder, unless others are given; a line on it."""
    maps = pictures_and_maps(args.input)[1] if pictures.files else []
    if not maps:
        return []
    first = f"{pictures.files[0].name} with {maps[0].name}"
    if args.depth is not None:
        return [f"{args.input}: its depth maps ({maps[0].name}, ...) are left out, as --depth gives others"]
    args.depth = args.input
    return [f"{args.input}: {pictures.count} pictures, each with the depth map beside it ({first})"]


def _settle_half(args: argparse.Namespace, pictures: Sequence, count: int, folder: Path) -> tuple[int, list[str]]:
    """Sets args.rgbd for pictures that have their depth maps beside them by their names: the half is that of the first
    picture that shows it, for others may be black. Returns the number of that picture, else 0, and a line on it."""
    named_ones = pictures.files or (pictures.path,)
    if args.rgbd is not None or args.depth is not None or not all(map(is_rgbd_name, named_ones)):
        return 0, []
    for number, path in pictures.pictures(list(range(count)), _made(folder / "half")):
        if (side := depth_side(read_picture(path).pixels, is_named=True)) is not None:
            args.rgbd = side
            return number, [f"depth: the {side} half of each picture, as picture {number} shows it (assumed; --rgbd)"]
    return 0, []


def _beside(args: argparse.Namespace, name: str, count: int) -> Sequence | None:
    """The pictures of --depth or --mask, one for each of the sequence. Raises InputError."""
    path: Path | None = depth_file(args) if name == "depth" else getattr(args, name)
    if path is None:
        return None
    if not path.is_dir() and not is_sequence(path):
        refuse_video(path)
        raise InputError(f"--{name}: expected a folder or a video, as {args.input} is a sequence, got {path}")
    pictures = open_sequence(path, maps=True)
    if pictures.count != count:
        raise InputError(
            f"--{name}: expected one for each of the {count} pictures of {args.input}, got {pictures.count} in {path}"
        )
    return pictures


def _made(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder
