"""Files of a COLMAP model, binary and text: cameras, images, points3D, rigs and frames.

Source: COLMAP's documentation, "Output Format". Tracks and observations are skipped.

Binary files are little-endian: a uint64 count of records, then the records.
    cameras: id int32, model int32, width uint64, height uint64, then the model's parameters as float64.
    images: id uint32, quaternion 4 float64, translation 3 float64, camera uint32, name ending in 0, count of
        observations uint64, and for each x, y float64, point int64.
    points3D: id uint64, x y z float64, r g b uint8, error float64, track length uint64, and for each element image
        uint32, observation uint32.
    rigs: id uint32, sensor count uint32. The first sensor: kind int32, id uint32. Each other sensor: the same, a
        uint8 flag, and, if it is set, the rig-to-sensor pose as quaternion 4 float64, translation 3 float64.
    frames: id uint32, rig uint32, world-to-rig pose, count uint32 of images, and for each the sensor's kind int32,
        the sensor's id uint32 and the image's id uint64.

Text files have a record a line (images two), with numbers separated by spaces; lines that begin with # are comments.
    cameras: id, model, width, height, parameters.
    images: id, quaternion (4), translation (3), camera, name; then a line of observations, which may be empty.
    points3D: id, x, y, z, r, g, b, error, track.
    rigs: id, sensor count, kind and id of the first sensor; of each other sensor kind, id, and either 1 and the
        rig-to-sensor pose (7 numbers), or 0.
    frames: id, rig, world-to-rig pose (7 numbers), count of images, and for each the sensor's kind, the sensor's id
        and the image's id.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError, named, reading
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS
from lightfield_gs.io.captures.pinhole import pose_matrix
from lightfield_gs.io.text_files import read_text

_MAX_SIZE_PX = 1 << 20
_LONGEST_NAME = 4096  # longer than any path
_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
_POINT = struct.Struct("<Q3d3BdQ")
_COUNT, _SENSOR, _POSE = struct.Struct("<I"), struct.Struct("<iI"), struct.Struct("<4d3d")
_LIMIT_BYTES = 8 << 30


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of a COLMAP model.

    Attributes:
        model: name of its camera model.
        width_px, height_px: size of its images.
        intrinsics: [4] float64, (fx, fy, cx, cy) in pixels from the outer corner of the first.
        coefficients: of the model's formula, in COLMAP's order.
    """

    model: str
    width_px: int
    height_px: int
    intrinsics: np.ndarray
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """An image of a COLMAP model.

    Attributes:
        name: with / between folders. Bytes that are no UTF-8 are Python's surrogates until colmap.decode_names.
        camera: its camera's id.
        world_to_camera: [4,4] float64, OpenCV axes; None where the file has no pose.
        number: its id.
    """

    name: str
    camera: int
    world_to_camera: np.ndarray | None
    number: int = 0


Sensor = tuple[int, int]  # kind and id; of the kind CAMERA the id is a camera's

CAMERA = 0


@dataclass(frozen=True)
class ColmapFrame:
    """The images of one rig at one time.

    Attributes:
        rig: the rig's id.
        world_to_rig: [4,4] float64; None where it has no pose.
        images: ids of images by their sensors.
    """

    rig: int
    world_to_rig: np.ndarray | None
    images: dict[Sensor, int]


Rigs = dict[int, dict[Sensor, np.ndarray | None]]  # by id: rig to sensor [4,4] float64, None where unknown


def camera_record(model: str, width: int, height: int, parameters: Sequence[float]) -> ColmapCamera:
    """Make a camera from its parameters in COLMAP's order. Raises InputError where they make none."""
    if model not in COLMAP_MODELS:
        raise InputError(f"camera model: expected one of {', '.join(COLMAP_MODELS)}, got {shown(model)}")
    kind = COLMAP_MODELS[model]
    if len(parameters) != kind.parameters:
        raise InputError(f"camera of {model}: expected {kind.parameters} parameters, got {len(parameters)}")
    if not (1 <= width <= _MAX_SIZE_PX and 1 <= height <= _MAX_SIZE_PX):
        raise InputError(f"camera of {model}: expected a size of 1..{_MAX_SIZE_PX} pixels, got {width} x {height}")
    numbers = np.array(parameters, np.float64)
    if not (np.abs(numbers) < 1e12).all() or not (numbers[: kind.focal_lengths] > 0).all():
        raise InputError(
            f"camera of {model}: expected finite numbers and a focal length > 0, got {numbers.tolist()[:4]}"
        )
    focal = numbers[[0, kind.focal_lengths - 1]]
    centre = numbers[kind.focal_lengths : kind.focal_lengths + 2]
    coefficients = tuple(numbers[kind.focal_lengths + 2 :].tolist())
    return ColmapCamera(model, width, height, np.concatenate([focal, centre]), coefficients)


