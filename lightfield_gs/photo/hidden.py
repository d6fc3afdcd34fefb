"""What a photo with depths hides behind its edges: where that is, how deep it lies, and smooth first colours of it.

All maps are [H, W]; disparities are 1 / z in 1 / scene units, NaN where nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.photo.depth_edges import joined
from lightfield_gs.photo.image_filters import box_sum, max_filter
from lightfield_gs.photo.inpainting import complete, solve_membrane

FRINGE = 3  # pixels of the far side next to an edge that may have colours of the near one: they are made anew as well
_WIDEST_TAN = 0.58  # tan 30 degrees: half of the widest cone whose cameras look behind the edges without a hole
_REACH = 0.25  # the most that a surface goes on behind what stands before it, as a share of the image's width
_STAIRS = 6  # pixels within which several edges are one: the steps of a smoothed one
_BEHIND = 0.985  # disparity of what is hidden, at most, as a share of the disparity of what hides it
_SLOPE_WINDOW = 9  # pixels over which the slope of a surface is taken before it goes on behind another one
_SAME = 0.1  # relative difference of depths up to which a pixel close by is of the same surface
_TEXTURE = 0.02  # share of the width: what is smaller than some 6 times that is texture, what is larger the first guess
_BENT = 0.15  # by how much of its disparity a surface may become nearer or farther where it goes on


@dataclass(frozen=True)
class Hidden:
    """hole: bool [H, W], the pixels behind whose surface another one goes on, and the fringe of that one beside the
    edge. fringe: bool [H, W], those of hole that are seen. disparity: [H, W] of the far surface in hole; of the photo's
    elsewhere. image: [H, W, 3], first colours in hole. linked: bool [H-1, W] and [H, W-1], whether a pixel and the next
    one along columns and rows belong to one of the surfaces that disparity has."""

    hole: Tensor
    fringe: Tensor
    disparity: Tensor
    image: Tensor
    linked: list[Tensor]


@dataclass
class _Run:
    """What goes on behind each pixel from one side: column of the last pixel that is seen of it (-1: nothing), [H, W]
    int64, and the distance to it in pixels."""

    source: Tensor
    distance: Tensor


def find_hidden(image: Tensor, depth: Tensor, focal_px: tuple[float, float]) -> Hidden:
    """Where surfaces go on behind others, for cameras to the left and to the right of the photo's.

    image: [H, W, 3]. depth: [H, W], z, sharp at its edges, NaN where nothing was measured.
    A far surface goes on along the row behind a near one for as many pixels as a camera at the end of a cone of 60
    degrees looks behind the edge, a quarter of the width at most. There it has the slope that it had before the edge,
    and the colours of a membrane that is held where the surface is seen: solutions of Poisson's equation, so that
    planes go on as planes and linear gradients as themselves, where they are held from both sides.
    """
    # From the left and, mirrored, from the right
    both = _behind(torch.cat([depth, depth.flip(1)]), focal_px[0])
    (source, mirrored), (distance, other) = both.source.chunk(2), both.distance.chunk(2)
    mirrored = torch.where(mirrored >= 0, depth.shape[1] - 1 - mirrored, -1)
    runs = [_Run(source, distance), _Run(mirrored.flip(1), other.flip(1))]
    disparity = 1 / depth
    covered = (runs[0].source >= 0) | (runs[1].source >= 0)
    fringe = _beside(covered, depth) & ~covered
    hole = covered | fringe
    if not bool(hole.any()):
        return Hidden(hole, fringe, disparity, image, [])
    guess, slope = _continued(disparity, depth, focal_px, runs, covered)
    colours = _stripes(image, depth, runs, covered)
    # Held at what is seen of the far surfaces: everything that is not hole. Where the guess is torn, two surfaces meet.
    linked = [joined_with(1 / guess.clamp_min(1e-30), dim, focal_px[1 - dim]) for dim in (0, 1)]
    bent = solve_membrane(guess[..., None], hole, linked, slope)[..., 0]
    # In the fringe the depths may be mixed as the colours are: the farthest close by is that of the far surface
    far = torch.where(hole & ~fringe, bent, torch.where(disparity > 0, disparity, torch.inf))
    far = -max_filter(-far, FRINGE)
    nearest = torch.where(covered, _BEHIND * disparity, torch.where(fringe, far, torch.inf))
    bent = torch.minimum(bent.clamp(guess * (1 - _BENT), guess * (1 + _BENT)), nearest)
    known = disparity[disparity > 0]
    bent = bent.clamp(known.min(), known.max())
    return Hidden(hole, fringe, torch.where(hole, bent, disparity), colours, linked)


def fill_hidden(hidden: Hidden, depth: Tensor) -> Tensor:
    """The image [H, W, 3] with the texture of what is seen of the far surfaces in the hole; depth: [H, W], z."""
    if not bool(hidden.hole.any()):
        return hidden.image
    guide = hidden.disparity.nan_to_num(0).clamp_min(1e-12).log()
    said = complete(hidden.image, hidden.hole, torch.isfinite(depth), guide)
    # The texture is that of the patches, and what is larger than it the first colours', without a seam at the border
    off, length = hidden.image - said, _TEXTURE * depth.shape[1]
    return (said + solve_membrane(off, hidden.hole, hidden.linked, anchor=length**-2)).clamp(0, 1)


def joined_with(depth: Tensor, dim: int, focal_px: float) -> Tensor:
    """Whether each pixel and the next one along this dimension belong to one surface, bool, one shorter in it."""
    return joined(depth, focal_px) if dim == 1 else joined(depth.T, focal_px).T


def _behind(depth: Tensor, focal_px: float) -> _Run:
    """What goes on to the right behind each pixel, of the surfaces to its left."""
    height, width = depth.shape
    z = depth.T.contiguous()  # a column is a row: it is read again and again
    torn = ~joined(depth, focal_px).T
    nearer = z[1:] < z[:-1]
    far, reach = z.new_zeros(height), z.new_zeros(height)
    source = torch.full((width, height), -1, dtype=torch.int64, device=z.device)
    distance = torch.zeros((width, height), device=z.device)
    current, since = source[0].clone(), torch.zeros_like(far)
    most = _REACH * width
    for column in range(1, width):
        begins = torn[column - 1] & nearer[column - 1]
        # The second step of a smoothed edge begins no new surface: what goes on is the farther one
        begins &= (current < 0) | (since > _STAIRS)
        far = torch.where(begins, z[column - 1], far)
        current = torch.where(begins, column - 1, current)
        since = torch.where(begins, 1.0, since + 1)
        ratio = far / z[column] - 1
        reach = torch.where(begins, 0.0, reach)
        reach = torch.maximum(reach, (focal_px * _WIDEST_TAN * ratio).clamp(max=most))
        ends = (since > reach + FRINGE) | ~(z[column] < far)
        current = torch.where(ends, -1, current)
        source[column], distance[column] = current, since
    return _Run(source.T.contiguous(), distance.T.contiguous())


def _beside(covered: Tensor, depth: Tensor) -> Tensor:
    """The pixels that are FRINGE or fewer pixels off one that covers another, and farther than that one."""
    return 1 / depth < 0.97 * max_filter(torch.where(covered, 1 / depth, 0), FRINGE)


def _continued(
    disparity: Tensor, depth: Tensor, focal_px: tuple[float, float], runs: list[_Run], covered: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """The disparity of what goes on, [H, W], and its steps along columns and rows; of the photo's
    where nothing does."""
    steps = [_slope(disparity, depth, dim, focal_px[1 - dim]) for dim in (0, 1)]
    rows, columns = covered.nonzero().unbind(1)
    # Of the pixels that cover something: weight, weighted disparity, and weighted steps
    sums = depth.new_zeros(4, len(rows))
    for sign, run in zip((1, -1), runs):
        source, distance = run.source[rows, columns], run.distance[rows, columns]
        weight = torch.where(source >= 0, 1 / distance.clamp_min(1), 0)
        column, further = _clean_border(depth, rows, source, sign)
        value, *step = (values[rows, column] for values in (disparity, *steps))
        moved = value + sign * (distance + further) * step[1]
        moved = torch.minimum(torch.maximum(moved, value * (1 - _BENT)), value * (1 + _BENT))
        sums += weight * torch.stack([torch.ones_like(weight), moved.nan_to_num(0), *step])
    guess = disparity.nan_to_num(0)
    for values, said in zip((guess, *steps), sums[1:] / sums[0].clamp_min(1e-12)):
        values[rows, columns] = said
    return guess, steps


def _clean_border(depth: Tensor, rows: Tensor, source: Tensor, sign: int) -> tuple[Tensor, Tensor]:
    """The column of the pixel that is continued in each of these rows [M], beyond the mixed ones where those are of the
    same surface, and how many pixels it is from the last one, source [M]. sign: 1 where the surface goes on to the
    right, else -1."""
    border = source.clamp_min(0)
    further = (border - sign * FRINGE).clamp(0, depth.shape[1] - 1)
    same = (depth[rows, further] / depth[rows, border] - 1).abs() < _SAME
    column = torch.where(same, further, border)
    return column, (column - border).abs()


def _slope(disparity: Tensor, depth: Tensor, dim: int, focal_px: float) -> Tensor:
    """The step of disparity from pixel to pixel along a dimension, its mean over a window of the same surface."""
    whole = joined_with(depth, dim, focal_px)
    differences = torch.where(whole, disparity.diff(dim=dim), 0).nan_to_num(0)
    padding = (0, 0, 0, 1) if dim == 0 else (0, 1)
    radius = _SLOPE_WINDOW // 2
    steps, count = (
        box_sum(torch.nn.functional.pad(part, padding), radius) for part in (differences, whole.to(differences))
    )
    return steps / count.clamp_min(1)


def _stripes(image: Tensor, depth: Tensor, runs: list[_Run], covered: Tensor) -> Tensor:
    """The image with the colours of the far surfaces' borders where those go on, taken from beyond the mixed pixels."""
    rows, columns = covered.nonzero().unbind(1)
    weights, mixed = image.new_zeros(len(rows), 1), image.new_zeros(len(rows), 3)
    for sign, run in zip((1, -1), runs):
        source, distance = run.source[rows, columns], run.distance[rows, columns]
        # Hardly mixed: it is to be texture
        cube = distance.clamp_min(1) * distance.clamp_min(1) * distance.clamp_min(1)
        weight = torch.where(source >= 0, 1 / cube, 0)[:, None]
        mixed += weight * image[rows, _clean_border(depth, rows, source, sign)[0]]
        weights += weight
    result = image.clone()
    result[rows, columns] = mixed / weights.clamp_min(1e-20)
    return result
