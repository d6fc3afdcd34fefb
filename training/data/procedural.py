"""Pictures of random objects: surfels on superquadrics, coloured, lit, and rendered by the project's rasterizer.

All objects go through the same hundreds of tensor operations. The host waits for the device in the rasterizer, and
before it leaves out hidden surfels. So the objects of several steps are drawn at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.models.crop import MARGIN
from lightfield_gs.scene.gaussians import Gaussians
from training.data.fusing import fused
from training.data.procedural_plan import CELLS, LOOK, ProceduralPlan
from training.data.relief import raised
from training.data.superquadrics import SHAPE, lies_inside, named
from training.data.textures import SKIN, worn
from training.data.transfer import on_device
from training.rendering import render_views

# Standard deviation of a surfel in cells: with its neighbours less than 2 % of the surfaces behind shows.
_SPREAD, _OPACITY = 0.7, 0.98
_SUPERSAMPLING = 2
_OBJECTS_AT_ONCE = 32  # enough work for a GPU to keep up with the host; some 150 MB each for a moment, at 256 px


def steps_of_block(objects: int) -> int:
    """How many steps of so many objects each are drawn in one go."""
    return max(1, _OBJECTS_AT_ONCE // objects)


class ProceduralBlock:
    """The objects of some steps in a row, drawn in one go when the first of them is asked for."""

    def __init__(self, plan: ProceduralPlan) -> None:
        self._plan = plan
        self._drawn: tuple[Tensor, ...] = ()

    def drawn(self, device: torch.device, compiled: bool) -> tuple[Tensor, ...]:
        """The fields of a Batch of all objects, drawn as the first call says."""
        if not self._drawn:
            plan = on_device(self._plan, device)
            self._drawn = *draw_pictures(plan, compiled), plan.world_to_camera, plan.backgrounds
        return self._drawn


@dataclass(frozen=True)
class ProceduralExamples:
    """The objects of one step.

    Attributes:
        chosen: Their numbers in the block.
    """

    block: ProceduralBlock
    chosen: slice

    def drawn(self, device: torch.device, compiled: bool) -> tuple[Tensor, ...]:
        """Return the fields of a Batch, on a device.

        Args:
            compiled: See make_batch.
        """
        return tuple(values[self.chosen] for values in self.block.drawn(device, compiled))


@torch.no_grad()
def draw_pictures(plan: ProceduralPlan, compiled: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return input pictures [B,4,S,S], their intrinsics [B,4], targets [B,V,4,T,T] and their intrinsics [B,V,4].

    Args:
        compiled: See make_batch; it compiles the operations whose shapes are the same in all blocks.
    """
    surfels = _visible(_surfels(plan), plan, compiled)
    gaussians = _drawn(surfels, plan)
    focal, centre = _squares(surfels, plan)
    source, targets = slice(0, 1), slice(1, None)
    pictures = []
    for chosen, cameras, size in (
        (source, plan.world_to_camera[:, :1], plan.source_px),
        (targets, plan.world_to_camera, plan.target_px),
    ):
        intrinsics = size * torch.cat([focal[:, chosen].expand(-1, -1, 2), centre[:, chosen]], -1)
        pictures += [_pictures(gaussians, cameras, intrinsics, size), intrinsics]
    return pictures[0][:, 0], pictures[1][:, 0], pictures[2], pictures[3]


@torch.no_grad()
def draw_frames(plan: ProceduralPlan, intrinsics: Tensor) -> Tensor:
    """Return the whole frame of each camera of a plan's world_to_camera: premultiplied RGBA [B,V,4,T,T].

    Args:
        intrinsics: [4], (fx, fy, cx, cy) in pixels of frames of target_px.
    """
    frames = intrinsics.expand(*plan.world_to_camera.shape[:2], 4)
    return _pictures(_drawn(_visible(_surfels(plan), plan), plan), plan.world_to_camera, frames, plan.target_px)


def _drawn(surfels: dict[str, Tensor], plan: ProceduralPlan) -> Gaussians:
    """Surfels, coloured and lit."""
    return _gaussians(surfels, _lit(*_coloured(surfels, plan), surfels["normal"], plan.light))


def _pictures(gaussians: Gaussians, cameras: Tensor, intrinsics: Tensor, size: int) -> Tensor:
    """[B,V,4,size,size], premultiplied RGBA, rendered larger for sharper edges."""
    large = _SUPERSAMPLING * size
    images, alpha = render_views(
        gaussians, cameras, _SUPERSAMPLING * intrinsics, large, large, cameras.new_zeros(*cameras.shape[:2], 3)
    )
    images = torch.cat([images, alpha[:, :, None]], 2).flatten(0, 1)
    return F.avg_pool2d(images, _SUPERSAMPLING).clamp(0, 1).unflatten(0, cameras.shape[:2])


