"""Irregularities of the parts of random objects: lobed sections, turned profiles, and relief of their surfaces.

Lobes and profiles only take away, so that a part stays in the box that it had. Relief is a sum of waves along the
normal: the point p + h(p) n, the tangents t + n (grad h . t), in which the bending of n itself is left out.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from training.data.superquadrics import named
from training.data.uniform import Numbers

# Numbers of a part's relief. height: of each of three plane waves, scene units; waves, phases: in its local axes,
# 1 / scene units. Half as high, three times as fine waves run along with them.
RELIEF = {"height": 1, "waves": 9, "phases": 3}
_FINER, _LOWER = 3.0, 0.4
_IRREGULAR = ("lobe", "lobes", "turn", "curve", "curves", "begin", "relief")
_STEEPEST = 0.5  # slope of a relief's coarse waves, each


def regular(groups: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The fields of SHAPE that make parts irregular, [B,G], such that they do not."""
    return {name: np.zeros_like(groups["taper"]) for name in _IRREGULAR}


def irregular(u: Numbers, groups: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same fields, drawn at random for groups of equal parts."""
    count, half = groups["taper"].shape[1], groups["half"]
    stout = np.clip(half[..., 2] / half[..., :2].max(-1), 0, 1)  # a plate's border lies in few cells
    lobed = (u(count) < 0.25) & (groups["section"] < 3)
    turned = u(count) < 0.35
    relieved = u(count) < 0.45
    return {
        "lobe": np.where(lobed, u.between(0.08, 0.4, count), 0),
        "lobes": np.floor(u.between(2, 9, count)),
        "turn": u.between(0, 6.28, count),
        "curve": np.where(turned, u.between(0.15, 0.6, count), 0) * stout,
        "curves": u.between(2, 9, count),
        "begin": u.between(0, 6.28, count),
        "relief": np.where(relieved, u.between(0.02, 0.13, count), 0),
    }


def draw_relief(u: Numbers, parts: dict[str, np.ndarray]) -> np.ndarray:
    """Return the reliefs [B,P,F] in the order of RELIEF; copies of a part have a relief of their own.

    Args:
        parts: As in procedural_plan, `relief` being the height over the smallest half axis.
    """
    shape = parts["relief"].shape
    length = parts["half"].mean(-1) * u.between(0.8, 2.5, *shape[1:])
    directions = u.between(-1, 1, *shape[1:], 3, 3)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True) + 1e-9
    waves = 2 * np.pi / length[..., None, None] * directions
    height = np.minimum(parts["relief"] * parts["half"].min(-1), _STEEPEST * length / (2 * np.pi)) / 3
    return np.concatenate([height[..., None], waves.reshape(*shape, 9), u.between(0, 6.28, *shape[1:], 3)], -1)


def raised(relief: Tensor, local: Tensor, along: Tensor, across: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points of parts and the sides of their cells [B,M,3] in local axes, with relief [B,M,F] (order of RELIEF)."""
    numbers = named(relief, RELIEF)
    waves, height = numbers["waves"].unflatten(-1, (3, 3)), numbers["height"][..., None]
    phase = (waves * local[..., None, :]).sum(-1) + numbers["phases"]
    rise = height * (phase.sin() + _LOWER * (_FINER * phase).sin()).sum(-1, keepdim=True)
    slopes = phase.cos() + _LOWER * _FINER * (_FINER * phase).cos()
    gradient = height * (waves * slopes[..., None]).sum(-2)
    normal = torch.nn.functional.normalize(torch.linalg.cross(across, along), dim=-1, eps=1e-20)
    along, across = (side + normal * (gradient * side).sum(-1, keepdim=True) for side in (along, across))
    return local + normal * rise, along, across
