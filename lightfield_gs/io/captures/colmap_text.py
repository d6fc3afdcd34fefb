"""COLMAP's text files: a record a line (of images two), numbers apart by spaces; lines that begin with # are comments.

cameras.txt: number, model, width, height, parameters. images.txt: number, quaternion (4), translation (3), camera,
name; then a line of the photograph's observations, which may be empty. points3D.txt: number, x, y, z, r, g, b, error,
track.
"""

from __future__ import annotations

import numpy as np

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.colmap_records import ColmapCamera, ColmapImage, camera_record, image_record


def text_cameras(text: str) -> list[tuple[int, ColmapCamera]]:
    """Numbers and cameras of a cameras.txt. Raises InputError."""
    cameras = []
    for number, line in _lines(text):
        words = line.split()
        if len(words) < 5:
            raise InputError(f"line {number}: expected number, model, width, height, parameters, got {shown(line)}")
        size = _numbers(number, [words[0], *words[2:4]], int)
        cameras.append((size[0], camera_record(words[1], size[1], size[2], _numbers(number, words[4:], float))))
    return cameras


def text_images(text: str) -> list[ColmapImage]:
    """The photographs of an images.txt. Raises InputError."""
    images, lines = [], text.split("\n")
    place = 0
    while place < len(lines):
        line = lines[place].strip()
        place += 1
        if not line or line.startswith("#"):
            continue
        words = line.split(None, 9)  # a name may have spaces
        if len(words) < 10:
            raise InputError(f"line {place}: expected number, pose (7 numbers), camera, name, got {shown(line)}")
        _, camera = _numbers(place, [words[0], words[8]], int)
        pose = _numbers(place, words[1:8], float)
        images.append(image_record(words[9], camera, pose[:4], pose[4:]))
        place += 1  # its observations, even where there are none
    return images


def text_points(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] float64 and colours [P,3] uint8 of a points3D.txt. Raises InputError."""
    points, colours = [], []
    for number, line in _lines(text):
        words = line.split(None, 7)
        if len(words) < 8:
            raise InputError(f"line {number}: expected number, x, y, z, r, g, b, error, track, got {shown(line)}")
        points.append(_numbers(number, words[1:4], float))
        colours.append(_numbers(number, words[4:7], int))
    found = np.array(colours, np.int64).reshape(-1, 3)
    if ((found < 0) | (found > 255)).any():
        raise InputError("expected colours of 0..255")
    return np.array(points, np.float64).reshape(-1, 3), found.astype(np.uint8)


def _lines(text: str) -> list[tuple[int, str]]:
    """Numbers and contents of the lines that say something."""
    lines = ((number, line.strip()) for number, line in enumerate(text.split("\n"), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _numbers(line: int, words: list[str], kind: type) -> list:
    """`words` as numbers; raises InputError."""
    try:
        values = [kind(word) for word in words]
    except ValueError:
        raise InputError(f"line {line}: expected numbers, got {shown(' '.join(words))}") from None
    if kind is int and any(abs(value) >= 1 << 63 for value in values):
        raise InputError(f"line {line}: expected numbers of at most 63 bits, got {shown(' '.join(words))}")
    return values
