"""Density control: where Gaussians are added, moved and removed, and their order in memory.

There are two strategies. `mcmc` (Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024) moves
dead Gaussians to live ones, and grows their number up to the budget. `adaptive` (Kerbl et al. 2023, section 5) clones
and splits Gaussians with large gradients, prunes faint and huge ones, and resets opacities.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.harmonics import rotations
from lightfield_gs.fitting.optimizer import MOST_LOGIT, GaussianState
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.random import Purpose, normals, uniforms
from lightfield_gs.fitting.settings import PRUNE_START_ITER, FitSettings

_MOST_COPIES = 51  # the largest ratio of compute_relocation, as in the paper's program
_WEIGHT_STEPS = 2**31  # weights become whole numbers, whose sums are the same in any order
_PARTS, _SHRINK = 2, 1.6  # a split Gaussian becomes two, with scales divided by this
_GROW_GRAD2D, _GROW_GRAD2D_ABS = 2e-4, 6e-4  # as in gsplat
_MORTON_BITS = 21  # an axis: three of them fill 63 bits
_MORTON_OUTSIDE = 0.005  # the fraction of Gaussians beyond the box on either side, or strays would make it too coarse.
# Shifts and masks that leave two free bits before each bit of a number
_MORTON_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


class DensityStatistics:
    """Sums over the steps since the density last changed, for N Gaussians, on their device.

    Attributes:
        seen: [N] uint8, 1 if a Gaussian was drawn since the round before the last. Regularisers skip the others: they
            would melt Gaussians that no photograph of some rounds shows.
        gradients: [N], for adaptive density. For each image the loss of this image has a gradient by the projected
            mean, in halves of the image; its norms are summed.
        drawn: [N], the number of these images.
    """

    def __init__(self, count: int, settings: FitSettings, device: torch.device | str):
        adaptive = settings.density == "adaptive"
        self.screen_numbers = (4 if settings.absgrad else 2) if adaptive else 0
        self._batch_size = settings.batch_size
        self.seen, self._seen_now = (torch.ones(count, dtype=torch.uint8, device=device) for _ in range(2))
        size = count if adaptive else 0
        self.gradients, self.drawn = (torch.zeros(size, device=device) for _ in range(2))

    def measure(self, splats: Tensor, screen: Tensor, images: PosedImages) -> Tensor:
        """Sum the statistics of one step over its images.

        Args:
            splats: [V,N,...], the projected Gaussians.
            screen: [V,N,2|4], gradients of the mean loss of all images of the step by the projected means.
            images: the photographs of the fit, for their size.

        Returns:
            [1,N] float32, the number of images in which a Gaussian is drawn; for adaptive density [2,N], also the sum
            of the norms. Sums of several processes add up.
        """
        drawn = splats[..., _core.SPLAT_REACH_INDEX] >= 0
        if not self.screen_numbers:
            return drawn.sum(0, dtype=torch.float32)[None]
        norms = torch.hypot(screen[..., -2] * (images.width_px / 2), screen[..., -1] * (images.height_px / 2)) * drawn
        return torch.stack([drawn.sum(0, dtype=torch.float32), norms.sum(0) * self._batch_size])

    def add(self, sums: Tensor, kept: Tensor) -> None:
        """Add the result of `measure`. kept [1]: 1, or 0 where the step is void."""
        sums = torch.where(kept > 0, sums, 0)
        self._seen_now |= sums[0] > 0
        self.seen |= self._seen_now
        if self.screen_numbers:
            self.drawn += sums[0]
            self.gradients += sums[1]

    def next_round(self) -> None:
        """Begin another round with as many Gaussians as before."""
        self.seen.copy_(self._seen_now)
        for sums in (self._seen_now, self.gradients, self.drawn):
            sums.zero_()

    def sort(self, order: Tensor) -> None:
        """Reorder the Gaussians: Gaussian order[i] moves to i."""
        for sums in self.tensors().values():
            if len(sums):
                sums.copy_(sums[order])

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by name, for a checkpoint, which also writes to them."""
        return {"seen": self.seen, "seen_now": self._seen_now, "gradients": self.gradients, "drawn": self.drawn}


# --- MCMC


