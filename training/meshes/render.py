"""Pictures of textured meshes: colour, alpha, depth, normals and object numbers of many views at once.

Each pixel is the mean of 2x2 samples; alpha is the fraction that sees a surface. A surface has two sides: its normal is
turned to the camera. Colours of material, vertex and texture, and the light, are multiplied as sRGB values, as in the
project's other sets. All work is torch operations on the device of the meshes, for which the host waits three times.

Floor: a covered sample reads about 250 bytes of corners, attributes and texels and writes 16; eager operations move
about 2,000. A view of 128 px has about 26,000 covered samples, 52 MB or 20 us of an H100's memory; with the fragments
(training/meshes/rasterize.py) about 30 us, 30,000 views a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from training.data.procedural import pattern_colours
from training.data.procedural_plan import GROUPS, LOOK
from training.data.superquadrics import named
from training.data.textures import SKIN, Photographs, worn
from training.meshes.pack import ResidentMeshes
from training.meshes.rasterize import DrawList, Projected, project, rasterize

SAMPLES = 2  # of a pixel along each axis
# Numbers of the light in a view, in the camera's axes: of what comes from all round; directions to two lights (unit)
# and their colours; the direction of highlights, and their exponent.
LIGHT = {"ambient": 3, "key": 3, "key_colour": 3, "fill": 3, "fill_colour": 3, "half": 3, "exponent": 1}
# How an object's own colours change. weight: of own colours, else those of the look. order: the channel that each
# channel shows. gain, gamma: colour = gain * own^gamma.
OWN = {"weight": 1, "order": 3, "gain": 3, "gamma": 1}
_SAMPLES_AT_ONCE = 1 << 22  # of one pass of shading: about two gigabytes for a moment


@dataclass(frozen=True)
class Looks:
    """Looks of drawn objects: GROUPS rows for each look, of which a material takes one by its number.

    Attributes:
        first: int64 [K], first row of each draw's look.
        own: [Q,8], in the order of OWN.
        patterns: [Q,26], in the order of procedural_plan.LOOK.
        skins: [Q,12], in the order of textures.SKIN.
        photographs: For the skins; None: there are no skins.
    """

    first: Tensor
    own: Tensor
    patterns: Tensor
    skins: Tensor
    photographs: Photographs | None = None


@dataclass(frozen=True)
class Scene:
    """N views of K draws.

    Attributes:
        draws: What is drawn.
        to_camera: [K,3,4], an object's axes to those of its view's camera; a rotation times a scale, or its mirror
            image.
        intrinsics: [N,4], (fx, fy, cx, cy) in pixels.
        lights: [N,19], in the order of LIGHT.
        size_px: Side of the pictures.
        looks: Other colours than the objects' own; None: their own, without gloss.
    """

    draws: DrawList
    to_camera: Tensor
    intrinsics: Tensor
    lights: Tensor
    size_px: int
    looks: Looks | None = None


@dataclass(frozen=True)
class Pictures:
    """Pictures of N views.

    Attributes:
        images: [N,4,S,S], premultiplied RGBA, 0..1.
        depth: [N,S,S], z of the nearest surface in the pixel, scene units; 0 where there is none.
        normals: [N,3,S,S], unit, in the camera's axes, turned to the camera; 0 where there is no surface.
        draws: int64 [N,S,S], the draw of the nearest surface; -1 where there is none.
    """

    images: Tensor
    depth: Tensor
    normals: Tensor
    draws: Tensor


@torch.no_grad()
def render_images(meshes: ResidentMeshes, scene: Scene) -> Tensor:
    """Return premultiplied RGBA [N,4,S,S], 0..1."""
    return _reduced(_Shading(meshes, scene).images())


@torch.no_grad()
def render_pictures(meshes: ResidentMeshes, scene: Scene) -> Pictures:
    """Return colours and geometry of all views."""
    shading = _Shading(meshes, scene)
    count, size = scene.draws.views, scene.size_px
    depth, normals = shading.geometry()
    draws = torch.where(shading.winner < 0, -1, shading.projected.draw[shading.winner])
    behind = torch.where(depth > 0, depth, torch.inf).view(count, size, SAMPLES, size, SAMPLES)
    behind = behind.transpose(2, 3).flatten(3)
    nearest, place = behind.min(-1)
    draws = draws.view(count, size, SAMPLES, size, SAMPLES).transpose(2, 3).flatten(3)
    return Pictures(
        _reduced(shading.images()),
        torch.where(nearest < torch.inf, nearest, 0),
        F.normalize(_reduced(normals), dim=1),
        draws.gather(-1, place[..., None])[..., 0],
    )


def _reduced(samples: Tensor) -> Tensor:
    """Return the means [N,C,S,S] of the samples [N,S,SAMPLES,S,SAMPLES,C] of each pixel."""
    return samples.mean((2, 4)).permute(0, 3, 1, 2).contiguous()


class _Shading:
    """The surface that each sample of a scene sees, and its colour.

    Attributes:
        projected: The triangles.
        winner: int64 [N*H*W], row of projected; -1: none.
    """

    def __init__(self, meshes: ResidentMeshes, scene: Scene) -> None:
        self._meshes, self._scene, self._side = meshes, scene, SAMPLES * scene.size_px
        draws, side = scene.draws, self._side
        self.projected: Projected = project(meshes, draws, scene.to_camera, SAMPLES * scene.intrinsics)
        view = draws.view[self.projected.draw]
        holes = self._holes if draws.has_holes else None
        self.winner = rasterize(self.projected, view, draws.views, (side, side), holes)
        self._covered = (self.winner >= 0).nonzero()[:, 0]

    def images(self) -> Tensor:
        """Return premultiplied RGBA of all samples, [N,S,SAMPLES,S,SAMPLES,4]."""
        colours = self.winner.new_zeros((len(self.winner), 4), dtype=torch.float32)
        for sample in self._covered.split(_SAMPLES_AT_ONCE):
            colours[sample] = F.pad(self._colour(_Surface(self, sample)), (0, 1), value=1.0)
        return self._gridded(colours)

    def geometry(self) -> tuple[Tensor, Tensor]:
        """Return z [N*H*W] and normals [N,S,SAMPLES,S,SAMPLES,3] of all samples, 0 where there is no surface."""
        depth = self.winner.new_zeros(len(self.winner), dtype=torch.float32)
        normals = depth.new_zeros(len(depth), 3)
        for sample in self._covered.split(_SAMPLES_AT_ONCE):
            surface = _Surface(self, sample)
            depth[sample], normals[sample] = surface.position[:, 2], surface.normal
        return depth, self._gridded(normals)

    def _gridded(self, values: Tensor) -> Tensor:
        size = self._scene.size_px
        return values.view(self._scene.draws.views, size, SAMPLES, size, SAMPLES, -1)

    def _holes(self, triangle: Tensor, sample: Tensor) -> Tensor:
        """Return which fragments are holes of their material, bool [F]."""
        cut = self._meshes.cut[self.material(triangle)]
        chosen = cut.nonzero()[:, 0]
        triangle, sample = triangle[chosen], sample[chosen]
        weights, _ = self.weights(triangle, sample)
        uv = self.interpolated(triangle, weights, self._meshes.attributes[:, 3:5])
        cut[chosen] = _texture(self._meshes, self.material(triangle), uv)[:, 3] < 0.5
        return cut

    def material(self, triangle: Tensor) -> Tensor:
        """Return the materials of triangles, their numbers in the pack, int64 [F]."""
        first = self._scene.draws.first_material[self.projected.draw[triangle]]
        return first + self._meshes.material_of[self.projected.triangles[triangle]]

    def place(self, sample: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return view, x and y of the centres of samples."""
        row = sample.div(self._side, rounding_mode="floor")
        view = row.div(self._side, rounding_mode="floor")
        return view, sample - row * self._side + 0.5, row - view * self._side + 0.5

    def weights(self, triangle: Tensor, sample: Tensor) -> tuple[Tensor, Tensor]:
        """Return weights [F,3] of a triangle's corners at a sample, true to perspective, and z [F]."""
        _, x, y = self.place(sample)
        points = self.projected.points[self.projected.corners[triangle]]
        (x1, y1), (x2, y2) = ((points[:, corner, :2] - points[:, 0, :2]).unbind(1) for corner in (1, 2))
        x, y = x - points[:, 0, 0], y - points[:, 0, 1]
        area = x1 * y2 - x2 * y1
        second, third = (
            torch.where(area.abs() > 1e-9, value / area, 1 / 3).clamp(0, 1)
            for value in (x * y2 - y * x2, y * x1 - x * y1)
        )
        screen = torch.stack([(1 - second - third).clamp_min(0), second, third], 1) * points[..., 2]
        total = screen.sum(1)
        return screen / total[:, None], (1 / total)

    def interpolated(self, triangle: Tensor, weights: Tensor, values: Tensor) -> Tensor:
        """Return the values [F,C] of vertices [N,C] in the pack, at points of triangles."""
        draws, draw = self._scene.draws, self.projected.draw[triangle]
        shift = (draws.first_vertex - draws.list_vertex)[draw]
        return (values[self.projected.corners[triangle] + shift[:, None]] * weights[..., None]).sum(1)

    def _colour(self, surface: _Surface) -> Tensor:
        """Return the sRGB colours of surfaces under their light, [S,3]."""
        material = self.material(surface.triangle)
        texture = torch.where(
            self._meshes.rectangles[material, 4:5] > 0, _texture(self._meshes, material, surface.uv)[:, :3], 1
        )
        colour = self._meshes.base_colours[material] * surface.colour * texture
        gloss = None
        if self._scene.looks is not None:
            colour, gloss = self._dressed(surface, colour)
        return _lit(colour, gloss, surface.normal, named(self._scene.lights[surface.view], LIGHT))

    def _dressed(self, surface: _Surface, colour: Tensor) -> tuple[Tensor, Tensor]:
        """Return colours [S,3] as the looks change them, and gloss [S]."""
        looks = self._scene.looks
        local = self.interpolated(surface.triangle, surface.weights, self._meshes.positions)
        row = looks.first[surface.draw] + self._meshes.material_of[self.projected.triangles[surface.triangle]] % GROUPS
        own, pattern = named(looks.own[row], OWN), named(looks.patterns[row], LOOK)
        colour = own["gain"] * colour.gather(1, own["order"].long()).clamp_min(1e-6).pow(own["gamma"][:, None])
        other = pattern_colours(pattern, local, surface.own_normal)
        if looks.photographs is not None:
            skin = looks.skins[row]
            pieces = looks.photographs.on(local.device)
            skinned = worn(skin, pieces, local, surface.own_normal, pattern["base"], pattern["second"])
            other = torch.lerp(other, skinned, named(skin, SKIN)["share"][:, None])
        return torch.lerp(other, colour, own["weight"][:, None]).clamp(0, 1), pattern["gloss"]


