"""Gaussians that move, as Spacetime Gaussians (Li et al., 2024) stores them in a .ply, and how they are at one time.

With dt = t - trbf_center: the centre is a polynomial of dt (motion_0..2 by dt, motion_3..5 by dt^2, and so on), the
quaternion rot + omega dt, and the opacity falls by exp(-(dt / exp(trbf_scale))^2). f_dc_* are colours, not
coefficients; other trainers that store the same columns have coefficients there.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError

_CENTRE, _SCALE = "trbf_center", "trbf_scale"
_NETWORK = re.compile(r"f_t_\d+")  # features that a network beside the file turns into colours
_OTHER = re.compile(r"(t|t_scale|scale_t|scaling_t|trbf_\w+|motion_\w+|omega_\w+|rot_r_\d|rotation_r_\d|velocity_\w+)")
_DEFORMED_BY = ("deformation.pth", "deformation_table.pth", "deform.pth")  # 4D Gaussians and what follows them
_COLOURS = (-0.1, 1.1)  # colours are fitted without bounds, and few are beyond these
_FAINTEST = 1 / 255  # what is less opaque than this is not drawn
_MOST_BEYOND = 0.2  # of colours; of coefficients a third and more are below 0


@dataclass
class Moved:
    """What one time makes of N Gaussians. shifts: of the centres [N, 3]; turns: added to the quaternions [N, 4];
    shares: of the opacities [N]. notes: on what was decided."""

    shifts: np.ndarray
    turns: np.ndarray
    shares: np.ndarray
    notes: list[str]


def is_moving(names: Sequence[str]) -> bool:
    """Whether vertices with properties of these names are Gaussians whose motion is known."""
    return _CENTRE in names and _SCALE in names


def still_notes(path: Path, names: Sequence[str]) -> list[str]:
    """A note where properties, or a network beside the file, speak of a motion that is not known."""
    beside = [name for name in _DEFORMED_BY if (path.parent / name).is_file()]
    if path.parent.parent.name == "point_cloud":  # Deformable 3D Gaussians keep it in a folder of its own
        beside += [found.name for found in path.parents[2].glob("deform/iteration_*/deform.pth")]
    if beside:
        return [f"{beside[0]} beside it moves its Gaussians: they are drawn as they are stored, without that network"]
    found = [name for name in names if _OTHER.fullmatch(name)]
    if not found or is_moving(names):
        return []
    return [
        f"the properties {', '.join(found[:4])}{', ...' if len(found) > 4 else ''} speak of motion, and such motion is "
        "not known here: the Gaussians are drawn as they are stored, of all times at once"
    ]


def moved(path: Path, records: np.ndarray, time: float | None) -> Moved:
    """The Gaussians at a time, None: at the median of the times at which they are most opaque. Raises InputError where
    the polynomial has coefficients for one axis and not for another."""
    names = records.dtype.names or ()
    count = sum(name.startswith("motion_") for name in names)
    wanted = [f"motion_{i}" for i in range(count)] + [f"omega_{i}" for i in range(4 if "omega_0" in names else 0)]
    if count % 3 or any(name not in names for name in wanted):
        raise InputError(
            f"{path}: expected motion_0 on, three of each degree, and omega_0..3, got {count} properties motion_*"
        )
    centres = records[_CENTRE].astype(np.float64)
    finite = centres[np.isfinite(centres)]
    first, middle, last = np.percentile(finite, (1, 50, 99)) if len(finite) else (0.0, 0.0, 0.0)
    at = float(f"{middle:.3g}") if time is None else time
    with np.errstate(over="ignore", invalid="ignore"):
        since = at - centres
        shifts = np.zeros((len(records), 3))
        for start in range(count - 3, -1, -3):
            shifts = (shifts + _three(records, start)) * since[:, None]
        turns = np.zeros((len(records), 4))
        if "omega_0" in names:
            turns = np.stack([records[f"omega_{i}"] for i in range(4)], 1) * since[:, None]
        shares = np.exp(-np.square(since / np.exp(records[_SCALE].astype(np.float64))))
    notes = [
        f"its Gaussians move and are drawn at the time {at:g}, of about {first:.3g} to {last:.3g} (another: --time; "
        "Python: time)"
    ]
    if not (shares > _FAINTEST).any():
        notes.append(f"none of its Gaussians shows at the time {at:g}")
    if any(_NETWORK.fullmatch(name) for name in names):
        notes.append("a network beside the file makes the colours of f_dc and f_t_*: drawn are f_dc alone")
    return Moved(shifts, turns, shares, notes)


def _three(records: np.ndarray, start: int) -> np.ndarray:
    return np.stack([records[f"motion_{start + axis}"].astype(np.float64) for axis in range(3)], 1)


def holds_colours(values: np.ndarray) -> tuple[bool, str]:
    """Whether f_dc_0..2 of moving Gaussians, [N, 3], are colours, and a note on that."""
    beyond = float(((values < _COLOURS[0]) | (values > _COLOURS[1])).mean())
    if beyond <= _MOST_BEYOND:
        return True, "its f_dc are taken for colours of 0..1, as Spacetime Gaussians stores them"
    return False, f"its f_dc are taken for harmonics, since {beyond:.0%} of them are no colours of 0..1"
