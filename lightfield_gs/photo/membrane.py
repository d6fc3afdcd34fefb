"""Poisson's equation on the holes of a picture, by conjugate gradients: what continues smoothly what lies beside."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

_ITERATIONS = 60  # the first guess is close, and what is far inside a hole is hardly ever seen
_TOLERANCE = 1e-4  # of the residual, of what it was at first: a thousandth of a colour step is not seen
_ANCHOR = 1e-5  # weight of the first guess beside that of a neighbour: decides only where nothing else holds a hole


def solve_membrane(
    values: Tensor, hole: Tensor, linked: Sequence[Tensor], slope: Sequence[Tensor] | None = None
) -> Tensor:
    """The values [H, W, C], those of the hole replaced: minimises the sum over linked neighbours p, q, one of them at
    least in the hole, of |v_q - v_p - g_pq|^2 (Perez et al., "Poisson image editing", 2003, equation 7).

    hole: bool [H, W]. linked: bool [H-1, W] and [H, W-1], whether a pixel and the next one along columns and rows are
    neighbours. slope: g along columns and rows, [H, W] each, the same for all channels; None: 0. The values in the hole
    are the first guess, which stays where nothing holds them.
    """
    index = hole.flatten().nonzero()[:, 0]
    if len(index) == 0:
        return values
    number = torch.full((hole.numel(),), -1, dtype=torch.int64, device=values.device)
    number[index] = torch.arange(len(index), device=values.device)
    neighbours, weights, guides = _graph(hole, index, linked, slope)
    flat = values.reshape(-1, values.shape[2])
    guess = flat[index]
    inside = number[neighbours]
    known = inside < 0
    # What neighbours outside the hole say, and the guiding steps, go to the right side
    right = _ANCHOR * guess
    for side in range(4):
        held = torch.where(known[side][:, None], flat[neighbours[side]], 0)
        right = right + weights[side][:, None] * (held - guides[side][:, None])
    free = torch.where(known, 0.0, weights)
    inside = inside.clamp_min(0)
    diagonal = weights.sum(0)[:, None] + _ANCHOR

    def apply(x: Tensor) -> Tensor:
        return diagonal * x - sum(free[side][:, None] * x[inside[side]] for side in range(4))

    solved = _conjugate_gradients(apply, right, guess, diagonal)
    result = flat.clone()
    result[index] = solved
    return result.reshape(values.shape)


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


def _conjugate_gradients(apply, right: Tensor, guess: Tensor, diagonal: Tensor) -> Tensor:
    """x [M, C] with apply(x) = right, apply being symmetric and positive, each channel by itself; Jacobi's
    preconditioner."""
    x = guess.clone()
    residual = right - apply(x)
    z = residual / diagonal
    direction, product = z.clone(), (residual * z).sum(0)
    enough = _TOLERANCE**2 * product.max().clamp_min(1e-30)
    for _ in range(_ITERATIONS):
        if bool((product <= enough).all()):
            break
        image = apply(direction)
        step = product / (direction * image).sum(0).clamp_min(1e-30)
        x += step * direction
        residual -= step * image
        z = residual / diagonal
        new = (residual * z).sum(0)
        direction = z + new / product.clamp_min(1e-30) * direction
        product = new
    return x