def _surfels(plan: ProceduralPlan) -> dict[str, Tensor]:
    """A surfel for each cell of all parts [B,M,...], in the source camera's axes.

    part: int64, number of its part, that of no part where there is no surfel. local: point in the part's axes. point,
    along, across: middle and sides of the cell. normal: unit, outwards.
    """
    count, parts = plan.ends.shape
    places = torch.arange(plan.surfels, device=plan.ends.device)
    part = torch.searchsorted(plan.ends, places.expand(count, -1).contiguous(), right=True)
    cell = named(_gathered(plan.cells, part.clamp_max(parts - 1)), CELLS)
    place = places - cell["start"]
    row = torch.div(place + 0.5, cell["columns"], rounding_mode="floor")
    column = (cell["first_column"] + place - row * cell["columns"]).long()
    profile = plan.profiles[(cell["first_row"] + row).long().clamp_max(len(plan.profiles) - 1)]
    x, x_step = plan.sections[column.clamp_max(len(plan.sections) - 1)].split(2, -1)
    radius, shift, height, radius_step, shift_step, height_step = profile.split(1, -1)
    local = torch.cat([radius * x, height], -1)
    local[..., :1] += shift
    along = torch.cat([radius_step * x, height_step], -1)
    along[..., :1] += shift_step
    across = F.pad(radius * x_step, (0, 1))
    if plan.photographs is not None:
        local, along, across = raised(_gathered(plan.reliefs, part.clamp_max(parts - 1)), local, along, across)
    matrix = cell["matrix"].unflatten(-1, (3, 3))
    point, along, across = ((matrix * vector[..., None, :]).sum(-1) for vector in (local, along, across))
    normal = F.normalize(torch.linalg.cross(across, along), dim=-1, eps=1e-20) * cell["sense"][..., None]
    return {
        "part": part,
        "local": local,
        "point": point + cell["centre"],
        "along": along,
        "across": across,
        "normal": normal,
    }


def _gathered(table: Tensor, index: Tensor) -> Tensor:
    """Rows [B,M,F] of tables [B,P,F]."""
    return table.gather(1, index[..., None].expand(-1, -1, table.shape[-1]))


def _seen(point: Tensor, normal: Tensor, part: Tensor, shapes: Tensor, world_to_camera: Tensor) -> Tensor:
    """Which surfels face a camera and lie in no other part, bool [B,M]. Arguments: of _surfels, and of the plan."""
    parts = shapes.shape[1]
    rotation, translation = world_to_camera[..., :3, :3], world_to_camera[..., :3, 3:]
    positions = -(rotation.mT @ translation)[..., 0]  # of the cameras
    facing = (normal @ positions.mT).amax(-1) > (normal * point).sum(-1)
    shape = named(shapes[:, :, None], SHAPE)
    local = (point[:, None] - shape["centre"]) @ shape["matrix"].squeeze(2).unflatten(-1, (3, 3))
    others = torch.arange(parts, device=part.device)[:, None] != part[:, None]
    hidden = (lies_inside(shape, local) & others).any(1)
    return facing & ~hidden & (part < parts)


def _visible(surfels: dict[str, Tensor], plan: ProceduralPlan, compiled: bool = False) -> dict[str, Tensor]:
    """The surfels that may be seen, [B,N,...], N as the fullest object needs.

    filled: 1, or 0 at the end of objects that need fewer, which repeat one of theirs.
    """
    part = surfels["part"]
    kept = fused(_seen, compiled)(surfels["point"], surfels["normal"], part, plan.shapes, plan.world_to_camera)
    places = kept.cumsum(1)
    count = int(places[:, -1].max())
    chosen = part.new_zeros(len(part), count + 1)
    numbers = torch.arange(part.shape[1], device=part.device).expand_as(part)
    chosen.scatter_(1, torch.where(kept, places - 1, count), numbers)
    index = chosen[:, :count]
    out = {name: _gathered(values, index) for name, values in surfels.items() if name != "part"}
    filled = torch.arange(count, device=part.device) < places[:, -1:]
    return out | {"part": part.gather(1, index), "filled": filled.to(out["point"].dtype)}


def _coloured(surfels: dict[str, Tensor], plan: ProceduralPlan) -> tuple[Tensor, Tensor]:
    """Return colours [B,N,3] without light, and gloss [B,N]; a part has two colours in a pattern, or a skin."""
    look = named(_gathered(plan.looks, surfels["part"]), LOOK)
    colours = pattern_colours(look, surfels["local"], surfels["normal"])
    if plan.photographs is not None:
        skin = _gathered(plan.skins, surfels["part"])
        matrix = _gathered(plan.cells, surfels["part"])[..., : CELLS["matrix"]].unflatten(-1, (3, 3))
        facing = (matrix * surfels["normal"][..., None]).sum(-2)
        pieces = plan.photographs.on(colours.device)
        skinned = worn(skin, pieces, surfels["local"], facing, look["base"], look["second"])
        colours = torch.lerp(colours, skinned, named(skin, SKIN)["weight"][..., None])
    return colours, look["gloss"]


