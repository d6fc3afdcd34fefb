"""Where live pictures come from: a camera, the screen, a stream, a film at its own rate, or a folder that grows."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import Picture, read_picture
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.live.cameras import Device
from lightfield_gs.video.decoding import (
    PixelKind,
    Scaling,
    av_library,
    frame_pixels,
    frames_of,
    open_input,
    open_video,
    pair_layout,
)
from lightfield_gs.video.sequence import PICTURES

_TIMEOUTS_S = 10.0, 5.0  # to open a stream, and to read from it
_LATE_S = 0.5  # behind its time from which on a film goes on from where it is
_POLL_S = 0.03  # between two looks into a folder
_UNFINISHED_S = 2.0  # after which a picture that cannot be read is not one that is still being written


@dataclass(frozen=True)
class Frame:
    """A picture of a source.

    Attributes:
        number: How many came before it.
        taken: When it reached the program, seconds of time.monotonic; of a folder, when its file was written since.
        picture: Returns its pixels, reduced as it is told.
    """

    number: int
    taken: float
    picture: Callable[[Scaling], Picture]


class Source(Protocol):
    """A source of pictures.

    Attributes:
        name: For messages.
        ends: Whether its end is the end: a film's is, a camera's is a failure.
        pair: Where a picture has two eyes' pictures, as its metadata says; known with its first frame.
    """

    name: str
    ends: bool
    pair: PairLayout | None

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        """Open it, and yield its pictures as they come, until stop is set. Raises InputError where it fails."""


class _Clock:
    """Waits until frames are due by their times in a film."""

    def __init__(self) -> None:
        self._start: float | None = None

    def wait(self, at: float, stop: threading.Event) -> None:
        now = time.monotonic()
        if self._start is None or now - self._start - at > _LATE_S:
            self._start = now - at
        stop.wait(max(0.0, self._start + at - now))


class _Decoded:
    """Frames of FFmpeg, numbered over all that were opened."""

    def __init__(self, name: str, ends: bool):
        self.name, self.ends = name, ends
        self.pair: PairLayout | None = None
        self._count = 0

    def _yield(
        self,
        container: Any,
        stream: Any,
        stop: threading.Event,
        is_timed: bool,
        crop: tuple[int, int, int, int] | None = None,
    ) -> Iterator[Frame]:
        clock, kind = _Clock(), PixelKind.of(stream)
        if not is_timed:
            stream.thread_type = "SLICE"  # threads of whole frames would each hold one back
        for frame in _patient(container, stream, stop):
            if self._count == 0:
                self.pair = pair_layout(frame)
            if is_timed and frame.time is not None:
                clock.wait(frame.time, stop)
            if stop.is_set():
                return
            yield Frame(self._count, time.monotonic(), partial(decoded_picture, frame, kind, crop))
            self._count += 1


def _patient(container: Any, stream: Any, stop: threading.Event) -> Iterator[Any]:
    """Yield frames of PyAV, and ask again where a device has none yet."""
    av = av_library("a camera")
    while not stop.is_set():
        try:
            yield from frames_of(container, stream)
            return
        except av.BlockingIOError:  # of macOS's cameras
            time.sleep(0.002)


def decoded_picture(frame: Any, kind: PixelKind, crop: tuple[int, int, int, int] | None, scaling: Scaling) -> Picture:
    """Return the picture of a frame of PyAV; crop: see Device."""
    if crop is None:
        return Picture(frame_pixels(frame, kind, scaling=scaling))
    left, top, width, height = crop
    return Picture(reduced(frame_pixels(frame, kind)[top : top + height, left : left + width], scaling))


class FilmSource(_Decoded):
    """A video file at its own rate."""

    def __init__(self, path: Path, is_looped: bool = False):
        super().__init__(str(path), ends=True)
        self._path, self._is_looped = path, is_looped

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        """See Source."""
        while True:
            before = self._count
            with open_video(self._path) as (container, stream):
                yield from self._yield(container, stream, stop, is_timed=True)
            if self._count == before and not stop.is_set():
                raise InputError(f"{self._path}: expected a video, got one without frames")
            if not self._is_looped or stop.is_set():
                return


class StreamSource(_Decoded):
    """A stream of an address. One that states its length is a film, and comes at its own rate."""

    def __init__(self, address: str):
        super().__init__(re.sub(r"//[^/@]*@", "//", address), ends=False)  # without name and password
        self._address = address

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        """See Source."""
        # Over HTTP nobuffer would lose a film's beginning
        options = {} if self._address.lower().startswith("http") else {"fflags": "nobuffer"}
        if self._address.lower().startswith("rtsp"):
            options["rtsp_transport"] = "tcp"
        with open_input(self._address, self.name, options=options, timeout=_TIMEOUTS_S) as (container, stream):
            self.ends = container.duration is not None
            yield from self._yield(container, stream, stop, is_timed=self.ends)


class DeviceSource(_Decoded):
    """A camera, or a screen."""

    def __init__(self, device: Device):
        super().__init__(device.name, ends=False)
        self._device = device

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        """See Source."""
        with ExitStack() as stack:
            container, stream = self._agreed(stack)
            yield from self._yield(container, stream, stop, is_timed=False, crop=self._device.crop)

    def _agreed(self, stack: ExitStack) -> tuple[Any, Any]:
        """Open the device with the first options that it agrees to. Raises InputError where it agrees to none."""
        device, refused = self._device, list[InputError]()
        for options in device.wishes:
            try:
                return stack.enter_context(open_input(device.address, device.name, device.format, options))
            except InputError as error:
                refused.append(error)
        raise refused[0]


class FolderSource:
    """A folder that grows: its newest picture that is complete."""

    def __init__(self, path: Path):
        self.name, self.ends, self._path = str(path), False, path
        self.pair: PairLayout | None = None
        self._count, self._shown, self._opened = 0, (0, ""), time.time()

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        """See Source."""
        since: tuple[tuple[int, str], float] | None = None  # a picture that cannot be read yet, and when it was found
        while not stop.wait(_POLL_S):
            newest = self._newest()
            if newest is None or newest <= self._shown:
                continue
            try:
                picture = read_picture(self._path / newest[1])
            except InputError:
                now = time.monotonic()
                if since is None or since[0] != newest:
                    since = newest, now
                if now - since[1] < _UNFINISHED_S:
                    continue
                self._shown = newest
                raise
            self._shown = newest
            age = max(0.0, time.time() - max(self._opened, newest[0] / 1e9))
            yield Frame(self._count, time.monotonic() - age, partial(_reduced_picture, picture))
            self._count += 1

    def _newest(self) -> tuple[int, str] | None:
        """Return when the newest picture was written, ns, and its name."""
        try:
            files = [one for one in self._path.iterdir() if one.suffix.lower() in PICTURES and one.name[0] != "."]
            return max(((one.stat().st_mtime_ns, one.name) for one in files), default=None)
        except FileNotFoundError as error:
            if self._path.is_dir():  # a picture was taken away
                return None
            raise InputError(f"{self._path}: the folder is gone ({error.strerror})") from None


def _reduced_picture(picture: Picture, scaling: Scaling) -> Picture:
    return replace(picture, pixels=reduced(picture.pixels, scaling))


def reduced(pixels: np.ndarray, scaling: Scaling) -> np.ndarray:
    """Return pixels [H, W, C] of any type with no more pixels than these, averaged or the nearest each."""
    height, width = pixels.shape[:2]
    size = scaling.size(height, width)
    if size == (height, width):
        return pixels
    how = "nearest-exact" if scaling.is_nearest else "area"
    values = torch.from_numpy(pixels.astype(np.float32)).movedim(2, 0)[None]
    small = torch.nn.functional.interpolate(values, size=size, mode=how)[0].movedim(0, 2).numpy()
    return small if pixels.dtype == np.float32 else np.rint(small).astype(pixels.dtype)
