"""Scenes of pictures in a row: the first picture settles how all of them are taken, as `video` does for a film."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeVar, cast

import numpy as np
import torch

from lightfield_gs.app.cameras import read_camera
from lightfield_gs.app.options import AUTO, FLAT, CameraOptions, LookOptions, PhotoOptions, RenderOptions, SceneOptions
from lightfield_gs.app.photo import ReadPhoto, read_frame
from lightfield_gs.app.photo_depth import network_picture, steady_pictures
from lightfield_gs.app.photo_pair import has_other_way
from lightfield_gs.app.scene import build_scene, check_scene_options, frame_scene, read_source
from lightfield_gs.app.steady_photos import steady_photos
from lightfield_gs.app.stereo_film import film_parallax, layout_of_film
from lightfield_gs.base.cli_messages import Stopwatch, capture
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import StereoInput
from lightfield_gs.io.atomic import scratch_folder
from lightfield_gs.io.images import Picture, write_image
from lightfield_gs.live.depths import LiveDepths, settled_camera
from lightfield_gs.live.detail import LEAST_NETWORK_PX, Detail
from lightfield_gs.live.health import Health
from lightfield_gs.live.objects import LiveObjects
from lightfield_gs.live.rgbd_cameras import RgbdPicture
from lightfield_gs.live.slot import in_thread
from lightfield_gs.live.sources import Frame, Source
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.photo.background_memory import BackgroundMemory
from lightfield_gs.photo.cut_out import NoCutOut
from lightfield_gs.photo.detail_level import view_fraction
from lightfield_gs.photo.side_by_side import depth_side, is_rgbd_name
from lightfield_gs.photo.stereo_matching import PairMismatch
from lightfield_gs.photo.stereo_pair import can_match
from lightfield_gs.scene.gaussians import Gaussians

_T = TypeVar("_T")
_U = TypeVar("_U")
_REMEMBERED = "behind things: what was seen there before, while the camera stands still (else: --no-remember)"
_NOT_REMEMBERED = "behind things: smooth colours of what is beside them (--remember keeps what was seen there)"
_MEASURED = "measured.npy"  # the depths of a camera in a file, for its first picture
_PATIENCE_S = 3.0  # with pictures of which no scene can be made, at the beginning: cameras begin dark


class _NotYetError(InputError):
    """No scene can be made of a picture, and of a later one perhaps."""


class LiveScenes:
    """The scene of each picture of a source.

    Args:
        source: The source.
        photo: How its pictures are taken, as far as options say.
        render: How scenes are drawn.
        look: How they are framed.
        panel: The panel.
        device: Where networks and scenes are.
        detail: The size of the pictures.
        health: Counts times and pictures that cannot be used.
        remembers: Whether what a camera that stands still saw stays behind what is before it.

    Attributes:
        rig: Of all scenes, by the first picture.
        first: The picture by which it was settled, and its scene.
        messages: Lines on what the first picture settled.
    """

    rig: Rig
    first: tuple[Frame, Gaussians]

    def __init__(
        self,
        source: Source,
        photo: PhotoOptions,
        render: RenderOptions,
        look: LookOptions,
        panel: Panel,
        device: str,
        detail: Detail,
        health: Health,
        remembers: bool = True,
    ):
        self._source, self._photo, self._render, self._look = source, photo, render, look
        self._panel, self._device, self.detail, self._health = panel, device, detail, health
        self._name = Path(source.name)
        self._memory = BackgroundMemory() if remembers else None
        self._is_measured = False
        self.messages: list[str] = []

    @property
    def stage(self) -> str:
        """The name of what is done here: an object's network, or depth."""
        return "depth" if self._is_whole else "network"

    @property
    def _has_layers(self) -> bool:
        """Whether scenes are of two layers: of depths that are estimated, in a half of the picture, or measured."""
        return self._photo.is_estimated or self._photo.rgbd is not None or self._is_measured

    def settle(self, frames: Iterator[Frame]) -> None:
        """Settle by the first picture of which a scene can be made. Raises InputError where none comes in time."""
        until: float | None = None
        for frame in frames:
            until = until or time.monotonic() + _PATIENCE_S
            try:
                self.first = frame, self._settle_by(self._picture(frame))
                self.detail.count_after(frame.taken)
                return
            except _NotYetError:
                if time.monotonic() > until:
                    raise
        raise InputError(f"{self._source.name}: it ended before a picture came of which a scene can be made")

    def begin_now(self) -> None:
        """Count the first picture as taken now: that of a film which waited."""
        frame, gaussians = self.first
        self.first = replace(frame, taken=time.monotonic()), gaussians
        self.detail.count_after(self.first[0].taken)

    def __call__(self, frames: Iterator[Frame]) -> Iterator[tuple[Frame, Gaussians]]:
        """Yield the scene of each picture, with depths that are averaged with those before it, up to a cut.

        On CUDA the work is on a stream of its own, and finished when it is yielded.
        """
        taken: dict[int, Frame] = {}
        with self._stream() as finish:
            made = self._made(frames, taken)
            while (item := self._silently(made)) is not None:
                finish()
                self._health.end(self.stage)
                yield taken.pop(item[0]), item[1]

    @staticmethod
    def _silently(items: Iterator[_T]) -> _T | None:
        """Return the next item without what its making says: the first picture has said it. None: there is none."""
        with capture([]):
            return next(items, None)

    def _made(self, frames: Iterator[Frame], taken: dict[int, Frame]) -> Iterator[tuple[int, Gaussians]]:
        """Yield numbers and scenes; taken: where the frames are put by their numbers."""
        photo, device = self._photo, self._device
        if not self._is_whole:
            objects = LiveObjects(self._name, photo, self._panel, device)
            for number, cut in self._read(frames, taken, objects.read):
                yield number, objects(cut)
        elif self._has_layers:
            how = self._name, photo, self._look, self._panel, device, self._memory
            depths = LiveDepths(*how, self._is_measured, self.detail)
            yield from depths(self._read(frames, taken, depths.read))
        else:
            options = SceneOptions(self._name, photo=photo)
            into = self._render, self._look, self._panel, device
            photos = self._read(frames, taken, lambda picture: read_frame(self._name, picture, photo))
            for number, each in steady_photos(photos, photo, device, ahead=0):
                yield number, build_scene(options, each, *into, Stopwatch(0.0)).gaussians

    def _read(
        self, frames: Iterator[Frame], taken: dict[int, Frame], read: Callable[[Picture], _T]
    ) -> Iterator[tuple[int, _T]]:
        """Yield numbers of pictures and what is read of them; count the pictures of which nothing can be made.

        On CUDA the host's work has threads of its own. A CPU has no time to read what may be dropped.
        """
        if self._device == "cuda":
            pictures = in_thread("picture", self._each("picture", ((frame, frame) for frame in frames), self._picture))
            items = in_thread("read", self._each("reading", pictures, read))
        else:
            pictures = self._each(self.stage, ((frame, frame) for frame in frames), self._picture)
            items = self._each(self.stage, pictures, read)
        for frame, value in items:
            self._health.begin(self.stage, frame)
            taken[frame.number] = frame
            yield frame.number, value

    def _each(
        self, stage: str, items: Iterator[tuple[Frame, _U]], make: Callable[[_U], _T]
    ) -> Iterator[tuple[Frame, _T]]:
        """Yield what is made of items; the time counts for a stage."""
        for frame, item in items:
            self._health.begin(stage, frame)
            try:
                made = make(item)
            except InputError as error:
                reason = error.reason if isinstance(error, NoCutOut) else str(error)
                self._health.could_not_use(self._renamed(reason, self._name))
                self._health.end(stage)
                continue
            if stage != self.stage:  # else it goes on
                self._health.end(stage)
            yield frame, made

    @contextmanager
    def _stream(self) -> Iterator[Callable[[], None]]:
        """Work on a stream of CUDA of its own within the block; yield what waits for it.

        Its many small launches go before the drawing's few large ones, between which they would wait.
        """
        if self._device != "cuda":
            yield lambda: None
            return
        stream = torch.cuda.Stream(priority=-1)
        with torch.cuda.stream(stream):
            yield stream.synchronize

    def _picture(self, frame: Frame) -> Picture:
        picture = frame.picture(self.detail.scaling)
        self.detail.size_px = picture.pixels.shape[0], picture.pixels.shape[1]
        return picture

    def _settle_by(self, picture: Picture) -> Gaussians:
        """Return the scene of a picture that is taken as `video` takes the first of a film.

        It is taken from a file, by which `video` guesses what it is.
        """
        lines: list[str] = []
        with scratch_folder() as folder:
            kind = ".exr" if picture.pixels.dtype == np.float32 else ".png"
            path = folder / (re.sub(r"[^\w-]+", "_", self._name.stem)[-60:] + kind)
            write_image(path, picture.pixels)
            with self._naming(path), capture(lines):
                photo, messages = self._kind_of(path, picture)
                options = SceneOptions(path, photo=photo)
                check_scene_options(options, CameraOptions())
                read = read_source(options)
                assert isinstance(read, ReadPhoto)
                if read.matched is not None:
                    photo = replace(photo, film_parallax=film_parallax([read]))
                    read = replace(read, options=replace(read.options, film_parallax=photo.film_parallax))
                first = build_scene(options, read, self._render, self._look, self._panel, self._device, Stopwatch(0.0))
                rig, how = frame_scene(read_camera(CameraOptions(), self._panel), self._look, first, self._panel)
        assert first.photo is not None
        if first.photo.options.depth in (AUTO, FLAT):  # also where no object is cut out
            photo = replace(photo, depth=first.photo.options.depth)
        if first.photo.placed is not None:
            photo = replace(photo, fit=first.photo.placed.fit, fov=first.photo.options.fov)
        if photo.rgbd is not None or read.matched is not None:
            self.detail.take_halves(is_nearest=photo.rgbd is not None)
        self.rig, self.drawn_as, self._is_whole = rig, first.render, first.photo.is_whole
        self._render = replace(self._render, background=first.render.background)
        self._photo = photo if photo.stereo_in else replace(photo, stereo_in="none")
        how.append("framing: all pictures as the first")
        if self._is_whole and self._has_layers:
            how.append(_REMEMBERED if self._memory is not None else _NOT_REMEMBERED)
        if self._is_whole and (self._has_layers or self._photo.depth == FLAT):
            focal, _ = settled_camera(self._photo, *read.photo.size)
            self.detail.limit(rig.focal_px[0] / focal[0] * view_fraction(self._panel))
        if not self._is_whole and self._device == "cuda":
            self.detail.take_whole()
        is_open = self.detail.most_network_px is None
        if self._is_whole and self._photo.depth == AUTO and self._device == "cpu" and is_open:
            how += self._foreseen(picture)
        self.messages = [self._renamed(line, path) for line in [*lines, *messages, *first.messages, *how]]
        return first.gaussians

    def _foreseen(self, picture: Picture) -> list[str]:
        """Let the network for depths see a small picture, and return lines on what it may see from then on.

        On a GPU a small picture says nothing: most of its time are launches.
        """
        side, device = (lambda seen: min(seen.shape[:2])), self._device
        own, small = (network_picture(picture.pixels, self._photo, device, px) for px in (None, LEAST_NETWORK_PX))
        if side(small) >= side(own):  # a network of one size, or one that sees less by itself
            return []
        for _ in range(2):  # the first time takes longer
            began = time.perf_counter()
            next(steady_pictures([(0, small)], self._photo, device))
            took = time.perf_counter() - began
        return self.detail.foresee_network(side(own), side(small), took)

    def _kind_of(self, path: Path, picture: Picture) -> tuple[PhotoOptions, list[str]]:
        """Return the options with what a picture in a file is: a pair, or a photo with its depth map beside it."""
        photo, pair = replace(self._photo, is_in_row=True, is_smooth=True), self._source.pair
        if isinstance(picture, RgbdPicture) and picture.z is not None and not has_other_way(photo):
            self._is_measured = True
            depth = path.with_name(_MEASURED)
            np.save(depth, picture.z)
            camera = *picture.focal_px, *picture.centre_px
            return replace(photo, depth=depth, depth_kind="distance", intrinsics=camera), []
        if photo.depth is None and photo.rgbd is None and is_rgbd_name(path):
            side = depth_side(picture.pixels, is_named=True)
            if side is not None:
                return replace(photo, rgbd=side), [f"depth: the {side} half of each picture (assumed; --rgbd)"]
        if pair is None or photo.stereo_in is not None or has_other_way(photo) or not can_match():
            pair = layout_of_film(path, photo)
        if pair is None:
            return photo, []
        is_said = photo.stereo_in is not None
        photo = replace(photo, stereo_in=cast(StereoInput, pair.kind), swap_eyes=pair.is_swapped)
        return photo, [] if is_said else [f"stereo: two eyes' pictures by {pair.source} (else: --stereo-in none)"]

    @contextmanager
    def _naming(self, path: Path) -> Iterator[None]:
        """Name the source, not a file, in errors; raise _NotYetError where another picture may do."""
        try:
            yield
        except NoCutOut as error:
            raise _NotYetError(
                f"{self._renamed(error.reason, path)}; give --depth auto for the whole picture in depth, or "
                "--remove-background for who is before the camera (both take pip install 'lightfield-gs[photo]'), or "
                "--depth flat for the picture as it is"
            ) from None
        except PairMismatch as error:
            raise _NotYetError(self._renamed(str(error), path)) from None
        except InputError as error:
            raise InputError(self._renamed(str(error), path)) from None

    def _renamed(self, words: str, path: Path) -> str:
        words = words.replace(f"depth by {_MEASURED}", "depth by the camera")
        return words.replace(f"{path}: ", "").replace(str(path), self._source.name)
