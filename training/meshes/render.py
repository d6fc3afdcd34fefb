"""Pictures of textured meshes: colour, alpha, depth, normals and object numbers of many views at once.

Each pixel is the mean of 2x2 samples; alpha is the fraction of them that sees a surface. All work is torch operations
on the device of the meshes. The host waits for it three times: for the numbers of rows, fragments and covered samples.

Floor: a view of 128 px has on average 2,400 triangles, 13,000 rows, 49,000 fragments and 17,000 covered samples. The
operations move 2 MB for triangles, 8 for rows, 15 for fragments, 76 for shading and 6 for the grids. That is some 50 us
of an H100's memory, 20,000 views a second. Compiled, fragments and shading move 12 MB: 15 us, 60,000 views a second.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from training.data.fusing import fused
from training.data.textures import Photographs
from training.meshes.pack import ResidentMeshes
from training.meshes.rasterize import DrawList, project, rasterize
from training.meshes.shade import SHADOW_PX, Dressing, ShadowMaps, Surfaces, geometry, holes, shade

SAMPLES = 2  # of a pixel along each axis
_SAMPLES_AT_ONCE = 1 << 22  # of one pass of shading: about two gigabytes for a moment


@dataclass(frozen=True)
class Looks:
    """Looks of drawn objects: GROUPS rows for each look, of which a material takes one by its number.

    Attributes:
        first: int64 [K], first row of each draw's look.
        own: [Q,8], in the order of shade.OWN.
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
class Shadows:
    """The key light of Q scenes as an orthographic camera, its maps SHADOW_PX a side.

    Attributes:
        draws: What throws shadows, a view for each scene.
        to_light: [K,3,4], an object's axes to those of the camera; objects are within half a unit of (0, 0, -1).
    """

    draws: DrawList
    to_light: Tensor


@dataclass(frozen=True)
class Scene:
    """N views of K draws.

    Attributes:
        draws: What is drawn.
        to_camera: [K,3,4], an object's axes to those of its view's camera; a rotation times a scale, or its mirror
            image.
        intrinsics: [N,4], (fx, fy, cx, cy) in pixels.
        lights: [N,19], in the order of shade.LIGHT.
        size_px: Side of the pictures.
        looks: Other colours than the objects' own; None: their own, without gloss.
        to_light: [N,3,4], the axes of each view's camera to those of its light's camera; None: no shadows.
        shadow: int64 [N], number of each view's shadow map; -1: none.
    """

    draws: DrawList
    to_camera: Tensor
    intrinsics: Tensor
    lights: Tensor
    size_px: int
    looks: Looks | None = None
    to_light: Tensor | None = None
    shadow: Tensor | None = None


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
def render_shadow_maps(meshes: ResidentMeshes, shadows: Shadows, compiled: bool = False) -> Tensor:
    """Return shadow maps [Q,SHADOW_PX,SHADOW_PX], as ShadowMaps has them; compiled: see render_images.

    Texels of less than half opacity throw shadows too.
    """
    draws, middle = shadows.draws, SHADOW_PX / 2
    grid = shadows.to_light.new_tensor([SHADOW_PX, SHADOW_PX, middle, middle]).expand(draws.views, 4)
    projected = project(meshes, draws, shadows.to_light, grid, orthographic=True)
    points, view = projected.points[projected.corners], draws.view[projected.draw]
    _, near = rasterize(points, view, draws.views, (SHADOW_PX, SHADOW_PX), compiled=compiled)
    return near.view(-1, SHADOW_PX, SHADOW_PX)


@torch.no_grad()
def render_images(
    meshes: ResidentMeshes, scene: Scene, shadow_maps: Tensor | None = None, compiled: bool = False
) -> Tensor:
    """Return premultiplied RGBA [N,4,S,S], 0..1.

    Args:
        shadow_maps: Of render_shadow_maps; None: no shadows.
        compiled: Use a few kernels that torch.compile makes, in place of hundreds of operations.
    """
    return _means(_Samples(meshes, scene, shadow_maps, compiled).images())


@torch.no_grad()
def render_pictures(
    meshes: ResidentMeshes, scene: Scene, shadow_maps: Tensor | None = None, compiled: bool = False
) -> Pictures:
    """Return colours and geometry of all views; see render_images."""
    samples = _Samples(meshes, scene, shadow_maps, compiled)
    depth, normals = samples.geometry()
    nearest, first = _of_pixels(torch.where(depth > 0, depth, torch.inf)).min(-1)
    draws = F.pad(samples.surfaces.draw, (0, 1), value=-1)[samples.winner]  # the last one where there is no surface
    return Pictures(
        _means(samples.images()),
        torch.where(nearest < torch.inf, nearest, 0),
        F.normalize(_means(normals), dim=1),
        _of_pixels(samples.gridded(draws)).gather(-1, first[..., None])[..., 0],
    )


