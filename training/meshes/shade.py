"""The colours of surfaces that samples see: attributes, textures, looks, light.

A surface has two sides: its normal is turned to the camera. Colours of material, vertex and texture, and the light, are
multiplied as sRGB values, as in the project's other sets. `shade` is one function of tensors alone, so that
torch.compile can make a few kernels of it for any number of samples.

Floor: a covered sample reads about 350 bytes (corners, attributes, texels, look) and writes 12. The operations one by
one move about 4,500. training/meshes/render.py has the sum over all stages.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from training.data.procedural import pattern_colours
from training.data.procedural_plan import GROUPS, LOOK
from training.data.superquadrics import named
from training.data.textures import SKIN, worn

# Numbers of the light in a view. ambient: colour of the light from all round. key, fill: unit directions to two lights
# in the camera's axes, with their colours. half, exponent: direction of the key light's highlights, and their exponent.
LIGHT = {"ambient": 3, "key": 3, "key_colour": 3, "fill": 3, "fill_colour": 3, "half": 3, "exponent": 1}
# How an object's own colours change. weight: of own colours, else those of the look. order: the channel that each
# channel shows. gain, gamma: colour = gain * own^gamma.
OWN = {"weight": 1, "order": 3, "gain": 3, "gamma": 1}
SHADOW_PX = 256  # side of a shadow map, which is 1 scene unit
_OFFSET, _BIAS = 0.012, 0.004  # of a surface along its normal and towards the light, lest it shade itself


@dataclass(frozen=True)
class Dressing:
    """Other colours than the objects' own.

    Attributes:
        first: int64 [K], first row of each draw's look.
        own: [Q,8], in the order of OWN.
        patterns: [Q,26], in the order of procedural_plan.LOOK.
        skins: [Q,12], in the order of textures.SKIN.
        pieces: Pieces of Photographs; None: no object wears any.
    """

    first: Tensor
    own: Tensor
    patterns: Tensor
    skins: Tensor
    pieces: Tensor | None


@dataclass(frozen=True)
class ShadowMaps:
    """How near the first surface of each texel is to the key light.

    Attributes:
        nearness: [Q,SHADOW_PX,SHADOW_PX], the third number of Projected.points for an orthographic camera; 0: nothing.
        to_light: [N,3,4], the axes of each view's camera to those of this camera.
        number: int64 [N], the map of each view; -1: none.
    """

    nearness: Tensor
    to_light: Tensor
    number: Tensor


@dataclass(frozen=True)
class Surfaces:
    """All that the look of a scene depends on, as tensors.

    Attributes:
        points, corners, draw, triangles: As in Projected.
        view, first_vertex, list_vertex, first_material: As in DrawList.
        to_camera, lights: As in Scene.
        intrinsics: [N,4], in samples.
        attributes, positions, material_of, rectangles, base_colours, texels: As in ResidentMeshes.
        dressing: None: objects have their own colours, without gloss.
        shadow_maps: None: no shadows.
    """

    points: Tensor
    corners: Tensor
    draw: Tensor
    triangles: Tensor
    view: Tensor
    first_vertex: Tensor
    list_vertex: Tensor
    first_material: Tensor
    to_camera: Tensor
    lights: Tensor
    intrinsics: Tensor
    attributes: Tensor
    positions: Tensor
    material_of: Tensor
    rectangles: Tensor
    base_colours: Tensor
    texels: Tensor
    dressing: Dressing | None = None
    shadow_maps: ShadowMaps | None = None


def place(sample: Tensor, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return view, x and y of the centres of samples, numbered by views of side x side."""
    row = sample.div(side, rounding_mode="floor")
    view = row.div(side, rounding_mode="floor")
    return view, sample - row * side + 0.5, row - view * side + 0.5