class _Surface:
    """What samples [S] see: triangle, draw, view, corner weights, position [S,3] in the camera's axes, unit normals
    turned to the camera and in the object's axes, uv and colour of the vertices."""

    def __init__(self, shading: _Shading, sample: Tensor) -> None:
        scene = shading._scene
        self.triangle = shading.winner[sample]
        self.draw = shading.projected.draw[self.triangle]
        self.view, x, y = shading.place(sample)
        self.weights, z = shading.weights(self.triangle, sample)
        fx, fy, cx, cy = (SAMPLES * scene.intrinsics)[self.view].unbind(1)
        self.position = torch.stack([(x - cx) / fx * z, (y - cy) / fy * z, z], 1)
        attributes = shading.interpolated(self.triangle, self.weights, shading._meshes.attributes)
        self.own_normal, self.uv, self.colour = attributes[:, :3], attributes[:, 3:5], attributes[:, 5:]
        matrix = scene.to_camera[..., :3][self.draw]
        normal = F.normalize((matrix * self.own_normal[:, None]).sum(-1), dim=1)
        away = (normal * self.position).sum(1, keepdim=True) > 0
        self.normal = torch.where(away, -normal, normal)


def _texture(meshes: ResidentMeshes, material: Tensor, uv: Tensor) -> Tensor:
    """Return RGBA [S,4], 0..1, of places in the textures of materials: the bilinear mean of four texels.

    A texture repeats inside its material's rectangle, also for the texels beside a border.
    """
    offset, stride, left, top, width, height = meshes.rectangles[material].long().unbind(1)

    def neighbours(place: Tensor, side: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        side = side.clamp_min(1)
        texel = side * (place - place.floor()) - 0.5
        first = texel.floor()
        return first.long() % side, (first.long() + 1) % side, (texel - first)[:, None]

    x0, x1, x = neighbours(uv[:, 0], width)
    y0, y1, y = neighbours(uv[:, 1], height)
    upper, lower = (
        torch.lerp(*(meshes.texels[offset + (top + row) * stride + left + column].float() for column in (x0, x1)), x)
        for row in (y0, y1)
    )
    return torch.lerp(upper, lower, y) / 255


def _lit(colour: Tensor, gloss: Tensor | None, normal: Tensor, light: dict[str, Tensor]) -> Tensor:
    """Return sRGB colours [S,3] of sRGB colours [S,3] under the light."""
    strength = light["ambient"]
    for name in ("key", "fill"):
        strength = strength + (normal * light[name]).sum(1, keepdim=True).clamp_min(0) * light[f"{name}_colour"]
    colour = colour * strength
    if gloss is not None:
        facing = (normal * light["half"]).sum(1).clamp_min(1e-6)
        colour = colour + (gloss * facing.pow(light["exponent"]))[:, None] * light["key_colour"]
    return colour.clamp(0, 1)
