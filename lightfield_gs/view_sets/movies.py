"""Videos and animated GIF, WebP, PNG and AVIF files, frame by frame, and their frames as views."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.file_kinds import VIDEO_INPUTS, refuse_large_non_image
from lightfield_gs.io.images import MAX_PIXELS, Picture
from lightfield_gs.io.pillow_images import pillow_errors
from lightfield_gs.panels.panel import MAX_VIEWS
from lightfield_gs.video.sequence import ImageSequence, open_sequence
from lightfield_gs.view_sets.pixels import ViewColours, plays_back_and_forth, thumbnail

_ANIMATIONS = (".gif", ".webp", ".png", ".apng", ".avif")
_ANIMATED_BIT = 2  # of the flags of a WebP's VP8X chunk
_MOST_TO_AND_FRO = 1000  # frames: longer movies are not compared with their reverse
_SLOWEST_MS = 100  # of a frame with duration 0, as in browsers


@dataclass(frozen=True)
class FrameRange:
    """A range of frames: from `first` on by `step`, up to and including `last`; None: to the end."""

    first: int = 0
    last: int | None = None
    step: int = 1

    def numbers(self, count: int) -> range:
        """Return the frames of `count` in this range."""
        return range(self.first, count if self.last is None else min(count, self.last + 1), self.step)


class Movie:
    """The frames of a video or an animation. Conversions of a video's frames are noted.

    Args:
        path: the file.
        in_time: see decoding.timeline.

    Attributes:
        fps: frames a second; None where the file does not tell.
        count: of all frames, as the file tells.

    Raises:
        InputError: for a file that cannot be read.
    """

    def __init__(self, path: Path, in_time: bool):
        self.path = path
        self._video: ImageSequence | None = None
        if path.suffix.lower() in VIDEO_INPUTS:
            self._video = open_sequence(path, in_time=in_time)
            self.count, self.fps = self._video.count, self._video.fps
            for words in self._video.notes:
                assume(words)
        else:
            self.count, self.fps = _animation_header(path)

    def frames(self, numbers: range) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the frames of these numbers, [H, W, C], as far as they exist. Raises InputError."""
        if self._video is not None:
            yield from self._video.frames(numbers)
            return
        for number, pixels in enumerate(_animation(self.path)):
            if number in numbers:
                yield number, pixels
            if not numbers or number >= numbers[-1]:
                return


class FrameViews:
    """Frames of a movie as views, the left-most camera's first, kept in a temporary file.

    Args:
        movie: the movie.
        span: the range of frames, each a view.
        colours: converts them.
        right_to_left: whether the first frame is the right-most camera's.

    Raises:
        InputError: where there are too few or too many frames.
    """

    def __init__(self, movie: Movie, span: FrameRange, colours: ViewColours, right_to_left: bool = False):
        numbers = span.numbers(movie.count)
        if not 2 <= len(numbers) <= MAX_VIEWS:
            raise InputError(
                f"{movie.path}: expected 2..{MAX_VIEWS} frames as views, got {len(numbers)} of its {movie.count}"
            )
        self._file = tempfile.TemporaryFile(prefix="lightfield-gs-")
        self.count, shape, last = 0, (0, 0, 0), 0
        for last, pixels in movie.frames(numbers):
            view = colours.convert(Picture(pixels), movie.path)
            if self.count and view.shape != shape:
                raise InputError(f"{movie.path}: its frame {last} is {view.shape[1]} x {view.shape[0]}, others are not")
            shape = view.shape
            self._file.write(view.tobytes())
            self.count += 1
        if self.count < 2:
            raise InputError(f"{movie.path}: expected 2 frames at least, got {self.count}; it is cut")
        self._file.flush()
        self._views = np.memmap(self._file, np.uint8, "r", shape=(self.count, *shape))
        self.height_px, self.width_px = shape[:2]
        self.first_frame, self.last_frame = numbers[0], last
        self._right_to_left = right_to_left
        if self.count <= _MOST_TO_AND_FRO and plays_back_and_forth([thumbnail(view) for view in self._views]):
            assume(
                f"the frames of {movie.path} go one way across the views, though they seem to go there and back; "
                f"one way may be span={numbers[0]}:{numbers[self.count // 2]}:{span.step}"
            )

    def view(self, number: int) -> np.ndarray:
        """Return a view, [H, W, 3] uint8."""
        return np.array(self._views[self.count - 1 - number if self._right_to_left else number])


def is_movie(path: Path) -> bool:
    """Return whether a file is a video by its name, or an animation of several frames."""
    if path.suffix.lower() in VIDEO_INPUTS:
        return True
    return path.suffix.lower() in _ANIMATIONS and _animation_header(path)[0] > 1


def _animation_header(path: Path) -> tuple[int, Fraction | None]:
    """Return the number of frames of an image file, and frames a second; 1, None where it is no animation."""
    from PIL import Image

    with contextlib.suppress(InputError), pillow_errors(str(path)):  # the reader of images reports it
        refuse_large_non_image(path)
        with path.open("rb") as file:
            start = file.read(32)
        if start[:4] == b"RIFF" and not (start[12:16] == b"VP8X" and start[20] & _ANIMATED_BIT):
            return 1, None
        with Image.open(path) as image:
            count = getattr(image, "n_frames", 1)
            milliseconds = image.info.get("duration", 0) or _SLOWEST_MS
            return count, Fraction(1000, max(1, round(milliseconds))) if count > 1 else None
    return 1, None


def _animation(path: Path) -> Iterator[np.ndarray]:
    """Yield the composed frames of an animation, uint8 [H, W, 3 or 4]. Raises InputError."""
    from PIL import Image, ImageSequence

    words = f"{path} is no animation that can be read"
    with pillow_errors(words):
        image = Image.open(path)
    with image:
        if image.width * image.height > MAX_PIXELS:
            raise InputError(f"{path}: {image.width} x {image.height} pixels; expected at most {MAX_PIXELS}")
        frames = ImageSequence.Iterator(image)
        while True:
            with pillow_errors(words):
                frame = next(frames, None)
                pixels = None if frame is None else np.asarray(frame.convert("RGBA"))
            if pixels is None:
                return
            yield pixels
