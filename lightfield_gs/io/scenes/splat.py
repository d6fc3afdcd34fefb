"""The .splat of antimatter15's viewer: 32 bytes a Gaussian and nothing else, in the axes of the .ply it was made from.

x y z and three standard deviations as float32, red, green, blue and opacity of 0..255, and a quaternion wxyz, each
component c as 128 + 128 c. Degree 0 only.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.not_what_it_says import refuse_stand_in
from lightfield_gs.io.scenes.stored_scene import StoredScene, expect_some, harmonics_of_colours, settled

_RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
_START_BYTES = 4096
KIND = ".splat, 32 bytes a Gaussian"


def read(path: Path, skip_invalid: bool) -> StoredScene:
    """See stored.py. Raises InputError."""
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        refuse_stand_in(path)
        raise InputError(
            f"{path} has {size} bytes, and a .splat has {_RECORD.itemsize} for each Gaussian; it is cut, or no .splat"
        )
    expect_some(path, size)
    with open(path, "rb") as file:
        start = file.read(_START_BYTES)
    if len(start) == _START_BYTES and not any(start):
        raise InputError(f"{path} is no .splat: it begins with {_START_BYTES} zeros; download or export it again")
    rows = np.fromfile(path, _RECORD)
    colours = rows["rgba"].astype(np.float64) / 255
    fields = {
        "means": rows["means"],
        "quaternions": (rows["rotation"].astype(np.float32) - 128) / 128,
        "scales": rows["scales"],
        "opacities": colours[:, 3],
        "sh": harmonics_of_colours(colours[:, None, :3]),
    }
    fields, notes = settled(path, fields, skip_invalid)
    return StoredScene(fields, notes=notes, kind=KIND)


def write(path: str | Path, fields: dict[str, np.ndarray], antialiased: bool = False) -> list[str]:
    """Writes float64 fields of N >= 1 valid Gaussians; returns what is lost, a line each. antialiased: whether they
    were trained so. Raises InputError."""
    rows = np.empty(len(fields["means"]), _RECORD)
    lengths = np.linalg.norm(fields["quaternions"], axis=1, keepdims=True)
    rows["means"], rows["scales"] = fields["means"], fields["scales"]
    colours = 0.5 + SH_CONSTANT * fields["sh"][:, 0]
    rows["rgba"] = np.round(255 * np.clip(np.concatenate([colours, fields["opacities"][:, None]], 1), 0, 1))
    rows["rotation"] = np.clip(np.round(128 + 128 * fields["quaternions"] / lengths), 0, 255)
    with atomic_path(path) as temporary:
        rows.tofile(temporary)
    lost = []
    if fields["sh"].shape[1] > 1:
        lost.append("a .splat holds no harmonics above degree 0: colours no longer vary with the direction of view")
    if antialiased:
        lost.append("a .splat cannot say that it was trained with anti-aliasing: draw it with --antialiased")
    return lost