def image_record(
    name: str, camera: int, quaternion: Sequence[float], translation: Sequence[float], number: int = 0
) -> ColmapImage:
    """Make an image from a quaternion w, x, y, z of any length and a translation, world to camera.

    Raises InputError.
    """
    if not name.strip() or "\0" in name or len(name) > _LONGEST_NAME:
        raise InputError(f"images: expected the name of a photograph, got {shown(name)}")
    name = name if is_undecoded(name) else name.replace("\\", "/")  # in some code pages a backslash is half a letter
    return ColmapImage(name, camera, pose_matrix(quaternion, translation), number)


def is_undecoded(name: str) -> bool:
    """Return whether a name holds bytes that are no UTF-8, as surrogates."""
    return any("\ud800" <= letter <= "\udfff" for letter in name)


class _ByteReader:
    """Reads bytes from the front. Raises InputError where they end too early."""

    def __init__(self, data: bytes):
        self.data, self.offset = data, 0

    def take(self, form: struct.Struct) -> tuple:
        self.need(form.size)
        values = form.unpack_from(self.data, self.offset)
        self.offset += form.size
        return values

    def count(self, least_bytes: int) -> int:
        """Read a count of records; each record has at least this many bytes."""
        (count,) = self.take(struct.Struct("<Q"))
        self.need(count * least_bytes)
        return count

    def text(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise InputError("damaged: the name of a photograph does not end")
        raw, self.offset = self.data[self.offset : end], end + 1
        return raw.decode(errors="surrogateescape")

    def skip(self, count: int) -> None:
        self.need(count)
        self.offset += count

    def need(self, count: int) -> None:
        if count > len(self.data) - self.offset:
            raise InputError(
                f"damaged or cut: expected {count} more bytes at byte {self.offset}, got "
                f"{len(self.data) - self.offset}: copy the model again"
            )


def binary_cameras(data: bytes) -> list[tuple[int, ColmapCamera]]:
    """Read ids and cameras of a cameras.bin. Raises InputError."""
    names = {model.number: name for name, model in COLMAP_MODELS.items()}
    source, cameras = _ByteReader(data), []
    for _ in range(source.count(24)):
        number, model, width, height = source.take(struct.Struct("<iiQQ"))
        if model not in names:
            raise InputError(f"camera {number}: expected a model of {', '.join(COLMAP_MODELS)}, got number {model}")
        parameters = source.take(struct.Struct(f"<{COLMAP_MODELS[names[model]].parameters}d"))
        cameras.append((number, camera_record(names[model], width, height, parameters)))
    return cameras


def binary_images(data: bytes) -> list[ColmapImage]:
    """Read the images of an images.bin. Raises InputError."""
    source, images = _ByteReader(data), []
    form = struct.Struct("<I4d3dI")
    for _ in range(source.count(form.size + 9)):
        number, *pose, camera = source.take(form)
        name = source.text()
        source.skip(source.count(_OBSERVATION_BYTES) * _OBSERVATION_BYTES)
        images.append(image_record(name, camera, pose[:4], pose[4:], number))
    return images


def binary_points(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Read points [P,3] float64 and colours [P,3] uint8 of a points3D.bin. Raises InputError."""
    source = _ByteReader(data)
    count = source.count(_POINT.size)
    points, colours = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for index in range(count):
        values = source.take(_POINT)
        points[index], colours[index] = values[1:4], values[4:7]
        source.skip(values[8] * _TRACK_BYTES)
    return points, colours


def binary_rigs(data: bytes) -> Rigs:
    """Read the rigs of a rigs.bin. Raises InputError."""
    source = _ByteReader(data)
    rigs: Rigs = {}
    for _ in range(source.count(8)):
        number, count = source.take(struct.Struct("<II"))
        rigs[number] = {}
        for index in range(count):
            sensor = source.take(_SENSOR)
            pose = None
            if index and source.take(struct.Struct("<B"))[0]:
                numbers = source.take(_POSE)
                pose = pose_matrix(numbers[:4], numbers[4:])
            rigs[number][sensor] = pose if index else np.eye(4)
    return rigs


def binary_frames(data: bytes) -> list[ColmapFrame]:
    """Read the frames of a frames.bin. Raises InputError."""
    source, frames = _ByteReader(data), []
    for _ in range(source.count(68)):
        _, rig = source.take(struct.Struct("<II"))
        pose = source.take(_POSE)
        (count,) = source.take(_COUNT)
        seen = [source.take(struct.Struct("<iIQ")) for _ in range(count)]
        images = {(kind, sensor): image for kind, sensor, image in seen if kind == CAMERA}
        frames.append(ColmapFrame(rig, pose_matrix(pose[:4], pose[4:]), images))
    return frames


def text_cameras(text: str) -> list[tuple[int, ColmapCamera]]:
    """Read ids and cameras of a cameras.txt. Raises InputError."""
    cameras = []
    for number, line in _lines(text):
        words = line.split()
        if len(words) < 5:
            raise InputError(f"line {number}: expected number, model, width, height, parameters, got {shown(line)}")
        size = _parse_numbers(number, [words[0], *words[2:4]], int)
        cameras.append((size[0], camera_record(words[1], size[1], size[2], _parse_numbers(number, words[4:], float))))
    return cameras


def text_images(text: str) -> list[ColmapImage]:
    """Read the images of an images.txt.

    Some programs leave out the lines of observations, which is noted. Raises InputError.
    """
    images, lines = [], text.split("\n")
    line_number = without = 0
    while line_number < len(lines):
        line = lines[line_number].strip()
        line_number += 1
        if not line or line.startswith("#"):
            continue
        words = line.split(None, 9)  # a name may have spaces
        if len(words) < 10:
            raise InputError(f"line {line_number}: expected number, pose (7 numbers), camera, name, got {shown(line)}")
        number, camera = _parse_numbers(line_number, [words[0], words[8]], int)
        pose = _parse_numbers(line_number, words[1:8], float)
        images.append(image_record(words[9], camera, pose[:4], pose[4:], number))
        if line_number < len(lines) and _is_image_line(lines[line_number]):
            without += 1
        else:
            line_number += 1  # the line of observations, which may be empty
    if without:
        assume(
            f"{without} of {len(images)} photographs in images.txt have no line of observations: the next line is a "
            "photograph's"
        )
    return images


def _is_image_line(line: str) -> bool:
    """Return whether a line in the place of observations, which are three numbers each, is an image."""
    words = line.split(None, 9)
    if len(words) < 10 or not (_is_number(words[0], int) and _is_number(words[8], int)):
        return False
    if not all(_is_number(word, float) for word in words[1:8]):
        return False
    rest = words[9].split()
    return (9 + len(rest)) % 3 != 0 or not all(_is_number(word, float) for word in rest)


def text_points(text: str) -> tuple[np.ndarray, np.ndarray]:
    """Read points [P,3] float64 and colours [P,3] uint8 of a points3D.txt. Raises InputError."""
    points, colours = [], []
    for number, line in _lines(text):
        words = line.split(None, 7)
        if len(words) < 8:
            raise InputError(f"line {number}: expected number, x, y, z, r, g, b, error, track, got {shown(line)}")
        points.append(_parse_numbers(number, words[1:4], float))
        colours.append(_parse_numbers(number, words[4:7], int))
    found = np.array(colours, np.int64).reshape(-1, 3)
    if ((found < 0) | (found > 255)).any():
        raise InputError("expected colours of 0..255")
    return np.array(points, np.float64).reshape(-1, 3), found.astype(np.uint8)


def text_rigs(text: str) -> Rigs:
    """Read the rigs of a rigs.txt. Raises InputError."""
    rigs: Rigs = {}
    for line_number, line in _lines(text):
        words = iter(line.split())
        number, count = _take_numbers(line_number, words, 2, int)
        rigs[number] = {}
        for index in range(count):
            sensor = _take_sensor(line_number, words)
            pose = None
            if index and _take_numbers(line_number, words, 1, int)[0]:
                numbers = _take_numbers(line_number, words, 7, float)
                pose = pose_matrix(numbers[:4], numbers[4:])
            rigs[number][sensor] = pose if index else np.eye(4)
    return rigs


def text_frames(text: str) -> list[ColmapFrame]:
    """Read the frames of a frames.txt. Raises InputError."""
    frames = []
    for line_number, line in _lines(text):
        words = iter(line.split())
        _, rig = _take_numbers(line_number, words, 2, int)
        pose = _take_numbers(line_number, words, 7, float)
        images = {}
        for _ in range(_take_numbers(line_number, words, 1, int)[0]):
            sensor = _take_sensor(line_number, words)
            (image,) = _take_numbers(line_number, words, 1, int)
            if sensor[0] == CAMERA:
                images[sensor] = image
        frames.append(ColmapFrame(rig, pose_matrix(pose[:4], pose[4:]), images))
    return frames


def _take_sensor(line: int, words: Iterator[str]) -> Sensor:
    """Take the next two words as the kind and the id of a sensor. Raises InputError."""
    kind = next(words, "")
    return CAMERA if kind == "CAMERA" else CAMERA + 1, _take_numbers(line, words, 1, int)[0]


def _take_numbers(line: int, words: Iterator[str], count: int, kind: type) -> list:
    """Take the next words as numbers. Raises InputError where the line ends before."""
    found = list(islice(words, count))
    if len(found) < count:
        raise InputError(f"line {line}: expected {count - len(found)} more numbers: copy the model again")
    return _parse_numbers(line, found, kind)


def _lines(text: str) -> list[tuple[int, str]]:
    """Return numbers and contents of the lines that are neither empty nor comments."""
    lines = ((number, line.strip()) for number, line in enumerate(text.split("\n"), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _is_number(word: str, kind: type) -> bool:
    try:
        kind(word)
    except ValueError:
        return False
    return True


def _parse_whole(word: str) -> int:
    """Parse a whole number, also if written as 200.0. Raises ValueError."""
    try:
        return int(word)
    except ValueError:
        value = float(word)
        if not value.is_integer():
            raise ValueError(word) from None
        return int(value)


def _parse_numbers(line: int, words: list[str], kind: type) -> list:
    """Parse words as numbers, whole ones where `kind` is int. Raises InputError."""
    try:
        values = [_parse_whole(word) if kind is int else kind(word) for word in words]
    except (ValueError, OverflowError):
        wanted = "whole numbers" if kind is int else "numbers"
        raise InputError(f"line {line}: expected {wanted}, got {shown(' '.join(words))}") from None
    if kind is int and any(abs(value) >= 1 << 63 for value in values):
        raise InputError(f"line {line}: expected numbers of at most 63 bits, got {shown(' '.join(words))}")
    return values


_BINARY = {
    "cameras": binary_cameras,
    "images": binary_images,
    "points3D": binary_points,
    "rigs": binary_rigs,
    "frames": binary_frames,
}
_TEXT = {
    "cameras": text_cameras,
    "images": text_images,
    "points3D": text_points,
    "rigs": text_rigs,
    "frames": text_frames,
}


def read_model_file(path: Path, kind: str) -> Any:
    """Read one file of a model, binary or text by its suffix.

    Args:
        path: the file.
        kind: cameras, images, points3D, rigs or frames.

    Returns:
        The value of the function in _BINARY or _TEXT.

    Raises:
        InputError: names the file.
    """
    if path.suffix == ".txt":
        text = read_text(path, _LIMIT_BYTES, "text of a COLMAP model", errors="surrogateescape")
        if not text.strip():  # even an empty model has comments
            raise InputError(f"{path} is empty: copy the model again")
        with named(path):
            return _TEXT[kind](text)
    with reading(path):
        if path.stat().st_size > _LIMIT_BYTES:
            raise InputError(f"{path}: expected at most {_LIMIT_BYTES} bytes, got {path.stat().st_size}")
        data = path.read_bytes()
    with named(path):
        return _BINARY[kind](data)
