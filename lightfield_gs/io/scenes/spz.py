"""Niantic's .spz, versions 1 to 4: 16 to 20 bytes a Gaussian and its harmonics, compressed.

Centres are fixed-point numbers of 24 bits (version 1: half floats); logarithms of scales (b / 16 - 10), opacities
(b / 255), colours (harmonic of degree 0: (b / 255 - 0.5) / 0.15) and harmonics (b / 128 - 1) are bytes. Rotations
are x y z of a quaternion as bytes, from version 3 on its three smallest components of 10 bits. Axes are right, up, back
(RUB): here they are turned about x to right, down, forward, as those of a .ply (README of spz, "Coordinate System").
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.scenes import doubts, render_mode
from lightfield_gs.io.scenes.spz_streams import ANTIALIASED, COEFFICIENTS, MAGIC, Streams, read_streams
from lightfield_gs.io.scenes.stored_scene import HIGH_DEGREE_NOTE, StoredScene, completed, settled

AXES_COMMENT = "Vertical Axis: -y"  # after the turn; before it y is up, as the format says
_TURN = np.array([1.0, -1.0, -1.0])
_COLOUR_SCALE = 0.15
_LEAST_FRACTION_BITS = 12  # of centres: what others write
_FINEST_SHARE = 1 / 8  # of the usual Gaussian's size: a coarser step of centres shows
_LARGEST = (1 << 23) - 1  # a centre's number
_SMALL = math.sqrt(0.5) / 511  # a step of a rotation's components
# Harmonics that change sign where y and z do: odd in y and z together
_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float64)[:, None]
_WRITTEN_VERSION = 3
_BUCKETS = (8, 16)  # harmonics are rounded to these: of degree 1, and above (5 and 4 bits), for gzip's sake


@np.errstate(invalid="ignore")
def read(path: Path, skip_invalid: bool) -> StoredScene:
    """See stored.py. Raises InputError."""
    streams = read_streams(path)
    positions, opacities, colours, scales, rotations, rest = (
        np.frombuffer(data, np.uint8).reshape(streams.count, -1) for data in streams.attributes[:6]
    )
    shape = (streams.count, COEFFICIENTS[streams.degree] - 1, 3)
    sh = np.concatenate(
        [
            ((colours / 255 - 0.5) / _COLOUR_SCALE)[:, None],
            rest.reshape(shape)[:, : len(_SIGNS) - 1].astype(np.float32) / 128 - 1,
        ],
        1,
    )
    fields = {
        "means": _centres(streams, positions) * _TURN,
        "quaternions": _rotations(streams, rotations) * np.append(1.0, _TURN),
        "scales": np.exp(scales / 16 - 10),
        "opacities": opacities[:, 0] / 255,
        "sh": sh * _SIGNS[: sh.shape[1]],
    }
    fields, notes = settled(path, fields, skip_invalid)
    if streams.degree == len(COEFFICIENTS) - 1:
        notes.append(HIGH_DEGREE_NOTE)
    comments = (AXES_COMMENT, *([render_mode.ANTIALIASED] if streams.flags & ANTIALIASED else []))
    return StoredScene(fields, comments=comments, notes=notes, kind=kind(streams.version))


def kind(version: int) -> str:
    return f"SPZ version {version}, axes turned from right-up-back to right-down-forward"


def _centres(streams: Streams, stored: np.ndarray) -> np.ndarray:
    if streams.version == 1:
        return stored.view("<f2").astype(np.float64)
    three = stored.reshape(-1, 3, 3).astype(np.int32)
    whole = three[..., 0] | three[..., 1] << 8 | three[..., 2] << 16
    return (whole - ((whole & 1 << 23) << 1)) / (1 << streams.fraction_bits)


def _rotations(streams: Streams, stored: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4], wxyz."""
    if streams.version < 3:
        return completed(stored / 127.5 - 1, np.zeros(streams.count, np.int64))
    words = np.ascontiguousarray(stored).view("<u4")[:, 0]
    parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], 1).astype(np.float64)
    three = np.where(parts >= 512, 512 - parts, parts) * _SMALL
    return np.roll(completed(three, words >> 30), 1, axis=1)  # stored as xyzw


