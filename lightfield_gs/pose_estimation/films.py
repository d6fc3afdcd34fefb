"""Frames of films that are worth posing: one of each step of parallax, the sharpest."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError
from lightfield_gs.pose_estimation.parallax import ParallaxSteps
from lightfield_gs.pose_estimation.sharpness import find_blurred, relative_sharpness, small_grey, structure_tensor
from lightfield_gs.video.decoding import decode
from lightfield_gs.video.sequence import open_sequence

_MOST_LOOKED_AT = 3000  # frames of a film; of longer ones every second, third, ... is looked at
_FPS = 30.0  # frames a second that are looked at
_REACH = 30  # frames to either side that sharpness is compared with: a second
_FEWEST = 3  # frames; fewer cannot be posed


@dataclass(frozen=True)
class ChosenPictures:
    """Pictures of a row, which a camera took on its way.

    Attributes:
        indices: of the chosen ones, increasing.
        steps: of parallax.
        blurred: number of blurred pictures.
    """

    indices: list[int]
    steps: int
    blurred: int


def choose_pictures(pictures: Iterable[np.ndarray], most: int, keep_blurred: bool) -> ChosenPictures:
    """Choose the sharpest picture of each step of parallax.

    Steps are joined where there are more than `most`. A step of which all pictures are blurred has none.

    Args:
        pictures: uint8 [H,W,3 or 4], in the order in which they were taken.
        most: of the chosen ones.
        keep_blurred: whether blurred pictures may be chosen.
    """
    steps, begins, tensors = ParallaxSteps(), [], []
    for picture in pictures:
        grey = small_grey(picture)
        begins.append(steps.begins(grey))
        tensors.append(structure_tensor(grey))
    step = np.cumsum(begins) - 1
    count = int(step[-1]) + 1 if len(step) else 0
    group = step * min(most, count) // max(count, 1)
    sharpness = relative_sharpness(tensors, _REACH)
    blurred = find_blurred(sharpness)
    may_be = np.ones(len(step), bool) if keep_blurred else ~blurred
    groups = [np.flatnonzero((group == number) & may_be) for number in range(min(most, count))]
    indices = [int(members[np.argmax(sharpness[members])]) for members in groups if len(members)]
    return ChosenPictures(indices, count, int(blurred.sum()))


def write_film_frames(film: Path, folder: Path, most: int, keep_blurred: bool, progress: Callable[[str], None]) -> int:
    """Choose frames of a film, and write them to a folder as JPEG files.

    They are upright and in the colours of sRGB; frame-000123.jpg is the one after 123 others. See choose_pictures.

    Args:
        film: the video.
        folder: an empty folder.
        most: frames.
        keep_blurred: whether blurred frames may be among them.
        progress: called with a message.

    Returns:
        The number of frames written.

    Raises:
        InputError: PyAV or OpenCV is missing, the file is no video, or its frames are too few or show no motion.
    """
    seen = open_sequence(film, in_time=False)
    every = max(round(float(seen.fps or _FPS) / _FPS), -(-seen.count // _MOST_LOOKED_AT), 1)
    progress(f"looks for steps of parallax and for sharp frames among the {seen.count} of {film.name}")
    for note in seen.notes:
        assume(note)
    looked_at = (frame for index, frame in enumerate(decode(film)) if index % every == 0)
    chosen = choose_pictures(looked_at, most, keep_blurred)
    if chosen.steps < _FEWEST:
        raise InputError(
            f"{film}: expected a film of a camera that moves past things that stand still, got one whose "
            f"{seen.count} frames show no parallax: walk sideways along an arc, and keep the scene in view"
        )
    _note_choice(film.name, -(-seen.count // every), chosen, keep_blurred)
    for number, pixels in seen.frames([index * every for index in chosen.indices]):
        Image.fromarray(pixels[..., :3]).save(folder / f"frame-{number:06d}.jpg", quality=95, subsampling=0)
    return len(chosen.indices)


def _note_choice(name: str, count: int, chosen: ChosenPictures, keep_blurred: bool) -> None:
    words = f"{name}: {len(chosen.indices)} of {count} frames are taken, the sharpest of each step of parallax"
    words += " (frames=N takes N at most)"
    if chosen.blurred and not keep_blurred:
        words += f"; {counted(chosen.blurred, 'frame', does='are blurred and left out')} (keep_blurred=True keeps them)"
    assume(words)
