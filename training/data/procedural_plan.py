"""Random objects in numbers: the parts that each is made of, their looks, the light, and the cameras before it.

Made on the host for all examples at once; the pictures follow from it on the device (training/data/procedural.py).
Objects are built upright about their middle with y downwards, and turned into the axes of the source camera at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from training.data.relief import RELIEF, draw_relief, irregular, regular
from training.data.superquadrics import SHAPE, lengths, profile_points, section_points
from training.data.textures import SKIN, Photographs, draw_skin
from training.data.uniform import Numbers

DISTANCE = 1.3  # from the source camera to the object's middle, scene units, as in the project's data
_PARTS, GROUPS = 12, 6
# Surfels of an object for each pixel of an image, half of them unseen; more than the limit would make no difference.
_SURFELS_PER_PX, _MOST_SURFELS = 5, 160_000
# Numbers of a part's cells. sense: determinant of its matrix. start: cells of the object's parts before it. columns:
# cells round a section. first_row, first_column: where its curves begin in the plan's profiles and sections.
CELLS = {"matrix": 9, "centre": 3, "sense": 1, "start": 1, "columns": 1, "first_row": 1, "first_column": 1}
# Numbers of a part's look. base, second: the two colours of its pattern. waves, phases: three plane waves in its local
# axes, 1 / scene units. weights: of plain, gradient, stripes, checks, veins, and of the way that the surface faces.
# contrast: how abruptly the colours change. gloss: weight of the highlight.
LOOK = {"base": 3, "second": 3, "waves": 9, "phases": 3, "weights": 6, "contrast": 1, "gloss": 1}
NUMBERS = 1024  # uniform numbers that one object takes, at most
_FURTHER = 400  # the last of them, for relief and skin


@dataclass(frozen=True)
class ProceduralPlan:
    """B objects of P parts, before I = 1 + V cameras: the input picture, then the targets, the first the source too.

    Floats are float32.

    Attributes:
        ends: int64 [B,P], number of cells of a part and all before it.
        shapes, cells, looks: [B,P,F] in the order of superquadrics.SHAPE, CELLS and LOOK.
        reliefs, skins: [B,P,F] in the order of RELIEF and SKIN, unused without photographs.
        profiles: [R,6], for each row of cells of each part profile_points in its middle and their change over the row.
        sections: [C,4], likewise section_points for each column.
        light: [B,5], the direction that light comes from (unit), the fraction of light that comes from all round, the
            exponent of highlights.
        world_to_camera: [B,V,4,4], the world being the source camera's axes.
        sides, shifts: [B,I] and [B,I,2] of the crops, in units of the squares round the object.
        backgrounds: [B,V,3].
        surfels: Largest number of an object's surfels.
        source_px, target_px: Side of the input pictures and of the targets.
    """

    ends: Tensor
    shapes: Tensor
    cells: Tensor
    looks: Tensor
    reliefs: Tensor
    skins: Tensor
    profiles: Tensor
    sections: Tensor
    light: Tensor
    world_to_camera: Tensor
    sides: Tensor
    shifts: Tensor
    backgrounds: Tensor
    surfels: int
    source_px: int
    target_px: int
    photographs: Photographs | None = None


def rotation(axis: int, radians: np.ndarray) -> np.ndarray:
    """Matrices [...,3,3] that turn about a coordinate axis by angles [...]."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*np.shape(radians), 3, 3))
    out[..., axis, axis] = 1
    out[..., i, i] = out[..., j, j] = np.cos(radians)
    out[..., i, j], out[..., j, i] = -np.sin(radians), np.sin(radians)
    return out


