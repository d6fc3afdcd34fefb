"""COLMAP's text files: a record a line (of images two), numbers apart by spaces; lines that begin with # are comments.

cameras.txt: number, model, width, height, parameters. images.txt: number, quaternion (4), translation (3), camera,
name; then a line of the photograph's observations, which may be empty. points3D.txt: number, x, y, z, r, g, b, error,
track. rigs.txt: number, count of sensors, kind and number of the first, and of each other kind, number, 1 and the pose
(7 numbers) rig to sensor, or 0. frames.txt: number, rig, pose (7 numbers) world to rig, count of what was seen, and of
each the sensor's kind and number and the photograph's number.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.colmap_records import (
    CAMERA,
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    Rigs,
    Sensor,
    camera_record,
    image_record,
    pose_of,
)


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
    """The photographs of an images.txt. Some programs leave out the lines of observations, which is said. Raises
    InputError."""
    images, lines = [], text.split("\n")
    place = without = 0
    while place < len(lines):
        line = lines[place].strip()
        place += 1
        if not line or line.startswith("#"):
            continue
        words = line.split(None, 9)  # a name may have spaces
        if len(words) < 10:
            raise InputError(f"line {place}: expected number, pose (7 numbers), camera, name, got {shown(line)}")
        number, camera = _numbers(place, [words[0], words[8]], int)
        pose = _numbers(place, words[1:8], float)
        images.append(image_record(words[9], camera, pose[:4], pose[4:], number))
        if place < len(lines) and _is_photograph(lines[place]):
            without += 1
        else:
            place += 1  # its observations, even where there are none
    if without:
        assume(
            f"{without} of {len(images)} photographs in images.txt have no line of observations: the next line is a "
            "photograph's"
        )
    return images


def _is_photograph(line: str) -> bool:
    """Whether a line where observations are expected is a photograph's: these are three numbers each."""
    words = line.split(None, 9)
    if len(words) < 10 or not (_is_number(words[0], int) and _is_number(words[8], int)):
        return False
    if not all(_is_number(word, float) for word in words[1:8]):
        return False
    rest = words[9].split()
    return (9 + len(rest)) % 3 != 0 or not all(_is_number(word, float) for word in rest)


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


def text_rigs(text: str) -> Rigs:
    """The rigs of a rigs.txt. Raises InputError."""
    rigs: Rigs = {}
    for place, line in _lines(text):
        words = iter(line.split())
        number, count = _taken(place, words, 2, int)
        rigs[number] = {}
        for index in range(count):
            sensor = _sensor(place, words)
            pose = None
            if index and _taken(place, words, 1, int)[0]:
                numbers = _taken(place, words, 7, float)
                pose = pose_of(numbers[:4], numbers[4:])
            rigs[number][sensor] = pose if index else np.eye(4)
    return rigs


def text_frames(text: str) -> list[ColmapFrame]:
    """The frames of a frames.txt. Raises InputError."""
    frames = []
    for place, line in _lines(text):
        words = iter(line.split())
        _, rig = _taken(place, words, 2, int)
        pose = _taken(place, words, 7, float)
        images = {}
        for _ in range(_taken(place, words, 1, int)[0]):
            sensor = _sensor(place, words)
            (image,) = _taken(place, words, 1, int)
            if sensor[0] == CAMERA:
                images[sensor] = image
        frames.append(ColmapFrame(rig, pose_of(pose[:4], pose[4:]), images))
    return frames


def _sensor(line: int, words: Iterator[str]) -> Sensor:
    """The kind and the number of a sensor, the next two words; raises InputError."""
    kind = next(words, "")
    return CAMERA if kind == "CAMERA" else CAMERA + 1, _taken(line, words, 1, int)[0]


def _taken(line: int, words: Iterator[str], count: int, kind: type) -> list:
    """The next words as numbers; raises InputError where the line ends before."""
    found = list(islice(words, count))
    if len(found) < count:
        raise InputError(f"line {line}: expected {count - len(found)} more numbers: copy the model again")
    return _numbers(line, found, kind)


def _lines(text: str) -> list[tuple[int, str]]:
    """Numbers and contents of the lines that say something."""
    lines = ((number, line.strip()) for number, line in enumerate(text.split("\n"), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _is_number(word: str, kind: type) -> bool:
    try:
        kind(word)
    except ValueError:
        return False
    return True


def _whole(word: str) -> int:
    """A whole number, also one that was written as 200.0; raises ValueError."""
    try:
        return int(word)
    except ValueError:
        value = float(word)
        if not value.is_integer():
            raise ValueError(word) from None
        return int(value)


def _numbers(line: int, words: list[str], kind: type) -> list:
    """`words` as numbers, whole ones where `kind` is int; raises InputError."""
    try:
        values = [_whole(word) if kind is int else kind(word) for word in words]
    except (ValueError, OverflowError):
        wanted = "whole numbers" if kind is int else "numbers"
        raise InputError(f"line {line}: expected {wanted}, got {shown(' '.join(words))}") from None
    if kind is int and any(abs(value) >= 1 << 63 for value in values):
        raise InputError(f"line {line}: expected numbers of at most 63 bits, got {shown(' '.join(words))}")
    return values
