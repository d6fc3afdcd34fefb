"""COLMAP's binary files, little-endian: a count of 8 bytes, then so many records.

cameras: number int32, model int32, width uint64, height uint64, then the model's parameters as float64.
images: number uint32, quaternion 4 float64, translation 3 float64, camera uint32, name ending in 0, count of
observations uint64, and each of these as x, y float64, point int64.
points3D: number uint64, x y z float64, r g b uint8, error float64, length of the track uint64, and each of its elements
as image uint32, observation uint32.
rigs: number uint32, count of sensors uint32; of the first its kind int32 and number uint32; of each other the same, a
uint8 that says whether a pose follows, and that, rig to sensor: quaternion 4 float64, translation 3 float64.
frames: number uint32, rig uint32, world to rig as a pose, count uint32 of what was seen, and of each the sensor's kind
int32, its number uint32, and the photograph's number uint64.
"""

from __future__ import annotations

import struct

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS
from lightfield_gs.io.captures.colmap_records import (
    CAMERA,
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    Rigs,
    camera_record,
    image_record,
    pose_of,
)

_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
_POINT = struct.Struct("<Q3d3BdQ")
_COUNT, _SENSOR, _POSE = struct.Struct("<I"), struct.Struct("<iI"), struct.Struct("<4d3d")


class _Bytes:
    """Bytes of a file, read from the front. Raises InputError where they end too early."""

    def __init__(self, data: bytes):
        self.data, self.place = data, 0

    def take(self, form: struct.Struct) -> tuple:
        self.need(form.size)
        values = form.unpack_from(self.data, self.place)
        self.place += form.size
        return values

    def count(self, least_bytes: int) -> int:
        """A count of records that have so many bytes or more."""
        (count,) = self.take(struct.Struct("<Q"))
        self.need(count * least_bytes)
        return count

    def text(self) -> str:
        end = self.data.find(b"\0", self.place)
        if end < 0:
            raise InputError("damaged: the name of a photograph does not end")
        raw, self.place = self.data[self.place : end], end + 1
        return raw.decode(errors="surrogateescape")

    def skip(self, count: int) -> None:
        self.need(count)
        self.place += count

    def need(self, count: int) -> None:
        if count > len(self.data) - self.place:
            raise InputError(
                f"damaged or cut: expected {count} more bytes at byte {self.place}, got {len(self.data) - self.place}: "
                "copy the model again"
            )


def binary_cameras(data: bytes) -> list[tuple[int, ColmapCamera]]:
    """Numbers and cameras of a cameras.bin. Raises InputError."""
    names = {model.number: name for name, model in COLMAP_MODELS.items()}
    source, cameras = _Bytes(data), []
    for _ in range(source.count(24)):
        number, model, width, height = source.take(struct.Struct("<iiQQ"))
        if model not in names:
            raise InputError(f"camera {number}: expected a model of {', '.join(COLMAP_MODELS)}, got number {model}")
        parameters = source.take(struct.Struct(f"<{COLMAP_MODELS[names[model]].parameters}d"))
        cameras.append((number, camera_record(names[model], width, height, parameters)))
    return cameras


def binary_images(data: bytes) -> list[ColmapImage]:
    """The photographs of an images.bin. Raises InputError."""
    source, images = _Bytes(data), []
    form = struct.Struct("<I4d3dI")
    for _ in range(source.count(form.size + 9)):
        number, *pose, camera = source.take(form)
        name = source.text()
        source.skip(source.count(_OBSERVATION_BYTES) * _OBSERVATION_BYTES)
        images.append(image_record(name, camera, pose[:4], pose[4:], number))
    return images


def binary_points(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] float64 and colours [P,3] uint8 of a points3D.bin. Raises InputError."""
    source = _Bytes(data)
    count = source.count(_POINT.size)
    points, colours = np.empty((count, 3)), np.empty((count, 3), np.uint8)
    for index in range(count):
        values = source.take(_POINT)
        points[index], colours[index] = values[1:4], values[4:7]
        source.skip(values[8] * _TRACK_BYTES)
    return points, colours


def binary_rigs(data: bytes) -> Rigs:
    """The rigs of a rigs.bin. Raises InputError."""
    source = _Bytes(data)
    rigs: Rigs = {}
    for _ in range(source.count(8)):
        number, count = source.take(struct.Struct("<II"))
        rigs[number] = {}
        for index in range(count):
            sensor = source.take(_SENSOR)
            pose = None
            if index and source.take(struct.Struct("<B"))[0]:
                numbers = source.take(_POSE)
                pose = pose_of(numbers[:4], numbers[4:])
            rigs[number][sensor] = pose if index else np.eye(4)
    return rigs


def binary_frames(data: bytes) -> list[ColmapFrame]:
    """The frames of a frames.bin. Raises InputError."""
    source, frames = _Bytes(data), []
    for _ in range(source.count(68)):
        _, rig = source.take(struct.Struct("<II"))
        pose = source.take(_POSE)
        (count,) = source.take(_COUNT)
        seen = [source.take(struct.Struct("<iIQ")) for _ in range(count)]
        images = {(kind, sensor): image for kind, sensor, image in seen if kind == CAMERA}
        frames.append(ColmapFrame(rig, pose_of(pose[:4], pose[4:]), images))
    return frames
