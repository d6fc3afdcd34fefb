"""Gaussians of a picture with depths in two layers of fixed size: picture after picture in the same time.

`from_depth` takes more care of one photo. Here all maps are dense, so that nothing on the way waits for the device or
depends on the picture: on CUDA it is one graph. There is a Gaussian for each pixel, for each 2 x 2 pixels of the
surfaces behind, and for each 4 x 4 of the margin. Those that show nothing are transparent.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from lightfield_gs.base.device import capture_graph
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.photo.background_memory import BackgroundMemory
from lightfield_gs.photo.depth import FARTHEST
from lightfield_gs.photo.depth_edges import edges, slopes, snap_mixed
from lightfield_gs.photo.image_filters import halve, max_filter
from lightfield_gs.photo.margin import extend_with_margin
from lightfield_gs.photo.rgbd import NEAREST, OPAQUE, STD_PX, STEEPEST_RIM, THICKNESS_PX, flat_gaussians
from lightfield_gs.scene.gaussians import Gaussians, from_tensors


@dataclass(frozen=True)
class QuickLayersConstants:
    """Extents and thresholds.

    All are chosen by hand and not tuned on a data set.
    """

    widest_tan: float = 0.58  # as of HiddenConstants
    reach: float = 0.25  # largest extent of a surface behind another, by the picture's width
    step: float = 0.97  # disparity by that of the surface before it, from which on down it is another surface
    behind: float = 0.985  # largest disparity of a hidden surface by that of its cover
    fringe: int = 2  # pixels of the far side beside a cover that may be mixed, at half the size
    margin_px: int = 4  # pixels of the picture to a side of a Gaussian of the margin
    margin_back: float = 1.002  # distance of the margin by the picture's, so that it is behind the picture's border


_C = QuickLayersConstants()


class QuickLayers:
    """Makes Gaussians of pictures of one size, of one camera.

    Args:
        size: Height and width of the pictures.
        focal_px: fx, fy, pixels.
        centre_px: cx, cy, pixels.
        margin_px: See from_depth.
        device: Where the work is done.
        memory: What the camera saw before behind what is in front now. None: nothing is remembered.
    """

    def __init__(
        self,
        size: tuple[int, int],
        focal_px: tuple[float, float],
        centre_px: tuple[float, float],
        margin_px: tuple[int, int, int, int],
        device: torch.device,
        memory: BackgroundMemory | None,
    ):
        self._size, self._focal, self._memory = size, focal_px, memory
        self._graph: torch.cuda.CUDAGraph | None = None
        self._rays = _rays(size, 1, focal_px, centre_px, (0, 0), device)
        half = -(-size[0] // 2), -(-size[1] // 2)
        self._half_rays = _rays(half, 2, focal_px, centre_px, (0, 0), device)
        step = _C.margin_px
        self._margin = tuple(-(-part // step) for part in margin_px)
        left, top, right, bottom = self._margin
        small = -(-size[0] // step), -(-size[1] // step)
        whole = small[0] + top + bottom, small[1] + left + right
        outside = torch.ones(whole, dtype=torch.bool, device=device)
        outside[top : top + small[0], left : left + small[1]] = False
        self._outside = outside.flatten().nonzero()[:, 0]
        self._margin_rays = _rays(whole, step, focal_px, centre_px, (left, top), device)[self._outside]

    @torch.no_grad()
    def __call__(self, image: Tensor, z: Tensor) -> Gaussians:
        """Return the Gaussians: of all pixels, row by row, of the surfaces behind, and of the margin.

        Args:
            image: [H, W, 3 or 4], floats in 0..1, straight alpha.
            z: [H, W], scene units; NaN where it is not known.
        """
        if not image.is_cuda:
            return from_tensors(self._made(image, z))
        if self._graph is None:
            self._taken = image.clone(), z.clone()
            self._graph, self._fields = capture_graph(lambda: self._made(*self._taken), warm_up=True)
        for own, given in zip(self._taken, (image, z)):
            own.copy_(given)
        self._graph.replay()
        return from_tensors(field.clone() for field in self._fields)

    def _made(self, image: Tensor, z: Tensor) -> list[Tensor]:
        known = (z >= NEAREST) & (z <= FARTHEST)
        farthest = torch.where(known, z, 0).amax().clamp(min=NEAREST)
        z = torch.where(known, z, farthest)  # transparent, and no edge to nothing
        depth = snap_mixed(z, self._focal)
        opacity = OPAQUE * known
        if image.shape[2] == 4:
            opacity = opacity * image[..., 3]
        colours = image[..., :3]
        hidden = find_behind(colours, 1 / depth, self._focal[0], self._memory)
        ring = max_filter(hidden.covered_full(self._size), 1) & edges(depth, self._focal)
        far_ring = ring & (1 / depth < _C.step * max_filter(1 / depth, 1))
        behind = _enlarged(hidden.colours, self._size).movedim(0, 2)
        colours = torch.where(far_ring[..., None], behind, colours)  # what is before it has stained it
        parts = [self._front(depth, opacity, colours)]
        flat = hidden.colours.movedim(0, 2).reshape(-1, 3)
        shown = OPAQUE * hidden.hole.flatten()
        parts.append(_discs(self._half_rays, 1 / hidden.disparity.flatten(), shown, flat, 2 / self._focal[0]))
        if len(self._outside):
            parts.append(self._around(hidden))
        return [torch.cat(fields) for fields in zip(*parts)]

    def _front(self, depth: Tensor, opacity: Tensor, colours: Tensor) -> tuple[Tensor, ...]:
        across, down = slopes(depth, self._focal[0]), slopes(depth.T, self._focal[1]).T
        rim = max_filter(edges(depth, self._focal), 1)
        limit = torch.where(rim, STEEPEST_RIM, torch.inf)
        across, down = (torch.minimum(torch.maximum(part, -limit), limit).reshape(-1, 1) for part in (across, down))
        x, y = torch.eye(3, device=depth.device)[:2]
        tangents = x + across * self._rays, self._focal[0] / self._focal[1] * (y + down * self._rays)
        z = depth.reshape(-1)
        return flat_gaussians(
            self._rays * z[:, None], tangents, z / self._focal[0], opacity.reshape(-1), colours.reshape(-1, 3)
        )

    def _around(self, hidden: Behind) -> tuple[Tensor, ...]:
        steps = _C.margin_px // 2
        colours = avg_pool2d(hidden.colours[None], steps, steps, ceil_mode=True, count_include_pad=False)[0]
        disparity = avg_pool2d(hidden.disparity[None], steps, steps, ceil_mode=True, count_include_pad=False)[0]
        left, top, right, bottom = self._margin
        wide, depth, _ = extend_with_margin(colours.movedim(0, 2), 1 / disparity, (left, top, right, bottom), "blur")
        z = _C.margin_back * depth.flatten()[self._outside]
        opacity = torch.full_like(z, OPAQUE)
        return _discs(self._margin_rays, z, opacity, wide.reshape(-1, 3)[self._outside], _C.margin_px / self._focal[0])


@dataclass(frozen=True)
class Behind:
    """The surfaces behind others, at half the size [h, w].

    Attributes:
        hole: bool [h, w], where they are.
        covered: bool [h, w], the part of it that cannot be seen.
        disparity: [h, w], in hole of the surface behind; elsewhere of the picture.
        colours: [3, h, w], likewise.
    """

    hole: Tensor
    covered: Tensor
    disparity: Tensor
    colours: Tensor

    def covered_full(self, size: tuple[int, int]) -> Tensor:
        """Return `covered` at the picture's size."""
        return _enlarged(self.covered[None].float(), size)[0] > 0