def refine_mcmc(state: GaussianState, settings: FitSettings, step: int) -> GaussianState:
    """Move dead Gaussians to live ones, and add new ones.

    Args:
        state: the Gaussians; changed in place.
        settings: of the fit.
        step: number of steps done; with settings.seed it determines all random numbers.

    Returns:
        The same state, or a larger one where Gaussians were added.
    """
    dead = (state.opacities <= settings.min_opacity).nonzero()[:, 0]
    if 0 < len(dead) < state.count:
        weights = state.opacities.clone()
        weights[dead] = 0
        sources = sample_indices(weights, len(dead), settings.seed, 2 * step)
        _relocate(state, sources, settings.min_opacity)
        _copy(state, sources, dead)
    count = _target_count(state.count, settings, step)
    if count == state.count:
        return state
    sources = sample_indices(state.opacities, count - state.count, settings.seed, 2 * step + 1)
    _relocate(state, sources, settings.min_opacity)
    return state.append(sources)


def _target_count(count: int, settings: FitSettings, step: int) -> int:
    """Return the number of Gaussians after the round at `step`.

    It grows by settings.growth, or faster where too few rounds are left to reach settings.cap_max.
    """
    needed = count * (settings.cap_max / count) ** (1 / max(1, settings.rounds_from(step)))
    return max(count, min(settings.cap_max, max(int(count * settings.growth), math.ceil(needed))))


def sample_indices(weights: Tensor, count: int, seed: int, draw: int) -> Tensor:
    """Draw [count] indices with repetition, with probabilities in proportion to weights [N] in 0..1.

    The result is the same on any device: weights are rounded to whole numbers before they are summed.
    """
    ends = (weights.double() * _WEIGHT_STEPS).long().cumsum(0)
    places = (uniforms(seed, draw, Purpose.DENSITY, count, weights.device) * ends[-1]).long()
    # Rounding up could reach the end, which belongs to no index
    return torch.searchsorted(ends, torch.minimum(places, ends[-1] - 1), right=True)