def orbit(azimuth: np.ndarray, elevation: np.ndarray, tilt: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Return world-to-camera matrices [...,4,4] of cameras turned about the object's middle, in the source's axes.

    Args:
        azimuth, elevation: Radians from the source camera, about the object's upright axis.
        tilt, roll: Lean of this axis towards the source camera and sidewards, radians.
    """
    turned = rotation(0, tilt + elevation) @ rotation(1, azimuth) @ rotation(0, -tilt)
    turned = rotation(2, roll) @ turned @ rotation(2, -roll)
    middle = np.array([0, 0, DISTANCE])
    out = np.zeros((*turned.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = turned, middle - turned @ middle, 1
    return out


def _groups(u: Numbers) -> dict[str, np.ndarray]:
    """Groups of equal parts, [B,G,...]: how many copies (1, 2 mirrored, 4), half axes, shape; the first is the body."""
    first = np.arange(GROUPS) == 0
    copies = np.where(first, 1, u.chosen([1, 2, 4], [0.5, 0.25, 0.25], GROUPS))
    active = np.arange(GROUPS) < 1 + np.floor(GROUPS * u(1) ** 0.7)
    kind = np.where(first, u.chosen([0, 1, 2], [0.7, 0.2, 0.1], GROUPS), u.chosen([0, 1, 2], [0.4, 0.3, 0.3], GROUPS))
    size = np.where(first, 1, np.exp(u.between(np.log(0.2), np.log(0.8), GROUPS)))
    half = np.exp(u.between(-0.5, 0.5, GROUPS, 3)) * size[..., None]
    odd = np.eye(3, dtype=bool)[u.chosen([0, 1, 2], [0.3, 0.4, 0.3], GROUPS)]  # a stick's length, a plate's thickness
    thin = u.between(0.06, 0.25, GROUPS, 1)
    half = np.where((kind == 1)[..., None] & odd, thin * half, half)
    half = np.where((kind == 2)[..., None] & ~odd, 0.6 * thin * half, half)
    upright = (u(GROUPS) < 0.6) & (kind == 0)
    axis = np.where(upright, 1, np.where(u(GROUPS) < 0.8, odd.argmax(-1), np.floor(3 * u(GROUPS)))).astype(int)
    section = u.chosen([2, 3, 8, 1.2], [0.45, 0.1, 0.4, 0.05], GROUPS)
    round_ = section < 3
    hole = np.where(round_ & (u(GROUPS) < 0.25), u.between(0.55, 0.92, GROUPS), 0)
    taper = np.where(u(GROUPS) < 0.4, u.between(-0.85, 0.85, GROUPS), 0)
    wave = np.where(round_ & (u(GROUPS) < 0.3), u.between(-0.4, 0.4, GROUPS), 0) * (1 - np.abs(taper))
    order = (axis[..., None] + (1, 2, 0)) % 3
    local = np.take_along_axis(half, order, -1)
    steepest = np.minimum(1, local[..., 2] / local[..., :2].max(-1))  # else a plate's border would lie in few cells
    taper, wave = taper * steepest, wave * steepest
    bend = np.where((kind == 2) & (u(GROUPS) < 0.4), u.between(-0.6, 0.6, GROUPS), 0)
    tilted = (u(GROUPS) < 0.3) & ~first
    turns = np.where(tilted[..., None], u.between(-0.5, 0.5, GROUPS, 2), 0)
    basis = np.swapaxes(np.eye(3)[order], -1, -2)  # columns: the local axes in the object's axes
    basis = rotation(0, turns[..., 0]) @ rotation(2, turns[..., 1]) @ basis
    reach = local.copy()
    reach[..., :2] *= (1 + np.abs(wave) + np.abs(taper) / 2)[..., None]
    reach[..., 0] += np.abs(bend) / 2 * local[..., 2]
    box = (np.abs(basis) @ reach[..., None])[..., 0]
    return {
        "copies": copies * active,
        "half": local,
        "basis": basis,
        "box": box,
        "section": section,
        "profile": u.chosen([2, 4, 10, 1.2], [0.25, 0.15, 0.5, 0.1], GROUPS),
        "hole": hole,
        "taper": taper,
        "wave": wave,
        "waves": u.between(1.5, 7, GROUPS),
        "bend": bend * local[..., 2],
    }


def _placed(u: Numbers, groups: dict[str, np.ndarray]) -> np.ndarray:
    """Centres [B,G,3] of the first copies: each group touches an earlier one; those with mirrored copies the body."""
    rows, centre, box = np.arange(u.count), np.zeros((u.count, GROUPS, 3)), groups["box"]
    for group in range(1, GROUPS):
        copies = groups["copies"][:, group]
        parent = np.floor(group * u()).astype(int)
        parent = np.where((copies == 1) & (groups["copies"][rows, parent] == 1), parent, 0)
        reach, own = box[rows, parent], box[:, group]
        aside = u.between(-0.6, 0.6, 3)
        apart = u.between(0.45, 0.9, 3)  # mirrored copies must not fall into one
        aside[:, 0] = np.where(copies >= 2, apart[:, 0], aside[:, 0])
        aside[:, 2] = np.where(copies == 4, apart[:, 2], aside[:, 2])
        along = np.eye(3, dtype=bool)[u.chosen([0, 1, 2], [0.25, 0.5, 0.25])]
        sign = np.where((copies >= 2) & (u() < 0.7) | (u() < 0.5), 1, -1)[:, None]  # legs and wheels: mostly below
        sign = np.where((copies[:, None] >= 2) & ~along[:, 1:2], 1, sign)
        # How far the parent reaches there, were it a superellipsoid.
        exponent = np.minimum(groups["section"], groups["profile"])[rows, parent]
        rest = 1 - (np.abs(np.where(along, 0, aside)) ** exponent[:, None]).sum(-1)
        height = np.clip(rest, 0.02, 1) ** (1 / exponent)
        touching = sign * (0.8 * reach * height[:, None] + 0.8 * own)
        centre[:, group] = centre[rows, parent] + np.where(along, touching, aside * reach)
    return centre


def _parts(u: Numbers, further: Numbers | None) -> dict[str, np.ndarray]:
    """Return the numbers of SHAPE but rows, columns and start, and the group of each part; [B,P,...], in the object's
    axes.

    Entries without a part have `exists` false.

    Args:
        further: Numbers that make parts irregular; None: they are regular.
    """
    groups = _groups(u)
    groups |= regular(groups) if further is None else irregular(further, groups)
    groups["centre"] = _placed(u, groups)
    ends = np.cumsum(groups["copies"], 1)
    slot = np.arange(_PARTS)
    group = (ends[:, None] <= slot[:, None]).sum(-1)
    exists, group = group < GROUPS, np.minimum(group, GROUPS - 1)
    parts = {
        name: np.take_along_axis(values, group.reshape(*group.shape, *[1] * (values.ndim - 2)), 1)
        for name, values in groups.items()
    }
    copy = slot - (np.take_along_axis(ends, group, 1) - parts["copies"])
    mirror = np.stack([np.where(copy & 1, -1, 1), np.ones_like(copy), np.where(copy & 2, -1, 1)], -1)
    centre = mirror * parts["centre"]
    low = np.where(exists[..., None], centre - parts["box"], np.inf).min(1, keepdims=True)
    high = np.where(exists[..., None], centre + parts["box"], -np.inf).max(1, keepdims=True)
    scale = u.between(0.85, 1, 1, 1) / np.linalg.norm(high - low, axis=-1, keepdims=True)
    parts |= {
        "matrix": mirror[..., None] * parts["basis"],
        "sense": mirror.prod(-1),
        "exists": exists,
        "group": group,
        "centre": (centre - (low + high) / 2) * scale,
        "half": np.maximum(parts["half"] * scale, 2e-3),
        "bend": parts["bend"] * scale[..., 0],
    }
    return parts


def _tessellated(parts: dict[str, np.ndarray], surfels: int) -> tuple[np.ndarray, Tensor, Tensor]:
    """Add the numbers of CELLS beyond the placement: cells of about one size on all parts, at most `surfels` in all.

    Returns ends, profiles and sections of the plan.
    """
    numbers = {name: torch.from_numpy(parts[name]) for name in SHAPE}
    profile, section = (length.numpy() * parts["exists"] for length in lengths(numbers))
    # Cells of side 1/n: sum of (n profile + 1)(n section + 1) = surfels bounds the number after rounding up.
    area, border = (profile * section).sum(1), (profile + section).sum(1)
    n = (np.sqrt(border**2 + 4 * area * (surfels - _PARTS)) - border) / (2 * area)
    rows, columns = (np.ceil(n[:, None] * length).astype(np.int64) for length in (profile, section))
    ends = np.cumsum(rows * columns, 1)
    parts |= {
        "start": ends - rows * columns,
        "columns": np.maximum(columns, 1),
        "first_row": np.cumsum(rows).reshape(rows.shape) - rows,
        "first_column": np.cumsum(columns).reshape(rows.shape) - columns,
    }
    flat = {name: values.flatten(0, 1) for name, values in numbers.items()}
    return ends, *(
        _curve(points, flat, torch.from_numpy(counts.ravel()))
        for points, counts in ((profile_points, rows), (section_points, columns))
    )


def _curve(points: Callable[[dict[str, Tensor], Tensor], Tensor], parts: dict[str, Tensor], counts: Tensor) -> Tensor:
    """Return points [N,...] in the middles of the cells along the curves of all parts, and their changes over the
    cells.

    Args:
        counts: Number of cells of each part, N in all.
    """
    of_part = torch.repeat_interleave(counts)
    number = torch.arange(len(of_part)) - (counts.cumsum(0) - counts)[of_part]
    part = {name: values[of_part] for name, values in parts.items()}
    before, middle, after = points(part, (number + torch.tensor([[0], [0.5], [1]])) / counts[of_part])
    return torch.cat([middle, after - before], -1)


def draw_looks(u: Numbers) -> np.ndarray:
    """Return looks [B,GROUPS,F] in the order of LOOK, of one palette; waves are per half length of a part."""
    palette = u(5, 3) ** 0.7  # about as bright as man-made things
    grey = palette.mean(-1, keepdims=True)
    palette = np.clip(grey + (palette - grey) * u.between(0, 1.6, 1, 1), 0.02, 0.98)
    base, second = (np.take_along_axis(palette, np.floor(5 * u(GROUPS, 1)).astype(int), 1) for _ in range(2))
    second = base + (second - base) * u.between(0.2, 1, GROUPS, 1)
    directions = np.where(u(GROUPS, 3, 1) < 0.7, np.eye(3), u.between(-1, 1, GROUPS, 3, 3))
    waves = directions * np.exp(u.between(np.log(8), np.log(90), GROUPS, 1, 1))
    weights = np.eye(LOOK["weights"])[u.chosen(list(range(6)), [0.3, 0.15, 0.15, 0.15, 0.15, 0.1], GROUPS)]
    contrast = np.exp(u.between(0, 3, GROUPS, 1))
    gloss = np.where(u(GROUPS, 1) < 0.4, u.between(0, 0.5, GROUPS, 1), 0)
    return np.concatenate(
        [base, second, waves.reshape(*waves.shape[:2], 9), u.between(0, 6.28, GROUPS, 3), weights, contrast, gloss], -1
    )


def _looks(u: Numbers, parts: dict[str, np.ndarray]) -> np.ndarray:
    """[B,P,F] in the order of LOOK; all parts of a group look alike, and take their colours from one palette."""
    table = np.take_along_axis(draw_looks(u), parts["group"][..., None], 1)
    table[..., 6:15] /= parts["half"].max(-1, keepdims=True)
    return table


def _skins(
    further: Numbers | None, parts: dict[str, np.ndarray], photographs: Photographs | None
) -> tuple[np.ndarray, np.ndarray]:
    """reliefs and skins of the plan."""
    if further is None or photographs is None:
        return tuple(np.zeros((*parts["exists"].shape, sum(layout.values()))) for layout in (RELIEF, SKIN))
    return draw_relief(further, parts), draw_skin(further, parts["group"], GROUPS, photographs)


def draw_objects(
    rows: np.ndarray,
    cone_deg: tuple[float, float],
    sizes: tuple[int, int],
    framing: tuple[np.ndarray, np.ndarray],
    backgrounds: np.ndarray,
    photographs: Photographs | None = None,
) -> ProceduralPlan:
    """Return the plan of B objects from uniform numbers, rows [B,NUMBERS] in [0, 1).

    Args:
        cone_deg: Largest azimuth and elevation of the targets about the source.
        sizes: source_px and target_px.
        framing: sides and shifts, as in the plan.
        backgrounds: As in the plan.
        photographs: Skins of most parts, which then are irregular too; None: neither.
    """
    u = Numbers(rows)
    further = None if photographs is None else Numbers(rows[:, -_FURTHER:])
    parts = _parts(u, further)
    tilt = np.radians(u.between(-8, 40, 1))
    roll = np.where(u(1) < 0.15, u.between(-np.pi, np.pi, 1), np.radians(u.between(-4, 4, 1)))
    source = rotation(2, roll) @ rotation(0, tilt) @ rotation(1, u.between(-np.pi, np.pi, 1))  # [B,1,3,3]
    parts["matrix"] = (source @ parts["matrix"]).reshape(*parts["exists"].shape, 9)
    parts["centre"] = (source @ parts["centre"][..., None])[..., 0] + (0, 0, DISTANCE)
    # Distant parts cover nothing.
    parts["centre"] = np.where(parts["exists"][..., None], parts["centre"], 1e3)
    surfels = min(_SURFELS_PER_PX * max(sizes) ** 2, _MOST_SURFELS)
    ends, profiles, sections = _tessellated(parts, surfels)
    azimuth, elevation = (np.radians(limit) * u.between(-1, 1, backgrounds.shape[1]) for limit in cone_deg)
    azimuth[:, 0] = elevation[:, 0] = 0
    light = u.between(-1, 1, 3) + (0, -1, -0.7)  # mostly from above and from before the object
    light = light / np.linalg.norm(light, axis=-1, keepdims=True)
    shading = np.concatenate([light, u.between(0.45, 0.9, 1), np.exp(u.between(1.5, 4, 1))], -1)
    shapes, cells = (
        np.concatenate([parts[name].reshape(*ends.shape, count) for name, count in layout.items()], -1)
        for layout in (SHAPE, CELLS)
    )
    numbers = (
        shapes,
        cells,
        _looks(u, parts),
        *_skins(further, parts, photographs),
        profiles,
        sections,
        shading,
        orbit(azimuth, elevation, tilt, roll),
        *framing,
        backgrounds,
    )
    return ProceduralPlan(
        torch.from_numpy(ends),
        *(torch.as_tensor(values, dtype=torch.float32) for values in numbers),
        surfels,
        *sizes,
        photographs,
    )
