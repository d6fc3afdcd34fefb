"""The frames of a video: one scene with cameras that move, or a scene for each picture of a sequence."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import astuple, dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.app.cameras import apply_look, read_camera, report_depth, scene_up
from lightfield_gs.app.options import AUTO, FLAT, PhotoOptions, SceneOptions
from lightfield_gs.app.photo import ReadPhoto, photo_rig
from lightfield_gs.app.photo_pair import with_video_pair
from lightfield_gs.app.scene import (
    LoadedScene,
    RenderSettings,
    build_scene,
    check_scene_options,
    frame_scene,
    load_scene,
    read_source,
    show_levels,
)
from lightfield_gs.app.steady_photos import steady_photos
from lightfield_gs.app.stereo_film import REACH as PAIRS_REACH
from lightfield_gs.app.stereo_film import film_parallax, layout_of_film, sample_numbers
from lightfield_gs.app.video import DEFAULT_FPS, VideoOptions
from lightfield_gs.base.cli_messages import Stopwatch
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.options import DEFAULT_SECONDS, MOST_FRAMES
from lightfield_gs.io.atomic import scratch_folder, sha256
from lightfield_gs.io.file_kinds import refuse_video
from lightfield_gs.io.images import read_picture
from lightfield_gs.io.scenes.files import SceneFile
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.photo.side_by_side import depth_side, is_rgbd_name
from lightfield_gs.photo.steady_depth import REACH
from lightfield_gs.scene.axes import find_up, upright_rotation
from lightfield_gs.scene.gaussians import Gaussians, scene_hash
from lightfield_gs.video.camera_path import CameraPath, turntable
from lightfield_gs.video.rendering import FrameSource
from lightfield_gs.video.sequence import ImageSequence, is_sequence, open_sequence, pictures_and_maps

_PHOTO_DEGREES = 20.0
_RIGS = 24  # of a path, for levels of detail
# Options that determine the scene of a picture: all frames of a folder must have the same
_PHOTO_OF_JOB: tuple[str, ...] = (
    "depth_kind",
    "depth_range",
    "depth_scale",
    "depth_invalid",
    "rgbd",
    "map_orientation",
    "fov",
    "fit",
)
_PHOTO_OF_JOB += ("stereo_in", "swap_eyes", "intrinsics", "pixel_aspect", "remove_background", "clean_edges")
_LOOK_OF_JOB = ("focus", "depth_amount", "cone", "zoom", "pan")


@dataclass
class Shots:
    """The scene and the rig of each frame.

    Attributes:
        count: of frames.
        fps: frames a second.
        is_one_scene: whether all frames show the same scene.
        take: see `FrameSource`.
        rig_of_file: the rig for a frame's metadata, in the coordinates of the scene's file. None: not known before the
            frame is drawn.
        render: how frames are drawn.
        job: further values, for JSON, that the frames depend on beside the options of drawing.
        messages: lines on decisions.
        closing: returns lines on the frames that were taken, once all were.
    """

    count: int
    fps: Fraction
    is_one_scene: bool
    take: FrameSource
    rig_of_file: Callable[[int], Rig | None]
    render: RenderSettings
    job: dict[str, Any]
    messages: list[str] = field(default_factory=list)
    closing: Callable[[], list[str]] = list


def still_shots(options: VideoOptions, panel: Panel, device: str, watch: Stopwatch, stack: ExitStack) -> Shots:
    """Return the shots of one scene, or of one photo, with cameras that move. Raises InputError."""
    motion, source = options.motion, options.scene.input
    if motion.reframe:
        raise InputError(f"--reframe is for pictures in a row, and {source} is one scene; leave it out")
    check_scene_options(options.scene, options.camera)
    choice = read_camera(options.camera, panel)
    path = None if motion.path is None else CameraPath.load(motion.path, panel)
    scene = load_scene(options.scene, options.render, options.look, panel, device, watch)
    gaussians, messages = scene.gaussians, scene.messages
    fps = motion.fps or DEFAULT_FPS
    if path is not None:
        bare = path.relative_to(gaussians.origin).frames(float(fps), motion.frames)
        rigs = [apply_look(options.look, rig, panel, gaussians)[0] for rig in bare]
        messages += show_levels(scene, rigs[:: max(1, len(rigs) // _RIGS)], panel)
        messages.append(f"path: {motion.path}, {len(path.rigs)} keyframes in {path.seconds:g} s")
        messages += report_depth(options.look, rigs[0], panel, scene.gaussians)
    else:
        rig, how = frame_scene(choice, options.look, scene, panel, is_turned=True)
        rigs, words = _turntable(options, panel, rig, scene, fps)
        messages += [*how, words]
    gaussians, of_file = scene.gaussians, [scene.in_file(rig) for rig in rigs]
    job = {
        "input": source.name,
        "device": options.device,  # which rounds in its own way
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
        scene.render,
        job,
        messages,
    )


def _turntable(
    options: VideoOptions, panel: Panel, rig: Rig, scene: LoadedScene, fps: Fraction
) -> tuple[list[Rig], str]:
    """Return the rigs of --turntable, and a line on them."""
    motion, file = options.motion, scene.file
    seconds = DEFAULT_SECONDS if motion.turntable is None else motion.turntable
    frames = motion.frames or max(1, round(seconds * fps))
    if frames > MOST_FRAMES:
        raise InputError(f"--turntable: expected at most {MOST_FRAMES} frames, got {frames}; give a smaller --fps")
    degrees = (_PHOTO_DEGREES if file is None else 360.0) if motion.degrees is None else motion.degrees
    up: np.ndarray | None = None
    axis = "the camera's vertical"
    if file is not None and (options.camera.up or find_up(file.comments)):
        axis = scene_up(options.camera.up, file).axis
        up = -upright_rotation(axis)[1]
    is_said = motion.turntable is not None or motion.degrees is not None
    assumed = "" if is_said else " (assumed; another: --turntable, --degrees, --path)"
    words = f"turntable: {degrees:g} degrees about {axis} in {float(frames / fps):g} s{assumed}"
    return turntable(rig, panel, frames, degrees, up), words


def sequence_shots(options: VideoOptions, panel: Panel, device: str, watch: Stopwatch, stack: ExitStack) -> Shots:
    """Return the shots of a folder of pictures, or of a video: a scene for each picture. Raises InputError."""
    motion, look, scene = options.motion, options.look, options.scene
    source = scene.input
    for name in ("turntable", "degrees", "path"):
        if getattr(motion, name) is not None:
            raise InputError(f"--{name} is for one scene, and {source} is a sequence; leave out one of them")
    pictures = open_sequence(source)
    photo, paired = scene.photo, list[str]()
    if photo.rgbd is None:
        photo, paired = _take_pairs(source, photo, pictures)
    photo = with_video_pair(photo, pictures)
    maps = {"depth": photo.depth_file, "mask": photo.mask}
    beside = {name: _open_beside(name, path, source, pictures.count) for name, path in maps.items() if path is not None}
    folder = stack.enter_context(scratch_folder())
    parts = {"input": pictures, **beside}
    stack.enter_context(_naming_videos({"half": pictures, **parts}, folder))
    count = min(pictures.count, motion.frames or pictures.count)
    photo, shown, halved = _find_half(photo, pictures, count, folder)
    choice = read_camera(options.camera, panel)
    if not motion.reframe:
        photo, shown = _film_of_pairs(replace(scene, photo=photo), parts, count, shown, folder)
        photo = replace(photo, is_in_row=True)
    _, own = next(_pictures(replace(scene, photo=photo), parts, [shown], folder))
    check_scene_options(own, options.camera)
    first = load_scene(own, options.render, look, panel, device, watch)
    if first.photo is None:
        raise InputError(f"{first.path} is a file of Gaussians; a sequence takes pictures")
    if first.photo.options.depth in (AUTO, FLAT):  # also where no object is cut out
        photo = replace(photo, depth=first.photo.options.depth)
    if first.photo.placed is not None and photo.is_in_row:
        photo = replace(photo, fit=first.photo.placed.fit, fov=first.photo.options.fov)
    messages = [*paired, *halved, *(note for part in parts.values() for note in part.notes)]
    rig, how = frame_scene(choice, look, first, panel)

    flat = _FlatFrames()

    def take(numbers: list[int]) -> Iterator[tuple[int, Gaussians, Rig]]:
        every = replace(scene, photo=photo)
        reach = REACH if photo.is_estimated else PAIRS_REACH if photo.film_parallax is not None else 0
        near = range(max(0, numbers[0] - reach), min(pictures.count, numbers[-1] + reach + 1)) if numbers else ()
        each = _sources(every, parts, list(near) if reach else numbers, folder)
        if reach:
            each = _with_neighbours(each, photo, device, set(numbers))
        for number, own, source in each:
            flat.look_at(number, source)
            with _unheard(), named(f"frame {number}"):
                loaded = build_scene(own, source, options.render, look, panel, device, Stopwatch(0.0))
                framed = rig
                if motion.reframe and loaded.photo is not None:
                    bare = photo_rig(loaded.photo, panel, loaded.gaussians)
                    framed, _ = apply_look(look, bare, panel, loaded.gaussians)
                    framed = replace(framed, cone_deg=rig.cone_deg)  # depth as in the first picture
            yield number, loaded.gaussians, framed

    fps = motion.fps or pictures.fps or DEFAULT_FPS
    job = {
        "input": source.name,
        "device": options.device,
        "pictures": pictures.digest(),
        "rig": None if motion.reframe else rig.to_dict(),
        **{name: part.digest() for name, part in beside.items()},
        **{name: getattr(photo, name) for name in _PHOTO_OF_JOB},
        "reframe": motion.reframe,
        **{name: getattr(look, name) for name in _LOOK_OF_JOB},
        **({"depth_model": photo.depth_network} if photo.is_estimated else {}),
        "checkpoint": photo.checkpoint and sha256(photo.checkpoint),
        **({"pair": astuple(photo.pair), "parallax": photo.film_parallax} if photo.pair is not None else {}),
    }
    name = first.path.name if pictures.files else source.name
    example = f"{name}, {f'frame {shown}' if shown else 'the first'}"
    words = "each by itself" if motion.reframe else f"all as {example} (each by itself: --reframe)"
    watch.lap("first picture")
    return Shots(
        count,
        fps,
        False,
        take,
        lambda number: None if motion.reframe else rig,
        first.render,
        job,
        [*messages, *how, f"framing: {words}"],
        flat.words,
    )


def _pictures(
    scene: SceneOptions, parts: dict[str, ImageSequence], numbers: list[int], folder: Path
) -> Iterator[tuple[int, SceneOptions]]:
    """Yield the number and the options of each picture, as if it were alone.

    Args:
        scene: the scene of all shots.
        parts: the pictures ("input"), and their depth maps and masks, if any.
        numbers: of the pictures.
        folder: for the frames of videos.
    """
    for row in zip(*(part.pictures(numbers, _make(folder / name)) for name, part in parts.items())):
        paths = {name: path for name, (_, path) in zip(parts, row)}
        photo = scene.photo
        photo = replace(photo, depth=paths.get("depth", photo.depth), mask=paths.get("mask", photo.mask))
        yield row[0][0], replace(scene, input=paths["input"], photo=photo)


def _sources(
    scene: SceneOptions, parts: dict[str, ImageSequence], numbers: list[int], folder: Path
) -> Iterator[tuple[int, SceneOptions, SceneFile | ReadPhoto]]:
    """Yield what `_pictures` yields, and each picture as it is read. Raises InputError."""
    for number, own in _pictures(scene, parts, numbers, folder) if numbers else ():
        with _unheard(), named(f"frame {number}"):
            source = read_source(own)
        yield number, own, source


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    """Drop messages. Only those of the first picture are printed; the others would be the same."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


