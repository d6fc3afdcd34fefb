"""Holes of a picture filled in: smoothly, by Poisson's equation, and with the picture's own texture, by patches.

The membrane solves Poisson's equation by conjugate gradients. Large holes start from the solution of the half-size
picture, so that few steps at full size suffice: cascadic multigrid (Bornemann and Deuflhard, "The cascadic multigrid
method for elliptic problems", 1996).
The texture is the completion of Wexler et al. ("Space-time completion of video", 2007), with matches found as in Barnes
et al. ("PatchMatch", 2009), for all places at once. Patches of a large hole are matched in a smaller picture; their
displacements are then applied at full size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs.photo.image_filters import halve, max_filter


@dataclass(frozen=True)
class InpaintingConstants:
    """Sizes and stopping criteria.

    All are chosen by hand and not tuned on a data set, unless a comment says otherwise.
    """

    # steps of the membrane after a coarser level, when the rest is local; doubled at each coarser level
    iterations: int = 8
    # steps at most: the first guess is close, and the inside of a hole is hardly ever visible
    most_iterations: int = 60
    few_pixels: int = 1 << 12  # pixels of a hole up to which there is no coarser level
    tolerance: float = 1e-4  # residual by the first one: a thousandth of a colour step is not visible
    part_values: int = 1 << 10  # values summed by one thread
    # weight of the first guess relative to a neighbour: it decides only where nothing else holds a hole
    anchor: float = 1e-5

    # The patches
    patch_radius: int = 3  # radius of a patch, pixels
    stride: int = 2  # distance of the positions that have patches
    coarsest_px: int = 40  # shorter side of the coarsest level, about
    # weight of a difference of log disparity by one of colour: a patch comes from its own surface
    depth_weight: float = 4.0
    depth_cost_limit: float = 2.0  # largest square of that weighted difference
    depth_cost_factor: float = 0.05  # factor of this square in the cost of a patch
    # rounds of matching and voting, from the finest level on; the last for all coarser ones
    rounds: tuple[int, int, int, int] = (2, 3, 4, 6)
    matched_pixels: int = 1 << 15  # pixels of the hole at which patches are matched, at most: more are copied
    propagated_levels: int = 2  # levels from the finest on that only propagate matches, without a random search


_C = InpaintingConstants()


def solve_membrane(
    values: Tensor,
    hole: Tensor,
    linked: Sequence[Tensor],
    slope: Sequence[Tensor] | None = None,
    anchor: float = _C.anchor,
    iterations: int = _C.iterations,
) -> Tensor:
    """Solve Poisson's equation on a hole: return the values [H, W, C] with new values in the hole.

    It minimises the sum of |v_q - v_p - g_pq|^2 over linked neighbours p, q, at least one of them in the hole (Perez et
    al., "Poisson image editing", 2003, equation 7).

    Args:
        values: [H, W, C]; in the hole the first guess, which stays where nothing holds it.
        hole: bool [H, W].
        linked: bool [H-1, W] and [H, W-1], whether a pixel and the next one along columns and rows are neighbours.
        slope: g along columns and rows, [H, W] each, the same for all channels; None: 0.
        anchor: Weight of the first guess relative to a neighbour. A large weight keeps values that are more than 1 /
            sqrt(anchor) pixels from all known pixels.
        iterations: Steps where a coarser level has been solved.
    """
    index = hole.flatten().nonzero()[:, 0]
    if len(index) == 0:
        return values
    first = values.reshape(-1, values.shape[2])[index]
    if len(index) > _C.few_pixels:
        values = values + _coarser_correction(values, hole, linked, slope, anchor, iterations)
    else:
        iterations = _C.most_iterations
    number = torch.full((hole.numel(),), -1, dtype=torch.int64, device=values.device)
    number[index] = torch.arange(len(index), device=values.device)
    neighbours, weights, guides = _graph(hole, index, linked, slope)
    flat = values.reshape(-1, values.shape[2])
    inside = number[neighbours]
    known = inside < 0
    # Values of neighbours outside the hole, and the guiding steps, go to the right side
    right = anchor * first
    for side in range(4):
        held = torch.where(known[side][:, None], flat[neighbours[side]], 0)
        right = right + weights[side][:, None] * (held - guides[side][:, None])
    # The sum over neighbours in the hole is one gather: a row of zeros stands for all other neighbours
    inside = torch.where(known | (weights == 0), len(index), inside).T.contiguous()
    diagonal = weights.sum(0)[:, None] + anchor

    def apply(x: Tensor) -> Tensor:
        return diagonal * x - functional.embedding_bag(inside, functional.pad(x, (0, 0, 0, 1)), mode="sum")

    result = flat.clone()
    result[index] = _conjugate_gradients(apply, right, flat[index], diagonal, min(iterations, _C.most_iterations))
    return result.reshape(values.shape)


def _coarser_correction(
    values: Tensor,
    hole: Tensor,
    linked: Sequence[Tensor],
    slope: Sequence[Tensor] | None,
    anchor: float,
    iterations: int,
) -> Tensor:
    """Return the change of the values [H, W, C] by the solution of the half-size picture, at full size."""
    height, width = hole.shape
    coarse = halve(values.movedim(2, 0))
    coarse_hole = halve(hole[None].float())[0] > 0
    rows, columns = coarse_hole.shape
    # A block of four is joined with the next one unless a cut goes through, in it or beside it
    inner = linked[0][None, : 2 * (rows - 1)], linked[1][None, :, : 2 * (columns - 1)]
    whole = [halve(part.float())[0] > 0.5 for part in inner]
    steps = None if slope is None else [2 * halve(part[None])[0] for part in slope]
    first = coarse.movedim(0, 2)
    change = (solve_membrane(first, coarse_hole, whole, steps, 4 * anchor, 2 * iterations) - first).movedim(2, 0)[None]
    change = functional.interpolate(change, scale_factor=2, mode="bilinear", align_corners=False)[0]
    return torch.where(hole[..., None], change[:, :height, :width].movedim(0, 2), 0)


def _graph(
    hole: Tensor, index: Tensor, linked: Sequence[Tensor], slope: Sequence[Tensor] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the neighbours of the hole's pixels, int64, the weights 0 or 1 of links, and the steps g: [4, M] each."""
    width = hole.shape[1]
    neighbours, weights, guides = [], [], []
    for dim, stride in ((0, width), (1, 1)):
        whole = torch.zeros(hole.shape, device=hole.device)
        whole.narrow(dim, 0, hole.shape[dim] - 1).copy_(linked[dim])
        step = torch.zeros_like(whole) if slope is None else slope[dim]
        next_step = step.clone()
        next_step.narrow(dim, 0, hole.shape[dim] - 1).add_(step.narrow(dim, 1, hole.shape[dim] - 1)).mul_(0.5)
        whole, next_step = whole.flatten(), next_step.flatten()
        back = (index - stride).clamp_min(0)
        neighbours += [(index + stride).clamp_max(hole.numel() - 1), back]
        weights += [whole[index], torch.where(index >= stride, whole[back], 0.0)]
        guides += [next_step[index], -next_step[back]]
    return torch.stack(neighbours), torch.stack(weights), torch.stack(guides)