def _means(samples: Tensor) -> Tensor:
    """Return the means [N,C,S,S] of the samples [N,S,SAMPLES,S,SAMPLES,C] of each pixel."""
    return samples.mean((2, 4)).permute(0, 3, 1, 2).contiguous()


def _of_pixels(samples: Tensor) -> Tensor:
    """Return the samples [N,S,SAMPLES,S,SAMPLES,1] of each pixel side by side, [N,S,S,SAMPLES**2]."""
    return samples[..., 0].transpose(2, 3).flatten(3)


class _Samples:
    """What the samples of a scene see.

    Attributes:
        surfaces: The surfaces of the scene.
        winner: int64 [N*H*W], the triangle that a sample sees, -1 for none.
    """

    def __init__(self, meshes: ResidentMeshes, scene: Scene, shadow_maps: Tensor | None, compiled: bool) -> None:
        self._scene, self._side, self._compiled = scene, SAMPLES * scene.size_px, compiled
        self.surfaces = _surfaces(meshes, scene, shadow_maps)
        draws = scene.draws
        is_hole = partial(holes, self.surfaces, meshes.cut, self._side) if draws.has_holes else None
        view, size = draws.view[self.surfaces.draw], (self._side, self._side)
        points = self.surfaces.points[self.surfaces.corners]
        self.winner, _ = rasterize(points, view, draws.views, size, is_hole, compiled)
        self._covered = (self.winner >= 0).nonzero()[:, 0]

    def images(self) -> Tensor:
        """Return premultiplied RGBA of all samples, [N,S,SAMPLES,S,SAMPLES,4]."""
        colours = self.surfaces.points.new_zeros(len(self.winner), 4)
        for sample in self._covered.split(_SAMPLES_AT_ONCE):
            function = fused(shade, self._compiled, dynamic=True)
            seen = function(self.surfaces, self._side, self.winner[sample], sample)
            colours[sample] = F.pad(seen, (0, 1), value=1.0)
        return self.gridded(colours)

    def geometry(self) -> tuple[Tensor, Tensor]:
        """Return z and normals of all samples, [N,S,SAMPLES,S,SAMPLES,1 and 3], 0 where there is no surface."""
        depth, normals = (self.surfaces.points.new_zeros(len(self.winner), channels) for channels in (1, 3))
        for sample in self._covered.split(_SAMPLES_AT_ONCE):
            z, normals[sample] = geometry(self.surfaces, self._side, self.winner[sample], sample)
            depth[sample] = z[:, None]
        return self.gridded(depth), self.gridded(normals)

    def gridded(self, values: Tensor) -> Tensor:
        """Return values [N*H*W,...] of samples as [N,S,SAMPLES,S,SAMPLES,C]."""
        size = self._scene.size_px
        return values.view(self._scene.draws.views, size, SAMPLES, size, SAMPLES, -1)


def _surfaces(meshes: ResidentMeshes, scene: Scene, shadow_maps: Tensor | None) -> Surfaces:
    """Project the triangles of a scene, and gather what their look depends on."""
    draws, looks, intrinsics = scene.draws, scene.looks, SAMPLES * scene.intrinsics
    projected = project(meshes, draws, scene.to_camera, intrinsics)
    dressing = shadows = None
    if looks is not None:
        pieces = None if looks.photographs is None else looks.photographs.on(meshes.device)
        dressing = Dressing(looks.first, looks.own, looks.patterns, looks.skins, pieces)
    if shadow_maps is not None and scene.to_light is not None and scene.shadow is not None:
        shadows = ShadowMaps(shadow_maps, scene.to_light, scene.shadow)
    return Surfaces(
        projected.points,
        projected.corners,
        projected.draw,
        projected.triangles,
        draws.view,
        draws.first_vertex,
        draws.list_vertex,
        draws.first_material,
        scene.to_camera,
        scene.lights,
        intrinsics,
        meshes.attributes,
        meshes.positions,
        meshes.material_of,
        meshes.rectangles,
        meshes.base_colours,
        meshes.texels,
        dressing,
        shadows,
    )