def _with_neighbours(
    sources: Iterator[tuple[int, SceneOptions, SceneFile | ReadPhoto]],
    photo: PhotoOptions,
    device: str,
    wanted: set[int],
) -> Iterator[tuple[int, SceneOptions, SceneFile | ReadPhoto]]:
    """Yield the wanted ones of pictures in a row, each with depths that are averaged with its neighbours'."""
    pending: dict[int, SceneOptions] = {}

    def photos() -> Iterator[tuple[int, ReadPhoto]]:
        for number, own, source in sources:
            assert isinstance(source, ReadPhoto)
            pending[number] = own
            yield number, source

    for number, source in steady_photos(photos(), photo, device):
        own = pending.pop(number)
        if number in wanted:
            yield number, own, source


def _film_of_pairs(
    scene: SceneOptions, parts: dict[str, ImageSequence], count: int, shown: int, folder: Path
) -> tuple[PhotoOptions, int]:
    """Return the options of a film of stereo pairs, with one scale of depth for all frames; others as they are.

    Also returns the number of a frame that shows the film: the given one, unless its eyes' pictures do not match.
    """
    from lightfield_gs.photo.stereo_matching import PairMismatch

    photo, pictures = scene.photo, parts["input"]
    path = next(_pictures(scene, {"input": pictures}, [shown], folder))[1].input
    layout = None if len(parts) > 1 or photo.stereo_in == "none" else layout_of_film(path, photo)
    if layout is None:
        return photo, shown
    if not pictures.files and photo.stereo_in is None:
        photo = replace(photo, pair=layout, swap_eyes=False)
    samples = {}
    for number, own in _pictures(replace(scene, photo=photo), parts, sample_numbers(count), folder):
        with _unheard(), named(f"frame {number}"), suppress(PairMismatch):
            if isinstance(source := read_source(own), ReadPhoto) and source.matched is not None:
                samples[number] = source
    if not samples:
        return photo, shown
    return replace(photo, film_parallax=film_parallax(samples.values())), shown if shown in samples else min(samples)