def _conjugate_gradients(apply, right: Tensor, guess: Tensor, diagonal: Tensor, iterations: int) -> Tensor:
    """Return x [M, C] with apply(x) = right, apply symmetric and positive, with Jacobi's preconditioner."""
    x = guess.clone()
    residual = right - apply(x)
    z = residual / diagonal
    direction, product = z.clone(), _sums(residual * z)
    enough = _C.tolerance**2 * product.max().clamp_min(1e-30)
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
    """Return the sum of each channel of [M, C], in an order independent of the number of threads."""
    parts = functional.pad(values, (0, 0, 0, -len(values) % _C.part_values))
    return parts.view(-1, _C.part_values, values.shape[1]).sum(1).sum(0)


class _Level(NamedTuple):
    """A picture of the pyramid: image [3, H, W]; hole, source: bool [H, W]; guide: [H, W]."""

    image: Tensor
    hole: Tensor
    source: Tensor
    guide: Tensor

    def halve(self) -> _Level:
        """Return the level at half size; a hole where any of four pixels is one, a source where all four are."""

        hole, source = (halve(mask[None].float())[0] for mask in (self.hole, self.source))
        return _Level(halve(self.image), hole > 0, source == 1, halve(self.guide[None])[0])


def complete(image: Tensor, hole: Tensor, source: Tensor, guide: Tensor) -> Tensor:
    """Fill a hole with patches of the source: return the image [H, W, 3], new in and closely around the hole.

    The same input gives the same picture.

    Args:
        image: [H, W, 3]; the colours in the hole are a smooth first guess.
        hole: bool [H, W].
        source: bool [H, W].
        guide: [H, W], log disparity: patches of the same depth are preferred.
    """
    levels = [_Level(image.movedim(2, 0).contiguous(), hole, source & ~hole, guide)]
    while min(levels[-1].hole.shape) >= 2 * _C.coarsest_px:
        levels.append(levels[-1].halve())
    small = (number for number, level in enumerate(levels) if int(level.hole.sum()) <= _C.matched_pixels)
    finest = next(small, len(levels) - 1)
    random = torch.Generator().manual_seed(0)  # of the host, so that all devices try the same matches
    search: _Matches | None = None
    for number in reversed(range(len(levels))):
        if not bool(levels[number].hole.any()):
            continue
        coarser = search
        found = _Matches(levels[number], coarser, random)
        if len(found.positions) == 0:  # too small for a patch
            continue
        search, searches = found, number >= finest + _C.propagated_levels
        for turn in range(_C.rounds[min(max(number - finest, 0), len(_C.rounds) - 1)]):
            if turn or coarser is None or searches:
                search.improve(searches)
            search.vote()
        if number <= finest:
            break
    if search is None:
        return image
    return search.voted.movedim(0, 2) if number == 0 else _copy_matches(search, levels[0], 2**number)


