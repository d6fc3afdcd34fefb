"""Poisson's equation on the holes of a picture, by conjugate gradients: what continues smoothly what lies beside.

Large holes begin with the solution of the half-size picture, and so on down: cascadic multigrid (Bornemann and
Deuflhard, "The cascadic multigrid method for elliptic problems", 1996), which takes few steps in the large ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs.photo.image_filters import halved

_ITERATIONS = 8  # where a coarser level has been solved: what is left is local. Twice as many there, and so on
_MOST_ITERATIONS = 60  # the first guess is close, and what is far inside a hole is hardly ever seen
_FEW = 1 << 12  # pixels of a hole up to which there is no coarser level
_TOLERANCE = 1e-4  # of the residual, of what it was at first: a thousandth of a colour step is not seen
_PART = 1 << 10  # values summed by one thread
_ANCHOR = 1e-5  # weight of the first guess beside that of a neighbour: decides only where nothing else holds a hole


def solve_membrane(
    values: Tensor,
    hole: Tensor,
    linked: Sequence[Tensor],
    slope: Sequence[Tensor] | None = None,
    anchor: float = _ANCHOR,
    iterations: int = _ITERATIONS,
) -> Tensor:
    """The values [H, W, C], those of the hole replaced: minimises the sum over linked neighbours p, q, one of them at
    least in the hole, of |v_q - v_p - g_pq|^2 (Perez et al., "Poisson image editing", 2003, equation 7).

    hole: bool [H, W]. linked: bool [H-1, W] and [H, W-1], whether a pixel and the next one along columns and rows are
    neighbours. slope: g along columns and rows, [H, W] each, the same for all channels; None: 0. The values in the hole
    are the first guess, which stays where nothing holds them. anchor: the weight at which it does so beside what
    neighbours say; a large one keeps what is farther than 1 / sqrt(anchor) pixels off everything known. iterations:
    where a coarser level has been solved.
    """
    index = hole.flatten().nonzero()[:, 0]
    if len(index) == 0:
        return values
    first = values.reshape(-1, values.shape[2])[index]
    if len(index) > _FEW:
        values = values + _coarser_correction(values, hole, linked, slope, anchor, iterations)
    else:
        iterations = _MOST_ITERATIONS
    number = torch.full((hole.numel(),), -1, dtype=torch.int64, device=values.device)
    number[index] = torch.arange(len(index), device=values.device)
    neighbours, weights, guides = _graph(hole, index, linked, slope)
    flat = values.reshape(-1, values.shape[2])
    guess = flat[index]
    inside = number[neighbours]
    known = inside < 0
    # What neighbours outside the hole say, and the guiding steps, go to the right side
    right = anchor * first
    for side in range(4):
        held = torch.where(known[side][:, None], flat[neighbours[side]], 0)
        right = right + weights[side][:, None] * (held - guides[side][:, None])
    # The sum over neighbours in the hole is one gather: a row of zeros stands for those that are not, or not linked
    inside = torch.where(known | (weights == 0), len(index), inside).T.contiguous()
    diagonal = weights.sum(0)[:, None] + anchor

    def apply(x: Tensor) -> Tensor:
        return diagonal * x - functional.embedding_bag(inside, functional.pad(x, (0, 0, 0, 1)), mode="sum")

    solved = _conjugate_gradients(apply, right, guess, diagonal, min(iterations, _MOST_ITERATIONS))
    result = flat.clone()
    result[index] = solved
    return result.reshape(values.shape)


def _coarser_correction(
    values: Tensor,
    hole: Tensor,
    linked: Sequence[Tensor],
    slope: Sequence[Tensor] | None,
    anchor: float,
    iterations: int,
) -> Tensor:
    """What the solution of the half-size picture changes in the values [H, W, C], made as large as they are."""
    height, width = hole.shape
    coarse = halved(values.movedim(2, 0))
    coarse_hole = halved(hole[None].float())[0] > 0
    rows, columns = coarse_hole.shape
    # A block of four is joined with the next one unless a cut goes through, in it or beside it
    whole = [
        halved(linked[0][None, : 2 * (rows - 1)].float())[0] > 0.5,
        halved(linked[1][None, :, : 2 * (columns - 1)].float())[0] > 0.5,
    ]
    steps = None if slope is None else [2 * halved(part[None])[0] for part in slope]
    first = coarse.movedim(0, 2)
    change = (solve_membrane(first, coarse_hole, whole, steps, 4 * anchor, 2 * iterations) - first).movedim(2, 0)[None]
    change = functional.interpolate(change, scale_factor=2, mode="bilinear", align_corners=False)[0]
    return torch.where(hole[..., None], change[:, :height, :width].movedim(0, 2), 0)


def _graph(
    hole: Tensor, index: Tensor, linked: Sequence[Tensor], slope: Sequence[Tensor] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels beside those of the hole, [4, M] int64, weights 0 or 1 of the links and steps g to them, [4, M]."""
    width = hole.shape[1]
    neighbours, weights, guides = [], [], []
    for dim, stride in ((0, width), (1, 1)):
        whole = torch.zeros(hole.shape, device=hole.device)
        whole.narrow(dim, 0, hole.shape[dim] - 1).copy_(linked[dim])
        step = torch.zeros_like(whole) if slope is None else slope[dim]
        next_step = step.clone()
        next_step.narrow(dim, 0, hole.shape[dim] - 1).add_(step.narrow(dim, 1, hole.shape[dim] - 1)).mul_(0.5)
        whole, next_step = whole.flatten(), next_step.flatten()
        ahead = (index + stride).clamp_max(hole.numel() - 1)
        back = (index - stride).clamp_min(0)
        neighbours += [ahead, back]
        behind = torch.where(index >= stride, whole[back], 0.0)
        weights += [whole[index], behind]
        guides += [next_step[index], -next_step[back]]
    return torch.stack(neighbours), torch.stack(weights), torch.stack(guides)


def _conjugate_gradients(apply, right: Tensor, guess: Tensor, diagonal: Tensor, iterations: int) -> Tensor:
    """x [M, C] with apply(x) = right, apply being symmetric and positive, each channel by itself; Jacobi's
    preconditioner."""
    x = guess.clone()
    residual = right - apply(x)
    z = residual / diagonal
    direction, product = z.clone(), _sums(residual * z)
    enough = _TOLERANCE**2 * product.max().clamp_min(1e-30)
    for _ in range(iterations):
        if bool((product <= enough).all()):
            break
        image = apply(direction)
        step = product / _sums(direction * image).clamp_min(1e-30)
        x += step * direction
        residual -= step * image
        z = residual / diagonal
        new = _sums(residual * z)
        direction = z + new / product.clamp_min(1e-30) * direction
        product = new
    return x


def _sums(values: Tensor) -> Tensor:
    """The sum of each channel of [M, C], in an order that does not depend on the number of threads."""
    parts = functional.pad(values, (0, 0, 0, -len(values) % _PART)).view(-1, _PART, values.shape[1])
    return parts.sum(1).sum(0)