def pattern_colours(look: dict[str, Tensor], local: Tensor, normal: Tensor) -> Tensor:
    """Return colours [...,3] of points [...,3] in the axes of a part: its two colours, mixed by its pattern.

    Args:
        look: The numbers of LOOK at each point.
        normal: [...,3], unit.
    """
    waves = look["waves"].unflatten(-1, (3, 3))
    phase = (waves * local[..., None, :]).sum(-1) + look["phases"]
    first, second, third = phase.sin().unbind(-1)
    gradient = (0.1 * phase[..., 0]).sin()
    veins = (phase[..., 0] + 2 * (phase[..., 1] + 2 * third).sin()).sin()
    facing = (normal * F.normalize(waves[..., 0, :], dim=-1)).sum(-1)
    values = torch.stack([torch.full_like(first, -10), gradient, first, first * second * third, veins, facing], -1)
    weight = torch.sigmoid(look["contrast"] * (values * look["weights"]).sum(-1))
    return torch.lerp(look["base"], look["second"], weight[..., None])


def _lit(colours: Tensor, gloss: Tensor, normal: Tensor, light: Tensor) -> Tensor:
    """Colours [B,N,3] under the light, with highlights as the source camera sees them."""
    direction, ambient, exponent = light[:, :3, None], light[:, 3:4], light[:, 4:5]
    diffuse = (normal @ direction)[..., 0].clamp_min(0)
    sky = 0.9 - 0.15 * normal[..., 1]  # more comes from above
    # The viewer stands at -z of all surfels, near enough.
    half = F.normalize(direction - torch.eye(3, device=light.device)[:, 2:], dim=1)
    highlight = gloss * (normal @ half)[..., 0].clamp_min(0).pow(exponent)
    strength = ambient * sky + 1.3 * (1 - ambient) * diffuse
    return (colours * strength[..., None] + highlight[..., None]).clamp(0, 1)


def _squares(surfels: dict[str, Tensor], plan: ProceduralPlan) -> tuple[Tensor, Tensor]:
    """Return focal lengths [B,I,1] and principal points [B,I,2] of images in units of their sides."""
    cameras = torch.cat([plan.world_to_camera[:, :1], plan.world_to_camera], 1)
    points = surfels["point"][:, None] @ cameras[..., :3, :3].mT + cameras[..., None, :3, 3]
    low, high = (points[..., :2] / points[..., 2:]).aminmax(dim=2)
    side = (1 + 2 * MARGIN) * (high - low).amax(-1, keepdim=True)
    focal = 1 / (side * plan.sides[..., None])
    return focal, 0.5 - ((low + high) / 2 + plan.shifts * side) * focal


def _gaussians(surfels: dict[str, Tensor], colours: Tensor) -> Gaussians:
    """Flat Gaussians as large as their cells."""
    normal, length = surfels["normal"], surfels["along"].norm(dim=-1)
    first = surfels["along"] / length.clamp_min(1e-12)[..., None]
    second = torch.linalg.cross(normal, first)
    width = (surfels["across"] * second).sum(-1).abs()
    sides = torch.stack([length, width, 0.05 * torch.minimum(length, width)], -1)
    opacities = _OPACITY * surfels["filled"]
    return Gaussians(
        surfels["point"],
        _quaternions(torch.stack([first, second, normal], -1)),
        (_SPREAD * sides).clamp_min(1e-5),
        opacities,
        ((colours - 0.5) / SH_CONSTANT)[:, :, None],
    )


# The products 4 q q^T of a rotation's quaternion wxyz, by rows, are linear in the matrix: m[i] is +-1 at these places.
_PRODUCTS = {
    0: ((0, 1), (5, 1), (10, -1), (15, -1)),
    4: ((0, 1), (5, -1), (10, 1), (15, -1)),
    8: ((0, 1), (5, -1), (10, -1), (15, 1)),
    7: ((1, 1), (4, 1), (11, 1), (14, 1)),
    5: ((1, -1), (4, -1), (11, 1), (14, 1)),
    2: ((2, 1), (8, 1), (7, 1), (13, 1)),
    6: ((2, -1), (8, -1), (7, 1), (13, 1)),
    3: ((3, 1), (12, 1), (6, 1), (9, 1)),
    1: ((3, -1), (12, -1), (6, 1), (9, 1)),
}


@lru_cache(maxsize=8)
def _products(device: torch.device) -> tuple[Tensor, Tensor]:
    """[9,16] and [16]: what turns a matrix by rows into those products. Made once: copying waits for a device."""
    linear = torch.zeros(9, 16)
    for entry, places in _PRODUCTS.items():
        for place, sign in places:
            linear[entry, place] = sign
    return linear.to(device), torch.eye(4).flatten().to(device)


def _quaternions(matrix: Tensor) -> Tensor:
    """Quaternions wxyz, of any length, of rotations [...,3,3]: the row of 4 q q^T with the largest diagonal."""
    linear, constant = _products(matrix.device)
    products = (matrix.flatten(-2) @ linear + constant).unflatten(-1, (4, 4))
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(-1)
    return products.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
