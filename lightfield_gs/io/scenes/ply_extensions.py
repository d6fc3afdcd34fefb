"""Properties that trainers add to the .ply of 3D Gaussian splatting: motion and a 3D filter.

Gaussians that move are of Spacetime Gaussians (Li et al., 2024), filter_3D of Mip-Splatting (Yu et al., 2024).

With dt = t - trbf_center, the centre is a polynomial: motion_0..2 for dt, motion_3..5 for dt^2, and so on. The
quaternion is rot + omega dt, and the opacity falls by exp(-(dt / exp(trbf_scale))^2). f_dc_* are colours, not
coefficients; other trainers that store the same columns have coefficients there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError

FILTER = "filter_3D"  # standard deviation of Mip-Splatting's filter for each Gaussian, scene units
FILTER_NOTE = (
    f"the property {FILTER} of Mip-Splatting was applied to scales and opacities; its scenes are trained with "
    "anti-aliasing: antialiased=True draws them as they were"
)
_CENTRE, _SCALE = MOTION = ("trbf_center", "trbf_scale")  # Gaussians with both move
_NETWORK = re.compile(r"f_t_\d+")  # features that a network beside the file turns into colours
_COLOURS = (-0.1, 1.1)  # colours are fitted without bounds; few are outside this range
_FAINTEST = 1 / 255  # fainter Gaussians are not drawn
_MOST_BEYOND = 0.2  # of colours outside _COLOURS; a third or more of coefficients are below 0


@dataclass
class MotionState:
    """Changes to N Gaussians at one time.

    Attributes:
        offsets: added to the centres, [N, 3].
        quaternion_offsets: added to the quaternions, [N, 4].
        opacity_factors: factors of the opacities, [N].
        notes: decisions, one line each.
    """

    offsets: np.ndarray
    quaternion_offsets: np.ndarray
    opacity_factors: np.ndarray
    notes: list[str]


def evaluate_motion(path: Path, records: np.ndarray, time: float | None) -> MotionState:
    """Evaluate the motion at a time.

    Args:
        path: the file, for messages.
        records: rows of the file.
        time: in the file's units; None for the median of the times at which Gaussians are most opaque.

    Raises:
        InputError: coefficients of the polynomial or of omega are missing.
    """
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
        offsets = np.zeros((len(records), 3))
        for start in range(count - 3, -1, -3):
            offsets = (offsets + _coefficients(records, start)) * since[:, None]
        quaternion_offsets = np.zeros((len(records), 4))
        if "omega_0" in names:
            quaternion_offsets = np.stack([records[f"omega_{i}"] for i in range(4)], 1) * since[:, None]
        opacity_factors = np.exp(-np.square(since / np.exp(records[_SCALE].astype(np.float64))))
    notes = [
        f"its Gaussians move and are drawn at the time {at:g}, of about {first:.3g} to {last:.3g} (another: time=)"
    ]
    if not (opacity_factors > _FAINTEST).any():
        notes.append(f"none of its Gaussians shows at the time {at:g}")
    if any(_NETWORK.fullmatch(name) for name in names):
        notes.append("a network beside the file makes the colours of f_dc and f_t_*: drawn are f_dc alone")
    return MotionState(offsets, quaternion_offsets, opacity_factors, notes)


def _coefficients(records: np.ndarray, start: int) -> np.ndarray:
    """Return three coefficients, one for each axis, [N, 3]."""
    return np.stack([records[f"motion_{start + axis}"].astype(np.float64) for axis in range(3)], 1)


def holds_colours(values: np.ndarray) -> tuple[bool, str]:
    """Decide whether f_dc_0..2 of moving Gaussians, [N, 3], are colours; return it with a note."""
    beyond = float(((values < _COLOURS[0]) | (values > _COLOURS[1])).mean())
    if beyond <= _MOST_BEYOND:
        return True, "its f_dc are taken for colours of 0..1, as Spacetime Gaussians stores them"
    return False, f"its f_dc are taken for harmonics, since {beyond:.0%} of them are no colours of 0..1"


def apply_filter(scales: np.ndarray, opacities: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Apply Mip-Splatting's 3D filter: Gaussians become larger and correspondingly fainter.

    Args:
        scales: [N, 3].
        opacities: [N].
        widths: standard deviations of the filters, [N].

    Returns:
        Scales [N, 3] and opacities [N], float32.
    """
    with np.errstate(over="ignore"):
        wide = np.hypot(scales, widths[:, None].astype(np.float32))
    compensation = np.divide(scales, wide, out=np.ones(wide.shape), where=wide > 0).prod(1)
    return wide, (opacities * compensation).astype(np.float32)
