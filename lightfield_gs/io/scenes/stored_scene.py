"""A scene as a file stores it, in the package's terms, and what every reader has in common."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.io.scenes.invalid import check_or_skip

TINY = np.finfo(np.float32).tiny
MOST_BANDS = 15  # coefficients above degree 0 that are drawn: those of degree 1..3
HIGH_DEGREE_NOTE = "harmonics of degree 4 were left out; those of degree 0..3 are drawn"


@dataclass
class StoredScene:
    """A scene as arrays.

    fields: the five fields of N >= 1 Gaussians by name, float32 [N, ...]; see scene/gaussians.py. origin: where the
    zero of their means lies in the file's coordinates. comments, elements, notes: see scene/files.py. kind: the format
    of the file and its version, in words.
    """

    fields: dict[str, np.ndarray]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    comments: tuple[str, ...] = ()
    elements: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    kind: str = ""


def settled(path: Path, fields: dict[str, np.ndarray], skip_invalid: bool) -> tuple[dict[str, np.ndarray], list[str]]:
    """The fields as float32, scales and opacities above 0, and a note on Gaussians that were left out.

    Raises InputError where values have no meaning, as `check_or_skip` does; a negative scale has none.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        fields = {name: np.array(array, np.float32) for name, array in fields.items()}
        fields["means"] += 0.0  # no minus zeros, which turned axes leave
        if (fields["scales"] < 0).any():
            fields["scales"] = np.where(fields["scales"] < 0, np.float32(np.nan), fields["scales"])
    fields, notes = check_or_skip(path, None, fields, skip_invalid)
    for name in ("scales", "opacities"):
        fields[name] = np.maximum(fields[name], TINY)
    return fields, notes


def same_degree(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The fields of several parts of a scene as those of one, of the highest degree of harmonics among them."""
    most = max(part["sh"].shape[1] for part in parts)
    for part in parts:
        part["sh"] = np.pad(part["sh"], ((0, 0), (0, most - part["sh"].shape[1]), (0, 0)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def drawn_bands(rest: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Of harmonics above degree 0, [N, K - 1, 3], those that are drawn, and a note where others were left out."""
    return rest[:, :MOST_BANDS], [HIGH_DEGREE_NOTE] * (rest.shape[1] > MOST_BANDS)


def harmonics_of_colours(colours: np.ndarray) -> np.ndarray:
    """Coefficients of degree 0 of colours 0..1."""
    return (colours - 0.5) / SH_CONSTANT


def completed(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] of three components [N, 3] in order, and the index [N] of the one that is not stored,
    the largest, which is not negative ("smallest three")."""
    rest = np.sqrt(np.maximum(0.0, 1.0 - (three * three).sum(1)))
    whole = np.empty((len(three), 4), three.dtype)
    for index in range(4):
        rows = largest == index
        whole[rows] = np.insert(three[rows], index, rest[rows], axis=1)
    return whole


def expect_some(path: Path, count: int) -> None:
    if count == 0:
        raise InputError(f"{path} has no Gaussians")