class _FlatFrames:
    """Frames of a film of pairs whose eyes' pictures do not match, as of black ones: they are shown flat."""

    def __init__(self) -> None:
        self.numbers: list[int] = []

    def look_at(self, number: int, source: SceneFile | ReadPhoto) -> None:
        """Note a frame that did not match."""
        if isinstance(source, ReadPhoto) and source.matched is not None and not source.matched.found.matched:
            self.numbers.append(number)

    def words(self) -> list[str]:
        """Return a line on these frames."""
        if not self.numbers:
            return []
        some = ", ".join(map(str, self.numbers[:5])) + (", ..." if len(self.numbers) > 5 else "")
        return [f"{len(self.numbers)} frames whose eyes' pictures do not match are shown flat: {some}"]


class _Renaming:
    """A stream in place of sys.stdout or sys.stderr that replaces names in the text."""

    def __init__(self, usual: Any, renamed: Callable[[str], str]):
        self._usual, self._renamed = usual, renamed

    def write(self, text: str) -> int:
        """Pass a text on."""
        self._usual.write(self._renamed(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._usual, name)


@contextlib.contextmanager
def _naming_videos(parts: dict[str, ImageSequence], folder: Path) -> Iterator[None]:
    """Have prints and errors name the videos, not the files of their frames in the folder."""
    names = {str(folder / name / f"{part.path.stem}.png"): str(part.path) for name, part in parts.items()}
    names |= {f"{part.path.stem}.png": part.path.name for part in parts.values() if not part.files}
    frame_name = re.compile(r"(?<![^\s('\"])(" + "|".join(map(re.escape, names)) + ")")

    def renamed(text: str) -> str:
        return frame_name.sub(lambda match: names[match[0]], text)

    try:
        with (
            contextlib.redirect_stdout(_Renaming(sys.stdout, renamed)),
            contextlib.redirect_stderr(_Renaming(sys.stderr, renamed)),
        ):
            yield
    except InputError as error:
        raise InputError(renamed(str(error))) from None


def _take_pairs(source: Path, photo: PhotoOptions, pictures: ImageSequence) -> tuple[PhotoOptions, list[str]]:
    """Take the depth maps beside the pictures in their folder, unless others are given; return a line on them too."""
    maps = pictures_and_maps(source)[1] if pictures.files else []
    if not maps:
        return photo, []
    first = f"{pictures.files[0].name} with {maps[0].name}"
    if photo.depth is not None:
        return photo, [f"{source}: its depth maps ({maps[0].name}, ...) are left out, as --depth gives others"]
    words = f"{source}: {pictures.count} pictures, each with the depth map beside it ({first})"
    return replace(photo, depth=source), [words]


def _find_half(
    photo: PhotoOptions, pictures: ImageSequence, count: int, folder: Path
) -> tuple[PhotoOptions, int, list[str]]:
    """Find the half that is the depth map, in pictures whose names say that one is.

    The first picture that shows the half decides, for other pictures may be black.

    Returns:
        The options with that half, the number of that picture (else 0), and a line on it.
    """
    named_ones = pictures.files or (pictures.path,)
    if photo.rgbd is not None or photo.depth is not None or not all(map(is_rgbd_name, named_ones)):
        return photo, 0, []
    for number, path in pictures.pictures(list(range(count)), _make(folder / "half")):
        if (side := depth_side(read_picture(path).pixels, is_named=True)) is not None:
            words = f"depth: the {side} half of each picture, as picture {number} shows it (assumed; --rgbd)"
            return replace(photo, rgbd=side), number, [words]
    return photo, 0, []


def _open_beside(name: str, path: Path, source: Path, count: int) -> ImageSequence:
    """Open the pictures of --depth or --mask, one for each of the sequence. Raises InputError."""
    if not path.is_dir() and not is_sequence(path):
        refuse_video(path)
        raise InputError(f"--{name}: expected a folder or a video, as {source} is a sequence, got {path}")
    pictures = open_sequence(path, maps=True)
    if pictures.count != count:
        raise InputError(
            f"--{name}: expected one for each of the {count} pictures of {source}, got {pictures.count} in {path}"
        )
    return pictures


def _make(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    return folder