def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scale of each of n Gaussians that together replace one (equation 9 of the paper).

        opacity_n = 1 - (1 - opacity)^(1/n)
        scale_n = scale opacity / D
        D = sum over i = 1..n and k = 0..i-1 of binomial(i-1, k) (-1)^k opacity_n^(k+1) / sqrt(k+1)

    Args:
        opacities: [P] float64.
        scales: [P,3] float64.
        ratios: [P], n of each; 51 at most counts.
    """
    n = ratios.clamp(1, _MOST_COPIES)
    opacity = -torch.expm1(torch.log1p(-opacities) / n)
    # The sum over i of binomial(i-1, k) for i = 1..n is binomial(n, k+1): one sum in place of two. Its terms alternate,
    # but opacity_n falls with n, so they stay small: the sum is good to 1e-11 up to the largest opacity.
    k = torch.arange(_MOST_COPIES, device=n.device, dtype=torch.float64)
    binomials = _binomials(n.device)[n]  # [P, k] of (n, k + 1)
    terms = binomials * (-1) ** k / torch.sqrt(k + 1) * opacity[:, None] ** (k + 1)
    return opacity, scales * (opacities / terms.sum(1))[:, None]


def _binomials(device: torch.device) -> Tensor:
    """Return [n, k] float64: binomial(n, k + 1), for n up to _MOST_COPIES and k below it."""
    rows = [[math.comb(n, k + 1) for k in range(_MOST_COPIES)] for n in range(_MOST_COPIES + 1)]
    return torch.tensor(rows, dtype=torch.float64, device=device)


def _relocate(state: GaussianState, sources: Tensor, min_opacity: float) -> None:
    """Set opacity and scale of each source for its number of copies."""
    ratios = torch.bincount(sources, minlength=state.count) + 1
    rows = (ratios > 1).nonzero()[:, 0]
    opacities, scales = compute_relocation(state.opacities[rows].double(), state.scales[rows].double(), ratios[rows])
    # Copies of a Gaussian with many copies must not die at once
    opacities = opacities.clamp(min_opacity, 1 - 1e-7)
    state.values.logits[rows] = torch.logit(opacities).clamp(-MOST_LOGIT, MOST_LOGIT).float()
    state.values.log_scales[rows] = scales.log().float()
    state.zero_moments(rows)
    state.refresh()


def _copy(state: GaussianState, sources: Tensor, targets: Tensor) -> None:
    """Copy each source to its target, with moments of zero."""
    for tensor in state.values:
        tensor[targets] = tensor[sources]
    state.zero_moments(targets)
    state.refresh()


# --- Adaptive density


def refine_adaptive(
    state: GaussianState, statistics: DensityStatistics, settings: FitSettings, step: int
) -> GaussianState:
    """Clone, split and prune Gaussians.

    The rest keeps its order. Clones stand behind it, then the first and the second parts of the split Gaussians, all
    with moments of zero. At settings.cap_max only the Gaussians with the largest gradients grow. If no Gaussian would
    be left, the scene stays as it is.

    Args:
        state: the Gaussians.
        statistics: their gradients.
        settings: of the fit.
        step: number of steps done; with settings.seed it determines all random numbers.

    Returns:
        A new state, or the same where nothing changes.
    """
    largest, gradients = state.scales.amax(1), statistics.gradients / statistics.drawn.clamp_min(1)
    small = largest <= settings.grow_scale3d
    early = step <= settings.scaled(PRUNE_START_ITER)
    most = math.inf if early or settings.prune_scale3d is None else settings.prune_scale3d
    alive = state.opacities >= settings.min_opacity
    fits_whole, fits_split = alive & (largest <= most), alive & ~small & (largest / _SHRINK <= most)
    wanting = (gradients >= _grow_threshold(settings)) & torch.where(small, fits_whole, fits_split)
    left = settings.cap_max - int((fits_whole | wanting).sum())
    grown = wanting & _largest(torch.where(wanting, gradients, -1), left)
    kept = fits_whole & ~(grown & ~small)
    clones, split = (grown & small).nonzero()[:, 0], (grown & ~small).nonzero()[:, 0]
    rows = torch.cat([kept.nonzero()[:, 0], clones, *[split] * _PARTS])
    if len(rows) == 0 or (len(rows) == state.count and bool(kept.all())):
        return state
    changed = state.select(rows)
    changed.zero_moments(torch.arange(int(kept.sum()), changed.count, device=rows.device))
    _split(changed, _PARTS * len(split), settings.seed, step)
    return changed


def reset_opacities(state: GaussianState, settings: FitSettings) -> None:
    """Lower every opacity to twice min_opacity in place, so that unneeded Gaussians die."""
    most = 2 * settings.min_opacity
    state.values.logits.clamp_(max=math.log(most / (1 - most)))
    state.first.logits.zero_()
    state.second.logits.zero_()
    state.refresh()


def _grow_threshold(settings: FitSettings) -> float:
    """Return the mean gradient from which on Gaussians grow, in halves of the image."""
    if settings.grow_grad2d is not None:
        return settings.grow_grad2d
    return _GROW_GRAD2D_ABS if settings.absgrad else _GROW_GRAD2D


def _largest(numbers: Tensor, count: int) -> Tensor:
    """Return [N] bool: the `count` largest of the numbers [N]; of equal ones the first."""
    found = torch.zeros_like(numbers, dtype=torch.bool)
    found[numbers.argsort(descending=True, stable=True)[: max(count, 0)]] = True
    return found


def _split(state: GaussianState, count: int, seed: int, step: int) -> None:
    """Move each of the last `count` Gaussians to a point drawn from its own distribution, and shrink it."""
    parts, values = slice(state.count - count, None), state.values
    z = normals(seed, step, Purpose.DENSITY, 3 * count, values.means.dtype, values.means.device).view(count, 3)
    along = state.scales[parts] * z
    values.means[parts] += (rotations(values.quaternions[parts]) @ along[:, :, None])[:, :, 0]
    values.log_scales[parts] -= math.log(_SHRINK)
    state.refresh()


# --- Order in memory


def morton_order(means: Tensor) -> Tensor:
    """Return [N] int64, the order of means [N,3] along a Morton curve; equal codes keep their order.

    Neighbours in space are then near each other in memory, so drawing and updating read less (Morton, "A computer
    oriented geodetic data base", 1966).
    """
    return morton_codes(means).argsort(stable=True)


def morton_codes(means: Tensor) -> Tensor:
    """Return [N] int64, the interleaved bits of x, y and z of means [N,3], z first.

    Each has 21 bits over the box of the middle 99 % along its axis, and is clamped beyond it.
    """
    ordered = means.double().sort(0).values
    outside = int(_MORTON_OUTSIDE * len(means))
    low, high = ordered[outside], ordered[len(means) - 1 - outside]
    fractions = (means.double() - low) / (high - low).clamp_min(1e-300)
    numbers = (fractions * 2**_MORTON_BITS).clamp(0, 2**_MORTON_BITS - 1).long()
    for shift, mask in _MORTON_SPREAD:
        numbers = (numbers | numbers << shift) & mask
    x, y, z = numbers.unbind(1)
    return x | y << 1 | z << 2
