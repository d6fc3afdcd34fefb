"""Surfaces hidden behind the edges of a photo with depths: where they are, their depths, and smooth first colours.

All maps are [H, W]; disparities are 1 / z in 1 / scene units, NaN where nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.photo.depth_edges import joined
from lightfield_gs.photo.image_filters import box_sum, max_filter
from lightfield_gs.photo.inpainting import complete, solve_membrane


@dataclass(frozen=True)
class HiddenConstants:
    """Extents and thresholds of the hidden layer.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    # pixels of the far side next to an edge that may have colours of the near one: they are made anew as well
    fringe_px: int = 3
    widest_tan: float = 0.58  # tan 30 degrees: half of the widest cone whose cameras see no hole behind the edges
    reach: float = 0.25  # largest extent of a surface behind another, by the image's width
    stairs_px: int = 6  # pixels within which several edges are one: the steps of a smoothed edge
    behind: float = 0.985  # largest disparity of a hidden surface by the disparity of its cover
    slope_window_px: int = 9  # pixels over which the slope of a surface is measured before it continues
    same_depth: float = 0.1  # relative difference of depths up to which a pixel close by is of the same surface
    texture: float = 0.02  # length by the width: up to some 6 times it is texture, beyond it the first guess decides
    bend: float = 0.15  # largest relative change of disparity of a surface where it continues
    # a far surface ends where the next one lies beyond this part of the way from the cover to it, in log z
    comes_back: float = 0.6
    steady_rows: int = 2  # rows above and below of whose first guesses a pixel takes the median
    fringe_disparity: float = 0.97  # largest disparity of the fringe by that of the surface in front


_C = HiddenConstants()


class Hidden(NamedTuple):
    """The hidden layer of a photo.

    Attributes:
        hole: bool [H, W], the pixels in front of a hidden surface, and the fringe of the hidden surface beside the
            edge.
        fringe: bool [H, W], the visible pixels of hole.
        disparity: [H, W], of the far surface in hole; of the photo elsewhere.
        image: [H, W, 3], first colours in hole.
        nearest: [H, W], largest disparity of the far surface: it lies behind what covers it.
        linked: bool [H-1, W] and [H, W-1], whether a pixel and the next one along columns and rows belong to one
            surface of `disparity`.
    """

    hole: Tensor
    fringe: Tensor
    disparity: Tensor
    image: Tensor
    nearest: Tensor
    linked: list[Tensor]


# The surface behind each pixel from one side. Column of its last visible pixel, int64 [H, W], -1 where there is none;
# and the pixels to it, [H, W]
_Run = tuple[Tensor, Tensor]


def find_hidden(image: Tensor, depth: Tensor, focal_px: tuple[float, float]) -> Hidden:
    """Find the surfaces behind others, for cameras to the left and to the right of the photo's.

    A far surface continues along the row behind a near one. It ends where a camera at the end of a cone of 60 degrees
    sees no more, at most after a quarter of the width. It keeps its slope from before the edge. Its colours are a
    membrane, held at the visible pixels: a solution of Poisson's equation. So planes and linear gradients continue
    unchanged between visible pixels on both sides.

    Args:
        image: [H, W, 3], 0..1.
        depth: [H, W], z, sharp at its edges, NaN where nothing was measured.
        focal_px: (fx, fy), pixels.
    """
    # From the left and, mirrored, from the right
    both = _find_runs(torch.cat([depth, depth.flip(1)]), focal_px[0])
    (source, mirrored), (distance, other) = (part.chunk(2) for part in both)
    mirrored = torch.where(mirrored >= 0, depth.shape[1] - 1 - mirrored, -1).flip(1)
    runs = [(source, distance), (mirrored, other.flip(1))]
    disparity = 1 / depth
    covered = (source >= 0) | (mirrored >= 0)
    # At most a fringe off a covering pixel, and farther than it
    fringe = disparity < _C.fringe_disparity * max_filter(torch.where(covered, disparity, 0), _C.fringe_px)
    fringe &= ~covered
    hole = covered | fringe
    if not bool(hole.any()):
        return Hidden(hole, fringe, disparity, image, torch.full_like(disparity, torch.inf), [])
    guess, slope = _continue_disparity(disparity, depth, focal_px, runs, covered)
    colours = _continue_colours(image, depth, runs, covered)
    guess, colours, *slope = _steady_rows([guess, colours, *slope], covered)
    # Held at the visible far surfaces: everything but the hole. Where the guess is torn, two surfaces meet.
    linked = [_linked(guess, hole, dim, focal_px[1 - dim]) for dim in (0, 1)]
    bent = solve_membrane(guess[..., None], hole, linked, slope)[..., 0]
    # In the fringe the depths may be mixed like the colours: the farthest one close by is of the far surface
    far = torch.where(hole & ~fringe, bent, torch.where(disparity > 0, disparity, torch.inf))
    far = -max_filter(-far, _C.fringe_px)
    nearest = torch.where(covered, _C.behind * disparity, torch.where(fringe, far, torch.inf))
    bent = torch.minimum(bent.clamp(guess * (1 - _C.bend), guess * (1 + _C.bend)), nearest)
    known = disparity[disparity > 0]
    nearest, bent = nearest.clamp_max(known.max()), bent.clamp(known.min(), known.max())
    return Hidden(hole, fringe, torch.where(hole, bent, disparity), colours, nearest, linked)


