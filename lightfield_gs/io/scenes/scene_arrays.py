"""A scene file's Gaussians as NumPy arrays, and conversions that all readers share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.io.scenes.plausibility import check_or_skip, float32_step, sample_median, typical_size
from lightfield_gs.scene.axes import DEFAULT_UP, find_up

Fields = dict[str, np.ndarray]
Origin = tuple[float, float, float]
TINY = np.finfo(np.float32).tiny
MAX_SH_REST = 15  # coefficients above degree 0 that are drawn: degree 1..3
# Half a turn about x: of centres from the axes right, up, back to those of a .ply (right, down, forward), and the signs
# of harmonics, -1 for those that are odd in y and z together
Y_UP_TURN = np.array([1.0, -1.0, -1.0])
Y_UP_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float64)[:, None]
LINEAR_NOTE = (
    "its colours are of linear light, and each Gaussian is converted to sRGB by itself: where Gaussians overlap, "
    "the mixture differs a little"
)
_LIGHT_STEP = 1e-3  # for the slope of sRGB's curve
HIGH_DEGREE_NOTE = "harmonics of degree 4 were left out; those of degree 0..3 are drawn"

# Fraction of the typical Gaussian's size: if rounding to float32 moves centres by more, they become relative to an
# origin
_ORIGIN_STEP = 1e-3


@dataclass
class SceneArrays:
    """A scene file as arrays.

    Attributes:
        fields: the five fields of N >= 1 Gaussians by name, float32 [N, ...]; see scene/gaussians.py.
        origin: position of the means' zero in the file's coordinates.
        comments: text of the header's comments, in file order.
        elements: other small elements of a .ply by name, as structured arrays.
        notes: suspicious contents and decisions of the reader, one line each.
        kind: format and version in words.
    """

    fields: Fields
    origin: Origin = (0.0, 0.0, 0.0)
    comments: tuple[str, ...] = ()
    elements: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    kind: str = ""


def checked_fields(path: Path, fields: Fields, skip_invalid: bool) -> tuple[Fields, list[str]]:
    """Convert fields to float32 with scales and opacities above 0, and check them as `check_or_skip` does.

    A negative scale has no meaning.

    Returns:
        The fields, and a note on Gaussians that were left out.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        fields = {name: _own(array) for name, array in fields.items()}
        fields["means"] += 0.0  # turned axes leave minus zeros
        if (fields["scales"] < 0).any():
            fields["scales"] = np.where(fields["scales"] < 0, np.float32(np.nan), fields["scales"])
    fields, notes = check_or_skip(path, None, fields, skip_invalid)
    for name in ("scales", "opacities"):
        fields[name] = np.maximum(fields[name], TINY)
    return fields, notes


def _own(array: np.ndarray) -> np.ndarray:
    """Return an array as float32 that may be written; a copy, unless it is one already."""
    is_own = array.dtype == np.float32 and array.flags.owndata and array.flags.writeable and array.flags.c_contiguous
    return array if is_own else np.array(array, np.float32)


def check_not_empty(path: Path, count: int) -> None:
    """Raise InputError for a file without Gaussians."""
    if count == 0:
        raise InputError(f"{path} has no Gaussians")


def relative_centres(exact: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, Origin]:
    """Return float64 centres [N, 3] as float32, relative to an origin of whole numbers where they are far from zero."""
    origin = np.zeros(3)
    with np.errstate(over="ignore", invalid="ignore"):
        middle = sample_median(exact)
        if middle is not None and float32_step(middle) > _ORIGIN_STEP * typical_size(scales):
            origin = np.round(middle)
        return (exact - origin).astype(np.float32), tuple((origin + 0.0).tolist())


def concatenate_fields(parts: list[Fields]) -> Fields:
    """Concatenate the fields of a scene's parts, at the highest degree of harmonics among them."""
    if len(parts) == 1:
        return parts[0]
    most = max(part["sh"].shape[1] for part in parts)
    for part in parts:
        part["sh"] = np.pad(part["sh"], ((0, 0), (0, most - part["sh"].shape[1]), (0, 0)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def header_losses(path: str | Path, origin: Origin, comments: Sequence[str]) -> list[str]:
    """Return a line each on an origin and on comments, for formats without a place for them."""
    suffix = Path(path).suffix.lower()
    lost = [f"centres are given from the origin {origin}, which a {suffix} cannot hold"] if any(origin) else []
    if comments:
        lost.append(f"a {suffix} holds no comments: what the scene was made by is only in a .ply, .glb or .usd")
    return lost


def up_losses(comments: Sequence[str], format: str) -> list[str]:
    """Return a line on another vertical axis than that of a .ply, for formats that have y up."""
    up = find_up(comments)
    if up is None or up.axis == DEFAULT_UP:
        return []
    return [f"{up.axis} is up in the scene, and y in {format}: other programs show the file on its side"]


def limit_degree(rest: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Limit harmonics above degree 0, [N, K - 1, 3], to degree 3; return them and a note where others were left out."""
    return rest[:, :MAX_SH_REST], [HIGH_DEGREE_NOTE] * (rest.shape[1] > MAX_SH_REST)


def rgb_to_sh(colours: np.ndarray) -> np.ndarray:
    """Convert colours in 0..1 to coefficients of degree 0."""
    return (colours - 0.5) / SH_CONSTANT


def encode_light(sh: np.ndarray) -> np.ndarray:
    """Convert harmonics [N, K, 3] of linear light to sRGB: the mean colour exactly, its changes to first order."""
    light = np.maximum(SH_CONSTANT * sh[:, :1] + 0.5, 0)
    colour = encode_srgb(light)
    slope = (encode_srgb(light + _LIGHT_STEP) - colour) / _LIGHT_STEP
    return np.concatenate([rgb_to_sh(colour), slope * sh[:, 1:]], 1).astype(np.float32)


def complete_quaternions(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Complete unit quaternions that are stored by their smallest three components.

    Args:
        three: stored components [N, 3], in order.
        largest: index [N] of the component that is not stored; it is not negative.

    Returns:
        Quaternions [N, 4].
    """
    rest = np.sqrt(np.maximum(0.0, 1.0 - (three * three).sum(1)))
    whole = np.empty((len(three), 4), three.dtype)
    for index in range(4):
        rows = largest == index
        whole[rows] = np.insert(three[rows], index, rest[rows], axis=1)
    return whole
