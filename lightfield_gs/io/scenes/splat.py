"""The .splat of antimatter15's viewer: 32 bytes a Gaussian and nothing else, in the axes of the original .ply.

A Gaussian has x y z and three standard deviations as float32, and red, green, blue and opacity as bytes. The components
of its quaternion wxyz are bytes 128 + 128 c. It has no harmonics above degree 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.file_kinds import refuse_stand_in
from lightfield_gs.io.scenes.comments import is_antialiased
from lightfield_gs.io.scenes.scene_arrays import (
    Fields,
    Origin,
    SceneArrays,
    check_not_empty,
    checked_fields,
    header_losses,
    rgb_to_sh,
)

_RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
_START_BYTES = 4096


def read(path: Path, skip_invalid: bool) -> SceneArrays:
    """Read a .splat; see files.read_arrays."""
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        refuse_stand_in(path)
        raise InputError(
            f"{path} has {size} bytes, and a .splat has {_RECORD.itemsize} for each Gaussian; it is cut, or no .splat"
        )
    check_not_empty(path, size)
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
        "sh": rgb_to_sh(colours[:, None, :3]),
    }
    fields, notes = checked_fields(path, fields, skip_invalid)
    return SceneArrays(fields, notes=notes, kind=".splat, 32 bytes a Gaussian")


def write(path: str | Path, fields: Fields, origin: Origin, comments: Sequence[str] = ()) -> list[str]:
    """Write float64 fields of N >= 1 valid Gaussians.

    Args:
        path: the file.
        fields: the five fields.
        origin: position of the means' zero, which the format cannot store.
        comments: lines that the format cannot store.

    Returns:
        Losses, one line each.
    """
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
    if is_antialiased(comments):
        lost.append("a .splat cannot say that it was trained with anti-aliasing: draw it with antialiased=True")
    return lost + header_losses(path, origin, comments)