def fill_hidden(hidden: Hidden, depth: Tensor) -> Tensor:
    """Return the image [H, W, 3] with the texture of the visible far surfaces in the hole; depth: [H, W], z."""
    if not bool(hidden.hole.any()):
        return hidden.image
    guide = hidden.disparity.nan_to_num(0).clamp_min(1e-12).log()
    filled_in = complete(hidden.image, hidden.hole, torch.isfinite(depth), guide)
    # The texture comes from the patches, larger structure from the first colours, without a seam at the border
    off, length = hidden.image - filled_in, _C.texture * depth.shape[1]
    return (filled_in + solve_membrane(off, hidden.hole, hidden.linked, anchor=length**-2)).clamp(0, 1)


def joined_with(depth: Tensor, dim: int, focal_px: float) -> Tensor:
    """Return whether each pixel and the next along this dimension belong to one surface, bool, one shorter in it."""
    return joined(depth, focal_px) if dim == 1 else joined(depth.T, focal_px).T


def _steady_rows(maps: list[Tensor], covered: Tensor) -> list[Tensor]:
    """Return first guesses [H, W, ...] whose covered pixels take those of one of five rows: of the median disparity.

    A row that continues a mixed pixel of the edge, or a wrong slope, differs from those above and below it.

    Args:
        maps: Disparity, and what goes with it.
        covered: bool [H, W].
    """
    rows, columns = covered.nonzero().unbind(1)
    steps = torch.arange(-_C.steady_rows, _C.steady_rows + 1, device=rows.device)
    beside = (rows + steps[:, None]).clamp(0, covered.shape[0] - 1)
    sources = torch.where(covered[beside, columns], beside, rows)
    chosen = maps[0][sources, columns].median(0, keepdim=True).indices
    source = sources.gather(0, chosen)[0]
    return [part.index_put((rows, columns), part[source, columns]) for part in maps]


def _linked(disparity: Tensor, hole: Tensor, dim: int, focal_px: float) -> Tensor:
    """Return whether each pixel and the next are of one surface; first guesses in the hole differ from row to row."""
    ratio = disparity.narrow(dim, 1, disparity.shape[dim] - 1) / disparity.narrow(dim, 0, disparity.shape[dim] - 1)
    inside = hole.narrow(dim, 1, hole.shape[dim] - 1) & hole.narrow(dim, 0, hole.shape[dim] - 1)
    similar = inside & ((ratio - 1).abs() < _C.same_depth)
    return joined_with(1 / disparity.clamp_min(1e-30), dim, focal_px) | similar


def _find_runs(depth: Tensor, focal_px: float) -> _Run:
    """Return the surfaces to the left of each pixel that continue to the right behind it.

    Each column depends on the one before: numpy takes them one by one in a fraction of the time of a GPU.
    """
    z = np.ascontiguousarray(depth.T.cpu().numpy())  # a column is a row: it is read again and again
    torn = ~joined(depth, focal_px).T.cpu().numpy()
    nearer = z[1:] < z[:-1]
    opens, closes = np.logical_and(torn, nearer), np.logical_and(torn, ~nearer)
    far, reach, cover, since = np.zeros((4, z.shape[1]), z.dtype)
    current = np.full(z.shape[1], -1)
    source, distance = np.full(z.shape, -1), np.zeros_like(z)
    most, widest = z.dtype.type(_C.reach * len(z)), z.dtype.type(focal_px * _C.widest_tan)
    may_open, may_close = opens.any(1).tolist(), closes.any(1).tolist()
    with np.errstate(all="ignore"):
        for column in range(1, len(z)):
            here = z[column]
            since += 1
            np.minimum(cover, here, out=cover)
            if may_open[column - 1]:
                # The second step of a smoothed edge begins no new surface: the farther one continues
                begins = opens[column - 1] & ((current < 0) | (since > _C.stairs_px + 1))
                for values, first in (
                    (far, z[column - 1]),
                    (current, column - 1),
                    (since, 1),
                    (cover, here),
                    (reach, 0),
                ):
                    np.copyto(values, first, where=begins)
            np.maximum(reach, np.minimum(widest * (far / here - 1), most), out=reach)
            ends = (since > reach + _C.fringe_px) | ~(here < far)
            if may_close[column - 1]:
                # A slanted surface comes into view again a little nearer than it went out of view
                ends |= closes[column - 1] & (here > far**_C.comes_back * cover ** (1 - _C.comes_back))
            current[ends] = -1
            source[column], distance[column] = current, since
    sideways = (torch.from_numpy(part.T.copy()).to(depth.device) for part in (source, distance))
    return next(sideways), next(sideways)