def find_behind(image: Tensor, disparity: Tensor, focal_px: float, memory: BackgroundMemory | None) -> Behind:
    """Find the surfaces behind others: as they were seen before, else as the surface beside the edge continues.

    A pixel covers another surface where that is seen beside it, within the shift between the two at the end of a cone
    of 60 degrees.

    Args:
        image: [H, W, 3].
        disparity: [H, W], > 0, sharp at its edges.
        focal_px: fx.
        memory: See QuickLayers.
    """
    near, far = (sign * _pooled(sign * disparity) for sign in (1, -1))
    colours = halve(image.movedim(2, 0))
    covered = _covered(near, far, focal_px / 2)
    beside = max_filter(torch.where(covered, near, 0), _C.fringe)
    fringe = ~covered & (far < _C.step * beside)
    hole = covered | fringe
    # Things in front go on beyond what they cover
    reach = max(1, round(_C.reach * near.shape[1]))
    least = -max_filter(-torch.where(covered, near, torch.inf), reach)
    is_source = ~hole & ~(far >= _C.behind * least)
    sources, disparities = colours, far
    if memory is not None:
        remembered = memory.update(colours, near, ~hole)
        seen = remembered.is_known & (remembered.disparity < _C.step * near)
        sources = torch.where(seen, remembered.colours, sources)
        disparities = torch.where(seen, remembered.disparity, disparities)
        is_source = is_source | seen
    filled = _push_pull(torch.cat([sources, disparities[None]]), is_source)
    most = torch.where(fringe, torch.inf, _C.behind * far)
    inside = torch.minimum(torch.where(is_source, disparities, filled[3]), most).clamp(min=far.amin())
    return Behind(
        hole,
        covered,
        torch.where(hole, inside, far),
        torch.where(hole, torch.where(is_source, sources, filled[:3]), colours),
    )


