"""Tapered, waisted and bent superquadrics, solid or with a hole: points of their surfaces, and tests for the inside.

Superquadrics: Barr, "Superquadrics and angle-preserving transformations" (1981); his global deformations (1984). A part
turns a profile, |r|^p + |z|^p = 1, about its z axis along a section, |x|^q + |y|^q = 1. With p = q = 2 it is a ball,
with a large p a cylinder, with large p and q a box. With a hole the profile does not reach the axis (a torus, a tyre, a
tube).
"""

from __future__ import annotations

import torch
from torch import Tensor

# Numbers of a part, in the order of a table's last dimension.
# matrix: local to source axes, orthonormal, it may mirror. centre: scene units. half: half axes x, y, z, scene units.
# hole: radius of the middle of the profile, 0 (solid) .. 1. profile, section: the exponents p and q. taper, wave,
# waves: the section grows by 1 + taper z + wave cos(waves z), z in -1..1. bend: how much further along x the ends lie
# than the middle, scene units. lobe, lobes, turn: the section shrinks by 1 - lobe (1 - cos(lobes angle + turn)) / 2.
# curve, curves, begin: it shrinks by 1 - curve (1 - sin(curves z + begin)) / 2, as on a lathe. relief: how far the
# surface is moved in and out (training/data/relief.py), over the smallest half axis; here a margin of the inside.
SHAPE = {
    "matrix": 9,
    "centre": 3,
    "half": 3,
    "hole": 1,
    "profile": 1,
    "section": 1,
    "taper": 1,
    "wave": 1,
    "waves": 1,
    "bend": 1,
    "lobe": 1,
    "lobes": 1,
    "turn": 1,
    "curve": 1,
    "curves": 1,
    "begin": 1,
    "relief": 1,
}
_TINY = 1e-6
_DEEP = 0.97  # of the way from the middle to the surface


def named(table: Tensor, layout: dict[str, int]) -> dict[str, Tensor]:
    """The columns [..., F] of a table by name: [...] where a name has one number, else [..., count]."""
    parts = zip(layout, table.split(list(layout.values()), dim=-1))
    return {name: part.squeeze(-1) if layout[name] == 1 else part for name, part in parts}


def _norm(x: Tensor, y: Tensor, exponent: Tensor) -> Tensor:
    """(|x|^e + |y|^e)^(1/e)."""
    return (x.abs().clamp_min(_TINY).pow(exponent) + y.abs().clamp_min(_TINY).pow(exponent)).pow(1 / exponent)


def _sides(across: Tensor, up: Tensor, exponent: Tensor) -> tuple[Tensor, Tensor]:
    """Half sides of the rectangle to lay a superellipse of these half axes along, so that cells come out alike.

    From its corner at 45 degrees on, where |x| = |y| = k, a quarter runs k of one axis and 1 - k of the other.
    """
    k = 2 ** (-1 / exponent)
    rest = (1 - k).clamp_min(0.25)  # corners are sharp: most of the rest lies near them
    return k * across + rest * up, k * up + rest * across


def _superellipse(place: Tensor, across: Tensor, up: Tensor, exponent: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates over half axes, -1..1, of the point whose radius meets a rectangle of half sides across and up at
    `place`: the length along its border, from the lower left corner on, to the right first."""
    wide, high = 2 * across, 2 * up
    x = place.clamp_min(0).minimum(wide) - (place - wide - high).clamp_min(0).minimum(wide) - across
    y = (place - wide).clamp_min(0).minimum(high) - (place - 2 * wide - high).clamp_min(0).minimum(high) - up
    x, y = x / across, y / up
    norm = _norm(x, y, exponent)
    return x / norm, y / norm


def _profile(part: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return half sides of the profile's rectangle, and the length of its border (of a solid half of it)."""
    width = part["half"][..., :2].mean(-1) * (1 - part["hole"])
    across, up = _sides(width, part["half"][..., 2], part["profile"])
    return across, up, 4 * (across + up) * torch.where(part["hole"] > 0, 1.0, 0.5)


def lengths(part: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Lengths of a part's profile and of its longest section, scene units, within some ten per cent."""
    across, up = _sides(*part["half"][..., :2].unbind(-1), part["section"])
    profile = _profile(part)[2] * (1 + part["curve"] * part["curves"] / 8)
    section = 4 * (across + up) * (1 + part["taper"].abs() / 2 + part["wave"].abs())
    return profile, section * (1 + part["lobe"] * part["lobes"] / 4)


def _growth(part: dict[str, Tensor], z: Tensor) -> Tensor:
    turned = 1 - part["curve"] * (1 - torch.sin(part["curves"] * z + part["begin"])) / 2
    return (1 + part["taper"] * z + part["wave"] * torch.cos(part["waves"] * z)) * turned


def _lobed(part: dict[str, Tensor], x: Tensor, y: Tensor) -> Tensor:
    """How far the section reaches in the direction of (x, y), in units of half axes, over how far it would else."""
    return 1 - part["lobe"] * (1 - torch.cos(part["lobes"] * torch.atan2(y, x) + part["turn"])) / 2


def profile_points(part: dict[str, Tensor], s: Tensor) -> Tensor:
    """Return [..., 3]: radius of the section, shift along x and height z; scene units but for the radius.

    Args:
        part: Numbers of SHAPE that broadcast with s.
        s: [...], fractions of the profile, 0..1.
    """
    across, up, length = _profile(part)
    start = torch.where(part["hole"] > 0, 0, across)  # a solid's profile begins on the axis
    radius, z = _superellipse(start + s * length, across, up, part["profile"])
    radius = (part["hole"] + (1 - part["hole"]) * radius) * _growth(part, z)
    return torch.stack([radius, part["bend"] * (z * z - 0.5), part["half"][..., 2] * z], -1)


def section_points(part: dict[str, Tensor], t: Tensor) -> Tensor:
    """[..., 2]: x and y on the section of radius 1, scene units, at fractions t of its border, 0..1."""
    half = part["half"][..., :2]
    across, up = _sides(*half.unbind(-1), part["section"])
    x, y = _superellipse(t * 4 * (across + up), across, up, part["section"])
    return half * _lobed(part, x, y)[..., None] * torch.stack([x, y], -1)


def lies_inside(part: dict[str, Tensor], points: Tensor) -> Tensor:
    """Whether points [..., 3] in a part's local axes lie in it and not on its surface, bool [...]."""
    z = points[..., 2] / part["half"][..., 2]
    growth = _growth(part, z.clamp(-1, 1)).clamp_min(0.02)
    x = (points[..., 0] - part["bend"] * (z * z - 0.5)) / (part["half"][..., 0] * growth)
    y = points[..., 1] / (part["half"][..., 1] * growth)
    radius = _norm(x, y, part["section"]) / _lobed(part, x, y)
    radius = (radius - part["hole"]) / (1 - part["hole"])
    return (
        radius.abs().pow(part["profile"]) + z.abs().pow(part["profile"]) < (_DEEP - part["relief"]) ** part["profile"]
    )