def _continue_disparity(
    disparity: Tensor, depth: Tensor, focal_px: tuple[float, float], runs: list[_Run], covered: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Return the hidden disparity [H, W] and its steps along columns and rows; the photo's elsewhere."""
    steps = [_slope(disparity, depth, dim, focal_px[1 - dim]) for dim in (0, 1)]
    rows, columns = covered.nonzero().unbind(1)
    # Sums over the covering pixels: weight, weighted disparity, and weighted steps
    sums = depth.new_zeros(4, len(rows))
    for sign, run in zip((1, -1), runs):
        source, distance = (part[rows, columns] for part in run)
        weight = torch.where(source >= 0, 1 / distance.clamp_min(1), 0)
        column, further = _clean_border(depth, rows, source, sign)
        value, *step = (values[rows, column] for values in (disparity, *steps))
        moved = value + sign * (distance + further) * step[1]
        moved = torch.minimum(torch.maximum(moved, value * (1 - _C.bend)), value * (1 + _C.bend))
        sums += weight * torch.stack([torch.ones_like(weight), moved.nan_to_num(0), *step])
    guess = disparity.nan_to_num(0)
    for values, filled_in in zip((guess, *steps), sums[1:] / sums[0].clamp_min(1e-12)):
        values[rows, columns] = filled_in
    return guess, steps


def _clean_border(depth: Tensor, rows: Tensor, source: Tensor, sign: int) -> tuple[Tensor, Tensor]:
    """Return the last clean pixel of a surface in each of these rows [M], beyond its mixed pixels.

    Args:
        depth: [H, W].
        rows: [M].
        source: [M], column of the last pixel of the surface.
        sign: 1 where the surface continues to the right, else -1.

    Returns:
        Its column [M], and its distance from the last pixel [M].
    """
    border = source.clamp_min(0)
    further = (border - sign * _C.fringe_px).clamp(0, depth.shape[1] - 1)
    same = (depth[rows, further] / depth[rows, border] - 1).abs() < _C.same_depth
    column = torch.where(same, further, border)
    return column, (column - border).abs()


def _slope(disparity: Tensor, depth: Tensor, dim: int, focal_px: float) -> Tensor:
    """Return the step of disparity from pixel to pixel along a dimension, its mean over a window of one surface."""
    whole = joined_with(depth, dim, focal_px)
    differences = torch.where(whole, disparity.diff(dim=dim), 0).nan_to_num(0)
    padding = (0, 0, 0, 1) if dim == 0 else (0, 1)
    radius = _C.slope_window_px // 2
    steps, count = (
        box_sum(torch.nn.functional.pad(part, padding), radius) for part in (differences, whole.to(differences))
    )
    return steps / count.clamp_min(1)


def _continue_colours(image: Tensor, depth: Tensor, runs: list[_Run], covered: Tensor) -> Tensor:
    """Return the image with the border colours of the far surfaces in the hole, from beyond mixed pixels."""
    rows, columns = covered.nonzero().unbind(1)
    weights, mixed = image.new_zeros(len(rows), 1), image.new_zeros(len(rows), 3)
    for sign, run in zip((1, -1), runs):
        source, distance = (part[rows, columns] for part in run)
        # Hardly mixed: it is to be texture
        cube = distance.clamp_min(1) * distance.clamp_min(1) * distance.clamp_min(1)
        weight = torch.where(source >= 0, 1 / cube, 0)[:, None]
        mixed += weight * image[rows, _clean_border(depth, rows, source, sign)[0]]
        weights += weight
    result = image.clone()
    result[rows, columns] = mixed / weights.clamp_min(1e-20)
    return result