def _pooled(values: Tensor) -> Tensor:
    """Return the largest of each 2 x 2 pixels, [h, w]."""
    values = pad(values[None], (0, values.shape[1] % 2, 0, values.shape[0] % 2), mode="replicate")[0]
    return values.unfold(0, 2, 2).unfold(1, 2, 2).amax((2, 3))


def _covered(near: Tensor, far: Tensor, focal_px: float) -> Tensor:
    """Return the pixels before a surface that is seen to the left or to the right of them within its shift."""
    widest, most = _C.widest_tan * focal_px, max(1, round(_C.reach * near.shape[1]))
    covered, least, reached = torch.zeros_like(near, dtype=torch.bool), far, 0
    while reached < most:
        step = min(max(1, reached), most - reached)
        wide = pad(least[None], (step, step), mode="replicate")[0].unfold(1, 2 * step + 1, 1)
        least = torch.minimum(torch.minimum(wide[..., 0], wide[..., -1]), least)
        # What is new in the window is farther off than `reached`
        covered |= (widest * (near / least - 1) > reached) & (least < _C.step * near)
        reached += step
    return covered


def _push_pull(values: Tensor, known: Tensor) -> Tensor:
    """Return maps [C, h, w] whose unknown pixels are smooth continuations of the known ones around them."""
    weighted = torch.cat([torch.where(known, values, 0), known[None].to(values)])
    levels = [weighted]
    while min(levels[-1].shape[1:]) > 1:
        levels.append(avg_pool2d(levels[-1][None], 2, 2, ceil_mode=True, count_include_pad=False)[0])
    top = levels[-1]
    filled = top[:-1].sum((1, 2), keepdim=True) / top[-1].sum().clamp(min=1e-12)
    filled = filled.expand(-1, *top.shape[1:])
    for level in reversed(levels[:-1]):
        coarse = interpolate(filled[None], size=level.shape[1:], mode="bilinear", align_corners=False)[0]
        weight = level[-1]
        filled = torch.where(weight > 0, level[:-1] / weight.clamp(min=1e-12), coarse)
    return filled


def _enlarged(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Return maps [C, h, w] of 2 x 2 pixels at the picture's size."""
    return values.repeat_interleave(2, 1).repeat_interleave(2, 2)[:, : size[0], : size[1]]


def _rays(
    size: tuple[int, int],
    step: int,
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    before: tuple[int, int],
    device: torch.device,
) -> Tensor:
    """Return the rays [h * w, 3], up to z = 1, through the middles of blocks.

    Args:
        size: Number of blocks, down and across.
        step: Pixels to a side of a block.
        focal_px: fx, fy.
        centre_px: cx, cy.
        before: Blocks to the left of the picture and above it.
        device: Where they go.
    """
    x = ((torch.arange(size[1], device=device) - before[0] + 0.5) * step - centre_px[0]) / focal_px[0]
    y = ((torch.arange(size[0], device=device) - before[1] + 0.5) * step - centre_px[1]) / focal_px[1]
    down, across = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([across, down, torch.ones_like(down)], 2).reshape(-1, 3)


def _discs(rays: Tensor, z: Tensor, opacity: Tensor, colours: Tensor, width: float) -> tuple[Tensor, ...]:
    """Return Gaussians [M, ...] that face the camera; width: of a block at z = 1."""
    turns = torch.zeros((len(z), 4), device=z.device)
    turns[:, 0] = 1
    across = STD_PX * width * z
    scales = torch.stack([across, across, THICKNESS_PX * width * z], 1)
    return rays * z[:, None], turns, scales, opacity, ((colours - 0.5) / SH_CONSTANT)[:, None]