def write(path: str | Path, fields: dict[str, np.ndarray], antialiased: bool = False) -> list[str]:
    """Writes float64 fields of N >= 1 valid Gaussians as version 3; returns what is lost, a line each. antialiased:
    whether the file says that they were trained so. Raises InputError."""
    means, sh = fields["means"] * _TURN, fields["sh"] * _SIGNS[: fields["sh"].shape[1]]
    bits = _fraction_bits(path, means, fields["scales"])
    whole = np.round(means * (1 << bits)).astype(np.int32)
    logs = np.log(fields["scales"])
    degree = COEFFICIENTS.index(sh.shape[1])
    body = [
        struct.pack("<4sIIBBBB", MAGIC, _WRITTEN_VERSION, len(means), degree, bits, ANTIALIASED * antialiased, 0),
        np.stack([whole >> shift & 255 for shift in (0, 8, 16)], -1).astype(np.uint8).tobytes(),
        _byte(fields["opacities"] * 255),
        _byte((sh[:, 0] * _COLOUR_SCALE + 0.5) * 255),
        _byte((logs + 10) * 16),
        _packed_rotations(fields["quaternions"] * np.append(1.0, _TURN)),
        _packed_harmonics(sh[:, 1:]),
    ]
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)  # no time or name in its header: the same bytes each time
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        for part in body:
            file.write(packer.compress(part))
        file.write(packer.flush())
    return _losses(logs, sh)


def _fraction_bits(path: str | Path, means: np.ndarray, scales: np.ndarray) -> int:
    """As many as small Gaussians need, and the farthest centre leaves. Raises InputError where that is too few."""
    farthest, size = float(np.abs(means).max()), doubts.usual_size(scales)
    fitting = 23 if farthest == 0 else min(23, math.floor(math.log2(_LARGEST / farthest)))
    if fitting < 0:
        raise InputError(
            f"cannot write {path}: an .spz holds coordinates up to {_LARGEST}, and there are some of {farthest:.3g}; "
            "write a .ply"
        )
    wanted = _LEAST_FRACTION_BITS if math.isinf(size) else math.ceil(-math.log2(size * _FINEST_SHARE))
    return min(fitting, max(_LEAST_FRACTION_BITS, wanted))


def _byte(values: np.ndarray) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()


def _packed_rotations(quaternions: np.ndarray) -> bytes:
    xyzw = np.roll(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True), -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    xyzw = np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -xyzw, xyzw)
    three = xyzw[np.arange(4) != largest[:, None]].reshape(-1, 3)
    parts = np.minimum(np.round(np.abs(three) / _SMALL), 511).astype(np.uint32) | (three < 0).astype(np.uint32) << 9
    words = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    return words.astype("<u4").tobytes()


def _packed_harmonics(rest: np.ndarray) -> bytes:
    steps = np.where(np.arange(rest.shape[1]) < 3, *_BUCKETS)[:, None]
    return _byte(np.floor((np.round(rest * 128) + 128 + steps // 2) / steps) * steps)


def _losses(logs: np.ndarray, sh: np.ndarray) -> list[str]:
    lost = []
    if far := int(((logs < -10 - 1 / 32) | (logs > 255 / 16 - 10 + 1 / 32)).any(1).sum()):
        lost.append(f"{far} Gaussians have scales outside of 4.5e-5..380, which an .spz cuts to that")
    if far := int((np.abs(sh[:, 1:]) > 1.01).any((1, 2)).sum()):
        lost.append(f"{far} Gaussians have harmonics outside of -1..1, which an .spz cuts to that")
    return lost