def _copy_matches(search: _Matches, level: _Level, scale: int) -> Tensor:
    """Return the picture [H, W, 3] of this level, its hole copied by the matches of a level `scale` times smaller.

    Patches meet in seams half as wide as the distance of their positions.
    """
    goal = max_filter(level.hole, 1).nonzero()
    matches, is_set = search.grid()
    # The position of a pixel between four positions of the grid
    at = ((goal + 0.5) / scale - 0.5) / _C.stride
    low = at.floor()
    fraction = ((at - low) * 2 - 0.5).clamp(0, 1)
    image = level.image.movedim(0, 2)
    total, mixed = image.new_zeros(len(goal), 1), image.new_zeros(len(goal), 3)
    last = torch.tensor(level.hole.shape, device=goal.device) - 1
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        cell = low.long() + torch.tensor(corner, device=goal.device)
        row, column = (cell[:, dim].clamp(0, is_set.shape[dim] - 1) for dim in (0, 1))
        down, right = ((fraction if side else 1 - fraction)[:, dim] for dim, side in enumerate(corner))
        weight = (down * right + 1e-9) * is_set[row, column]
        moved = (matches[row, column] - _C.stride * torch.stack([row, column], 1)) * scale
        source = torch.minimum((goal + moved).clamp_min(0), last)
        mixed += weight[:, None] * image[source[:, 0], source[:, 1]]
        total += weight[:, None]
    votes = torch.where(total > 0, mixed / total.clamp_min(1e-30), image[goal[:, 0], goal[:, 1]])
    result = image.clone()
    result[goal[:, 0], goal[:, 1]] = votes
    return result


