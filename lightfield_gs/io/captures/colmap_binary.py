"""COLMAP's binary files, little-endian: a count of 8 bytes, then so many records.

cameras: number int32, model int32, width uint64, height uint64, then the model's parameters as float64.
images: number uint32, quaternion 4 float64, translation 3 float64, camera uint32, name ending in 0, count of
observations uint64, and each of these as x, y float64, point int64.
points3D: number uint64, x y z float64, r g b uint8, error float64, length of the track uint64, and each of its elements
as image uint32, observation uint32.
"""

from __future__ import annotations

import struct

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS
from lightfield_gs.io.captures.colmap_records import ColmapCamera, ColmapImage, camera_record, image_record

_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
_POINT = struct.Struct("<Q3d3BdQ")


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
        try:
            return raw.decode()
        except UnicodeDecodeError:
            raise InputError(f"expected names in UTF-8, got {raw[:60]!r}") from None

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
        _, *pose, camera = source.take(form)
        name = source.text()
        source.skip(source.count(_OBSERVATION_BYTES) * _OBSERVATION_BYTES)
        images.append(image_record(name, camera, pose[:4], pose[4:]))
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