def weights(surfaces: Surfaces, triangle: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return weights [S,3] of a triangle's corners at places on the grid, true to perspective, and z [S]."""
    points = surfaces.points[surfaces.corners[triangle]]
    (x1, y1), (x2, y2) = ((points[:, corner, :2] - points[:, 0, :2]).unbind(1) for corner in (1, 2))
    x, y = x - points[:, 0, 0], y - points[:, 0, 1]
    area = x1 * y2 - x2 * y1
    second, third = (
        torch.where(area.abs() > 1e-9, value / area, 1 / 3).clamp(0, 1) for value in (x * y2 - y * x2, y * x1 - x * y1)
    )
    screen = torch.stack([(1 - second - third).clamp_min(0), second, third], 1) * points[..., 2]
    total = screen.sum(1)
    return screen / total[:, None], 1 / total


def interpolated(surfaces: Surfaces, triangle: Tensor, weight: Tensor, values: Tensor) -> Tensor:
    """Return the values [S,C] of vertices [N,C] in the pack, at points of triangles."""
    draw = surfaces.draw[triangle]
    shift = surfaces.first_vertex[draw] - surfaces.list_vertex[draw]
    return (values[surfaces.corners[triangle] + shift[:, None]] * weight[..., None]).sum(1)


def material(surfaces: Surfaces, triangle: Tensor) -> Tensor:
    """Return the materials of triangles, their numbers in the pack, int64 [S]."""
    return surfaces.first_material[surfaces.draw[triangle]] + surfaces.material_of[surfaces.triangles[triangle]]


def texture(surfaces: Surfaces, number: Tensor, uv: Tensor) -> Tensor:
    """Return RGBA [S,4], 0..1, of places in the textures of materials: the bilinear mean of four texels.

    A texture repeats inside its material's rectangle, also for the texels beside a border.
    """
    offset, stride, left, top, width, height = surfaces.rectangles[number].long().unbind(1)

    def neighbours(place: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        side = side.clamp_min(1)
        texel = side * (place - place.floor()) - 0.5
        first = texel.floor()
        return first.long() % side, (first.long() + 1) % side, (texel - first)[:, None]

    x0, x1, x = neighbours(uv[:, 0], width)
    y0, y1, y = neighbours(uv[:, 1], height)

    def texel(row: Tensor, column: Tensor) -> Tensor:
        return surfaces.texels[offset + (top + row) * stride + left + column].float()

    upper, lower = (torch.lerp(texel(row, x0), texel(row, x1), x) for row in (y0, y1))
    return torch.lerp(upper, lower, y) / 255


def normals(surfaces: Surfaces, draw: Tensor, own_normal: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return unit normals [S,3] in the axes of the cameras, turned to them, of those in the axes of objects."""
    fx, fy, cx, cy = surfaces.intrinsics[surfaces.view[draw]].unbind(1)
    ray = torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(x)], 1)
    normal = F.normalize((surfaces.to_camera[..., :3][draw] * own_normal[:, None]).sum(-1), dim=1)
    return torch.where((normal * ray).sum(1, keepdim=True) > 0, -normal, normal)


def holes(surfaces: Surfaces, cut: Tensor, side: int, triangle: Tensor, sample: Tensor) -> Tensor:
    """Return which fragments are holes of their material, bool [F].

    Args:
        cut: bool [M], which materials have holes.
    """
    hole = cut[material(surfaces, triangle)]
    chosen = hole.nonzero()[:, 0]
    triangle, (_, x, y) = triangle[chosen], place(sample[chosen], side)
    uv = interpolated(surfaces, triangle, weights(surfaces, triangle, x, y)[0], surfaces.attributes[:, 3:5])
    hole[chosen] = texture(surfaces, material(surfaces, triangle), uv)[:, 3] < 0.5
    return hole


def shade(surfaces: Surfaces, side: int, triangle: Tensor, sample: Tensor) -> Tensor:
    """Return the sRGB colours [S,3] of the surfaces that samples see.

    Args:
        triangle, sample: int64 [S], the triangle that each sample sees, and its number.
    """
    view, x, y = place(sample, side)
    weight, z = weights(surfaces, triangle, x, y)
    attributes = interpolated(surfaces, triangle, weight, surfaces.attributes)
    own_normal, uv, vertex_colour = attributes[:, :3], attributes[:, 3:5], attributes[:, 5:]
    draw, number = surfaces.draw[triangle], material(surfaces, triangle)
    textured = surfaces.rectangles[number, 4:5] > 0
    colour = torch.where(textured, texture(surfaces, number, uv)[:, :3], 1)
    colour = surfaces.base_colours[number] * vertex_colour * colour
    gloss = torch.zeros_like(x)
    if surfaces.dressing is not None:
        local = interpolated(surfaces, triangle, weight, surfaces.positions)
        row = surfaces.dressing.first[draw] + surfaces.material_of[surfaces.triangles[triangle]] % GROUPS
        colour, gloss = _dressed(surfaces.dressing, row, local, F.normalize(own_normal, dim=1), colour)
    normal, light = normals(surfaces, draw, own_normal, x, y), named(surfaces.lights[view], LIGHT)
    if surfaces.shadow_maps is not None:
        fx, fy, cx, cy = surfaces.intrinsics[view].unbind(1)
        position = torch.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], 1)
        light["key_colour"] = (
            light["key_colour"] * _unshadowed(surfaces.shadow_maps, view, position + _OFFSET * normal)[:, None]
        )
    return _lit(colour, gloss, normal, light)


def geometry(surfaces: Surfaces, side: int, triangle: Tensor, sample: Tensor) -> tuple[Tensor, Tensor]:
    """Return z [S] and normals [S,3] of the surfaces that samples see; arguments as of shade."""
    _, x, y = place(sample, side)
    weight, z = weights(surfaces, triangle, x, y)
    own_normal = interpolated(surfaces, triangle, weight, surfaces.attributes[:, :3])
    return z, normals(surfaces, surfaces.draw[triangle], own_normal, x, y)


def _dressed(
    dressing: Dressing, row: Tensor, local: Tensor, own_normal: Tensor, colour: Tensor
) -> tuple[Tensor, Tensor]:
    """Return colours [S,3] as looks change them, and gloss [S].

    Args:
        row: Rows of the looks.
        local, own_normal: Points and unit normals in the axes of the objects.
    """
    own, pattern = named(dressing.own[row], OWN), named(dressing.patterns[row], LOOK)
    colour = own["gain"] * colour.gather(1, own["order"].long()).clamp_min(1e-6).pow(own["gamma"][:, None])
    other = pattern_colours(pattern, local, own_normal)
    if dressing.pieces is not None:
        skin = dressing.skins[row]
        skinned = worn(skin, dressing.pieces, local, own_normal, pattern["base"], pattern["second"])
        other = torch.lerp(other, skinned, named(skin, SKIN)["weight"][:, None])
    return torch.lerp(other, colour, own["weight"][:, None]).clamp(0, 1), pattern["gloss"]


def _unshadowed(maps: ShadowMaps, view: Tensor, position: Tensor) -> Tensor:
    """Return the fraction of the key light that reaches places [S,3] in the axes of the cameras, 0..1.

    It is the mean over a square of three texels (percentage-closer filtering; Reeves et al. 1987).
    """
    matrix, number = maps.to_light[view], maps.number[view]
    x, y, z = ((matrix[..., :3] * position[:, None]).sum(-1) + matrix[..., 3]).unbind(1)
    x, y = (SHADOW_PX * along + (SHADOW_PX - 1) / 2 for along in (x, y))
    (left, x), (top, y) = ((along.floor(), along - along.floor()) for along in (x, y))
    texels, near = maps.nearness.view(-1), _BIAS - z
    lit, whole = torch.zeros_like(z), torch.ones_like(z)
    for down, height in zip((-1, 0, 1, 2), (1 - y, whole, whole, y)):
        row = (number * SHADOW_PX + (top.long() + down).clamp(0, SHADOW_PX - 1)) * SHADOW_PX
        for right, width in zip((-1, 0, 1, 2), (1 - x, whole, whole, x)):
            nearest = texels[(row + (left.long() + right).clamp(0, SHADOW_PX - 1)).clamp_min(0)]
            lit = lit + height * width * (nearest <= near)
    return torch.where(number < 0, 1, lit / 9)


def _lit(colour: Tensor, gloss: Tensor, normal: Tensor, light: dict[str, Tensor]) -> Tensor:
    """Return colours [S,3] under the light."""
    strength = light["ambient"]
    for name in ("key", "fill"):
        strength = strength + (normal * light[name]).sum(1, keepdim=True).clamp_min(0) * light[f"{name}_colour"]
    facing = (normal * light["half"]).sum(1).clamp_min(1e-6)
    highlight = (gloss * facing.pow(light["exponent"]))[:, None] * light["key_colour"]
    return (colour * strength + highlight).clamp(0, 1)
