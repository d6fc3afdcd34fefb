"""Compositions with truth: meshes and planes in front of each other, their first surface and the second behind it.

The second surface is what remains where the first one's object is taken away. So it is known wherever one thing hides
another, and not where an object hides a part of itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from training.data.procedural_plan import rotation
from training.data.transfer import on_device
from training.data.uniform import Numbers
from training.hidden.cards import CARD_NUMBERS, CARDS, Cards, draw_cards, render_cards
from training.meshes.pack import ResidentMeshes
from training.meshes.rasterize import DrawList, list_draws
from training.meshes.render import Scene, render_pictures
from training.meshes.scenes import standard_light
from training.meshes.shade import LIGHT
from training.ranges import check_ranges

OBJECTS = 3
_SCENE_NUMBERS, _OBJECT_NUMBERS = 8, 40
_UPRIGHT = np.diag([1.0, -1.0, -1.0])  # from axes with y up, z backwards to those with y down, z forward


@dataclass(frozen=True)
class CompositionOptions:
    """Ranges of compositions; lengths by the distance of the nearest things.

    Args:
        size_px: Side of the pictures.
        focal: Range of the focal length by the side; large ones are for pieces of larger photographs.
        farthest: Range of the distance of the wall behind everything.
        objects: Probabilities, 0..1, of the first, second and third mesh.
        extent: Range of the diagonal of a mesh by the side of the picture.
    """

    size_px: int = 320
    focal: tuple[float, float] = (0.8, 2.6)
    farthest: tuple[float, float] = (1.08, 4.0)
    objects: tuple[float, float, float] = (1.0, 0.6, 0.3)
    extent: tuple[float, float] = (0.25, 1.1)

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "compositions.",
            size_px=(64, 2048),
            focal=(0.3, 10.0),
            farthest=(1.01, 20.0),
            objects=(0.0, 1.0),
            extent=(0.01, 4.0),
        )
        for name in ("focal", "farthest", "extent"):
            low, high = getattr(self, name)
            if low > high:
                raise InputError(f"compositions.{name}: expected the smaller number first, got {low:g}, {high:g}")


@dataclass(frozen=True)
class Composition:
    """B pictures with their two surfaces.

    Attributes:
        first: [B,3,S,S], colours 0..1 that the camera sees.
        first_depth: [B,S,S], z of the nearest surface of each pixel.
        second: [B,3,S,S], colours without the object of this surface.
        second_depth: [B,S,S].
        focal_px: Of all.
    """

    first: Tensor
    first_depth: Tensor
    second: Tensor
    second_depth: Tensor
    focal_px: float


@dataclass(frozen=True)
class _Plan:
    """Attributes: draws, to_camera, intrinsics, lights as in Scene, one view for each place of a mesh; order int64
    [BJ,3] and gain [BJ,3] of its colours; cards; focal_px."""

    draws: DrawList
    to_camera: Tensor
    intrinsics: Tensor
    lights: Tensor
    order: Tensor
    gain: Tensor
    cards: Cards
    focal_px: float


class Compositions:
    """Draws compositions.

    Args:
        meshes: What stands in front, on the device that draws.
        pictures: uint8 [T,3,P,P] on the same device, what planes wear.
    """

    def __init__(self, meshes: ResidentMeshes, pictures: Tensor, options: CompositionOptions) -> None:
        self._meshes, self._pictures, self._options = meshes, pictures, options

    def make(self, rng: np.random.Generator, count: int, compiled: bool = False) -> Composition:
        """Return new compositions, all of one focal length; compiled: see render_images."""
        plan = on_device(self._plan(rng, count), self._meshes.device)
        size = self._options.size_px
        scene = Scene(plan.draws, plan.to_camera, plan.intrinsics, plan.lights, size)
        drawn = render_pictures(self._meshes, scene, compiled=compiled)
        colours = drawn.images[:, :3].gather(1, plan.order[..., None, None].expand(-1, -1, size, size))
        colours = (plan.gain[..., None, None] * colours).minimum(drawn.images[:, 3:])
        z = torch.where(drawn.depth > 0, drawn.depth, torch.inf)
        card_colours, card_alpha, card_z = render_cards(plan.cards, self._pictures, plan.focal_px, size)
        alpha = torch.cat([drawn.images[:, 3].unflatten(0, (count, OBJECTS)), card_alpha], 1)
        z = torch.cat([z.unflatten(0, (count, OBJECTS)), card_z], 1)
        colours = torch.cat([colours.unflatten(0, (count, OBJECTS)), card_colours * card_alpha[:, :, None]], 1)
        return Composition(*_two_surfaces(colours, alpha, z), plan.focal_px)

    def _plan(self, rng: np.random.Generator, count: int) -> _Plan:
        options = self._options
        u, each, planes = (
            Numbers(rng.random(shape))
            for shape in ((count, _SCENE_NUMBERS), (count * OBJECTS, _OBJECT_NUMBERS), (count * CARDS, CARD_NUMBERS))
        )
        focal = options.size_px * float(np.exp(rng.uniform(*np.log(options.focal))))
        farthest = np.exp(u.between(*np.log(options.farthest)))
        exists = each().reshape(count, OBJECTS) < np.array(options.objects)
        objects = np.floor(len(self._meshes.meshes) * each()).astype(int).reshape(count, OBJECTS)
        # The first mesh is in front; the others stand anywhere between it and the wall
        z = farthest[:, None] ** (0.9 * each().reshape(count, OBJECTS))
        z[:, 0] = 1
        extent = np.exp(each.between(*np.log(options.extent))).reshape(count, OBJECTS) * options.size_px
        at = each.between(-0.5, 0.5, 2).reshape(count, OBJECTS, 2) * options.size_px
        scale = extent * z / focal
        tilt, yaw = np.radians(each.between(-15, 40)), each.between(-np.pi, np.pi)
        roll = np.where(each() < 0.25, each.between(-np.pi, np.pi), np.radians(each.between(-5, 5)))
        turned = rotation(2, roll) @ rotation(0, tilt) @ rotation(1, yaw) @ _UPRIGHT
        # An object is deep as well: its nearest point stays before the camera
        middle = np.stack([*np.moveaxis(at, -1, 0) / focal, np.ones_like(z)], -1)
        middle = middle * (z + 0.3 * scale)[..., None]
        to_camera = np.concatenate(
            [scale[..., None, None] * turned.reshape(count, OBJECTS, 3, 3), middle[..., None]], -1
        )
        lights = standard_light(np.linalg.inv(rotation(1, each.between(-np.pi, np.pi))) @ _UPRIGHT)
        view = np.arange(count * OBJECTS).reshape(count, OBJECTS)
        half = options.size_px / 2
        recolour = each()[:, None] < 0.6
        return _Plan(
            list_draws(self._meshes.meshes, objects[exists], view[exists], count * OBJECTS),
            _floats(to_camera[exists]),
            _floats(np.tile([focal, focal, half, half], (count * OBJECTS, 1))),
            _floats(lights.reshape(-1, sum(LIGHT.values()))),
            torch.from_numpy(np.where(recolour, np.argsort(each(3), -1), np.arange(3))),
            _floats(np.where(recolour, 0.4 + 0.9 * each(3), 1)),
            draw_cards(planes, len(self._pictures), farthest, focal, options.size_px),
            focal,
        )


def _two_surfaces(colours: Tensor, alpha: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the first four fields of a Composition.

    Args:
        colours: [B,K,3,S,S], premultiplied, of K things, the last CARDS of them planes.
        alpha: [B,K,S,S].
        z: [B,K,S,S], infinite where a thing is not.
    """
    z = torch.where(alpha > 0, z, torch.inf)
    order = z.argsort(1)
    nearest = order[:, :1]
    first = _over(colours, alpha, order)
    without = alpha.scatter(1, nearest, 0.0)
    second = _over(colours.scatter(1, nearest[:, :, None].expand(-1, -1, 3, -1, -1), 0.0), without, order)
    depths = z.scatter(1, nearest, torch.inf).amin(1)
    return first, z.amin(1), second, depths


def _over(colours: Tensor, alpha: Tensor, order: Tensor) -> Tensor:
    """Return what things of this order [B,K,S,S] look like over each other, [B,3,S,S]."""
    result, light = torch.zeros_like(colours[:, 0]), torch.ones_like(alpha[:, :1])
    for place in order.split(1, 1):
        result = result + light * colours.gather(1, place[:, :, None].expand(-1, -1, 3, -1, -1))[:, 0]
        light = light * (1 - alpha.gather(1, place))
    return result + light * 0.5  # nothing is behind the last thing


def _floats(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