class _Matches:
    """The most similar source patch for each position near the hole."""

    def __init__(self, level: _Level, coarser: _Matches | None, random: torch.Generator) -> None:
        self.level, self.random, self.voted = level, random, level.image
        self.height, self.width = level.hole.shape
        device = level.hole.device
        self.last = torch.tensor([self.height - 1, self.width - 1], device=device)
        r = _C.patch_radius
        reach = torch.arange(-r, r + 1, device=device)
        self.offsets = torch.cartesian_prod(reach, reach)
        # Source patches lie wholly within the source
        whole = ~max_filter(~level.source, r)
        whole[:r], whole[self.height - r :], whole[:, :r], whole[:, self.width - r :] = False, False, False, False
        self.whole = whole
        self.positions = whole.nonzero()
        near = max_filter(level.hole, r)
        rows, columns = (torch.arange(0, size, _C.stride, device=device) for size in level.hole.shape)
        chosen = near[rows][:, columns]
        self.shape = chosen.shape
        self.number = torch.full(chosen.shape, -1, dtype=torch.int64, device=device)
        cells = chosen.nonzero()
        self.number[chosen] = torch.arange(len(cells), device=device)
        self.cells, self.centres = cells, cells * _C.stride
        if len(self.positions) == 0:
            return
        # The pixels of the patches of all positions, [M, 49], clamped to the picture
        inside = self._clamp(self.centres[:, None] + self.offsets)
        self.patch_pixels = inside[..., 0] * self.width + inside[..., 1]
        self.colours = level.image.movedim(0, 2).reshape(-1, 3).contiguous()
        self.patches = self.colours[self.patch_pixels]
        self.voted_pixels, self.votes = self._votes_of_pixels()
        self.match = self._first_matches(coarser)
        self.cost = self._cost(self.match, torch.arange(len(cells), device=device))

    def _votes_of_pixels(self) -> tuple[Tensor, Tensor]:
        """Return the pixels [P] of all patches, and the rows [P, 16] of their votes; a row past the end is none.

        A sum of gathered rows has the same bits on each run, which a sum of scattered rows has not on CUDA.
        """
        r, side = _C.patch_radius, 2 * _C.patch_radius + 1
        is_voted = torch.zeros(self.height * self.width, dtype=torch.bool, device=self.cells.device)
        is_voted[self.patch_pixels.flatten()] = True
        pixels = is_voted.nonzero()[:, 0]
        at = torch.stack([pixels // self.width, pixels % self.width], 1)
        first, rows = -((r - at) // _C.stride), []
        across = torch.arange(-(-side // _C.stride), device=pixels.device)
        for step in torch.cartesian_prod(across, across):
            cell = first + step
            offset = at - _C.stride * cell + r
            row, column = (cell[:, dim].clamp(0, self.shape[dim] - 1) for dim in (0, 1))
            number = self.number[row, column]
            is_vote = ((cell >= 0) & (cell < torch.tensor(self.shape, device=cell.device)) & (offset < side)).all(1)
            vote = number * side**2 + offset[:, 0] * side + offset[:, 1]
            rows.append(torch.where(is_vote & (offset >= 0).all(1) & (number >= 0), vote, len(self.cells) * side**2))
        return pixels, torch.stack(rows, 1)

    def _first_matches(self, coarser: _Matches | None) -> Tensor:
        drawn = torch.randint(len(self.positions), (len(self.centres),), generator=self.random)
        candidates = self.positions[drawn.to(self.positions.device)]
        if coarser is None:
            return candidates
        matches, is_set = coarser.grid()
        at = torch.minimum(self.cells // 2, torch.tensor(is_set.shape, device=self.cells.device) - 1)
        moved = matches[at[:, 0], at[:, 1]] * 2 + self.centres - at * 2 * _C.stride
        usable = is_set[at[:, 0], at[:, 1]] & self._is_usable(moved)
        return torch.where(usable[:, None], moved, candidates)

    def _is_usable(self, positions: Tensor) -> Tensor:
        clamped = self._clamp(positions)
        return (clamped == positions).all(1) & self.whole[clamped[:, 0], clamped[:, 1]]

    def _clamp(self, positions: Tensor) -> Tensor:
        return positions.clamp_min(0).minimum(self.last)

    def _flat(self, match: Tensor) -> Tensor:
        """Return the pixels of source patches, [M, 49]: they lie within the picture."""
        steps = self.offsets[:, 0] * self.width + self.offsets[:, 1]
        return (match[:, 0] * self.width + match[:, 1])[:, None] + steps

    def _cost(self, match: Tensor, which: Tensor) -> Tensor:
        """Return the mean squared difference of colours, and of depths, of patches."""
        guide, middle = self.level.guide.flatten(), self.offsets.shape[0] // 2
        there = self._flat(match)
        apart = self.patches[which] - self.colours[there.flatten()].view(len(which), len(self.offsets), 3)
        cost = apart.square_().sum((1, 2)) / len(self.offsets)
        apart = guide[self.patch_pixels[which, middle]] - guide[there[:, middle]]
        return cost + (_C.depth_weight * apart).square().clamp_max(_C.depth_cost_limit) * _C.depth_cost_factor

    def improve(self, searches: bool) -> None:
        """Try the neighbours' matches, and with `searches` random positions closer and closer to the match."""
        self.cost = self._cost(self.match, torch.arange(len(self.centres), device=self.centres.device))
        for way in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            step = torch.tensor(way, device=self.cells.device)
            beside = self.cells + step
            inside = (beside >= 0).all(1) & (beside[:, 0] < self.shape[0]) & (beside[:, 1] < self.shape[1])
            beside = beside.clamp_min(0)
            other = self.number[beside[:, 0].clamp_max(self.shape[0] - 1), beside[:, 1].clamp_max(self.shape[1] - 1)]
            candidate = self.match[other.clamp_min(0)] - step * _C.stride
            self._keep_better(candidate, inside & (other >= 0))
        radius = max(self.height, self.width) / 2
        while searches and radius >= 1:
            candidates = torch.rand(self.match.shape, generator=self.random).to(self.match.device) * 2 - 1
            self._keep_better(self.match + (candidates * radius).round().long(), None)
            radius /= 2

    def _keep_better(self, candidate: Tensor, allowed: Tensor | None) -> None:
        usable = self._is_usable(candidate) & (candidate != self.match).any(1)
        which = (usable if allowed is None else usable & allowed).nonzero()[:, 0]
        cost = self._cost(candidate[which], which)
        better = cost < self.cost[which]
        self.match[which[better]] = candidate[which[better]]
        self.cost[which[better]] = cost[better]

    def vote(self) -> None:
        """Set each pixel of the hole to the mean of the patches over it; the most similar count most."""
        scale = self.cost.quantile(0.5) if len(self.cost) < 1 << 20 else self.cost.median()
        weight = torch.exp(-self.cost / (2 * scale.clamp_min(1e-6)))[:, None]
        near = torch.exp(-(self.offsets**2).sum(1) / 4.0)  # a patch is most reliable in its middle
        goal = self.centres[:, None] + self.offsets
        weight = ((weight * near + 1e-9) * (self._clamp(goal) == goal).all(2)).view(-1, 1)
        votes = torch.cat([weight * self.colours[self._flat(self.match).flatten()], weight], 1)
        sums = functional.embedding_bag(self.votes, functional.pad(votes, (0, 0, 0, 1)), mode="sum")
        total, pixels, colours = sums[:, 3:], self.voted_pixels, self.colours
        mixed = torch.where(total > 0, sums[:, :3] / total.clamp_min(1e-30), colours[pixels])
        self.voted = colours.index_put((pixels,), mixed).T.view_as(self.level.image)
        hole = self.level.hole.flatten()[pixels, None]
        self.colours = colours.index_put((pixels,), torch.where(hole, mixed, colours[pixels]))
        self.patches = self.colours[self.patch_pixels]

    def grid(self) -> tuple[Tensor, Tensor]:
        """Return the matches of the grid of positions, [h, w, 2], and where there are any."""
        matches = torch.zeros((*self.shape, 2), dtype=torch.int64, device=self.match.device)
        matches[self.cells[:, 0], self.cells[:, 1]] = self.match
        return matches, self.number >= 0
