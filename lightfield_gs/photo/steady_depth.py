"""Depths of pictures in a row that do not flicker.

A network estimates each picture by itself: noise in the pictures moves its numbers, their scale and their range. Here
each map is averaged with those before and after it, up to the next cut. The numbers of the others are first fitted to
its own by a scale and an offset; parallaxes of two eyes are measured, and need no fit. A pixel counts less where its
colour changes, so that moving things do not smear.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lightfield_gs.photo.joint_upsampling import percentiles


@dataclass(frozen=True)
class SteadyConstants:
    """Reach of the average, and thresholds.

    All are chosen by hand and not tuned on a data set.
    """

    colour_std: float = 0.06  # standard deviation of the weights by change of colour, 0..1
    colour_radius_px: int = 2  # of the means of colour that are compared, so that noise is no change
    histogram_bins: int = 16  # of each channel
    cut_histogram: float = 0.3  # fraction of the pixels that change their bin from which on there may be a cut
    cut_difference: float = 0.08  # mean difference of the colours, 0..1, from which on there may be one
    sure_difference: float = 0.25  # from which on there is one, whatever the histograms
    least_weight: float = 1e-3  # of the pixels that a fit takes


_C = SteadyConstants()
REACH = 6  # pictures to either side that are averaged


@dataclass
class PictureEstimate:
    """The numbers of a network for a picture.

    Attributes:
        disparities: [h, w], float32.
        colours: The picture at that size [h, w, 3], floats in 0..1, on their device.
        limits: Low and high percentile of the disparities; None: their own.
    """

    disparities: Tensor
    colours: Tensor
    limits: tuple[float, float] | None = None

    @classmethod
    def of(cls, disparities: Tensor, photo: np.ndarray | Tensor) -> PictureEstimate:
        """Return the estimate of a photo [H, W, 3 or more], uint8 or floats in 0..1."""
        pixels = photo[..., :3] if isinstance(photo, Tensor) else torch.from_numpy(np.array(photo[..., :3]))
        picture = pixels.to(disparities.device).movedim(2, 0)[None]
        picture = picture / 255 if picture.dtype == torch.uint8 else picture
        if picture.shape[2:] != disparities.shape:
            picture = interpolate(picture, size=disparities.shape, mode="area")
        colours = picture[0].movedim(0, 2)
        return cls(disparities.float(), colours)

    @cached_property
    def smooth(self) -> Tensor:
        """The colours without noise [h, w, 3]; each picture is compared with many."""
        side = 2 * _C.colour_radius_px + 1
        channels = self.colours.movedim(2, 0)[None]
        blurred = torch.nn.functional.avg_pool2d(channels, side, 1, _C.colour_radius_px, count_include_pad=False)
        return blurred[0].movedim(0, 2)

    @cached_property
    def ends(self) -> tuple[float, float]:
        """The low and the high percentile of the disparities."""
        return percentiles(self.disparities)


def steadied(
    estimates: Iterable[tuple[int, PictureEstimate]],
    has_scale: bool,
    reach: int = REACH,
    is_measured: bool = False,
    ahead: int | None = None,
) -> Iterator[tuple[int, PictureEstimate]]:
    """Yield each estimate averaged with up to `reach` before and after it.

    Args:
        estimates: Numbers and estimates, in order. Estimates of one shape are averaged.
        has_scale: Whether the disparities are of distances: then they are fitted by their scale alone.
        reach: Pictures to either side.
        is_measured: Whether all disparities are in one unit already; then nothing is fitted.
        ahead: Pictures after it, up to `reach`. 0: no picture waits for the next. None: `reach`.
    """
    ahead = reach if ahead is None else ahead
    window: deque[tuple[int, PictureEstimate, bool]] = deque()  # and whether a shot begins with it
    at, incoming, last = 0, iter(estimates), None
    while True:
        while len(window) - at <= ahead and (entry := next(incoming, None)) is not None:
            number, estimate = entry
            window.append((number, estimate, last is None or bool(is_cut(last.colours, estimate.colours))))
            last = estimate
        if at >= len(window):
            return
        number, estimate, _ = window[at]
        yield number, _averaged([part[1] for part in _shot(list(window), at, reach)], estimate, has_scale, is_measured)
        at += 1
        if at > reach:
            window.popleft()
            at -= 1


def is_cut(before: Tensor, after: Tensor) -> Tensor:
    """Return whether a shot ends between two pictures [h, w, 3], floats in 0..1: a bool [], on their device.

    A pan changes the pixels but not the histogram; a change of the light does the reverse. A cut changes both, or all
    pixels.
    """
    if before.shape != after.shape:
        return torch.ones((), dtype=torch.bool, device=after.device)
    difference = (before - after).abs().mean()
    histograms = [
        torch.stack([torch.histc(part[..., channel], _C.histogram_bins, 0, 1) for channel in range(3)])
        for part in (before, after)
    ]
    moved = (histograms[0] - histograms[1]).abs().sum() / 2
    has_other_colours = moved >= _C.cut_histogram * 3 * before[..., 0].numel()
    return (difference >= _C.sure_difference) | ((difference >= _C.cut_difference) & has_other_colours)


def _shot(
    window: list[tuple[int, PictureEstimate, bool]], at: int, reach: int
) -> list[tuple[int, PictureEstimate, bool]]:
    """Return the part of a window that is in the same shot as its entry `at`."""
    first, last = at, at + 1
    while first > max(0, at - reach) and not window[first][2]:
        first -= 1
    while last < min(len(window), at + reach + 1) and not window[last][2]:
        last += 1
    return window[first:last]


def _averaged(shot: list[PictureEstimate], own: PictureEstimate, has_scale: bool, is_measured: bool) -> PictureEstimate:
    """Return one estimate of a shot, averaged with the others in its own scale and offset.

    All others are taken at once, and the host waits once for the device.
    """
    aim = own.disparities
    others = [other for other in shot if other is not own and other.disparities.shape == aim.shape]
    if not others:
        return PictureEstimate(aim, own.colours, own.ends)
    values, colours = (torch.stack(parts) for parts in zip(*((part.disparities, part.smooth) for part in others)))
    weight = torch.exp((colours - own.smooth).square().sum(3) / (-2 * _C.colour_std**2))
    scale = torch.ones(len(others), dtype=torch.float64, device=aim.device)
    offset = torch.zeros_like(scale)
    if not is_measured:
        scale, offset = fit_scale(values.flatten(1), aim.flatten(), weight.flatten(1), has_scale)
    is_like = (weight.mean((1, 2)) >= _C.least_weight) & (scale > 0)
    scale, offset = torch.where(is_like, scale, 1.0), torch.where(is_like, offset, 0.0)
    weight = torch.where(is_like[:, None, None], weight, 0)
    moved = scale.float()[:, None, None] * values + offset.float()[:, None, None]
    total, weights = aim + (weight * moved).sum(0), 1 + weight.sum(0)
    low, high = scale.new_tensor([other.ends for other in others]).T
    found = torch.stack([scale * low + offset, scale * high + offset, 1 / scale]) * is_like
    ends = (found.sum(1) + scale.new_tensor([*own.ends, 1.0])) / (1 + is_like.sum())
    first, last, common = ends.tolist()
    common = common if has_scale else 1.0
    return PictureEstimate(common * total / weights, own.colours, (common * first, common * last))


def fit_scale(values: Tensor, target: Tensor, weight: Tensor, has_scale: bool) -> tuple[Tensor, Tensor]:
    """Return scale and offset, double [...], by which values [..., M] come closest to a target, in weighted squares."""
    total = lambda parts: parts.sum(-1, dtype=torch.float64)
    if has_scale:
        scale = total(weight * values * target) / total(weight * values.square()).clamp(min=1e-30)
        return scale, torch.zeros_like(scale)
    whole = total(weight)
    mean, aim = total(weight * values) / whole, total(weight * target) / whole
    apart = values - mean.to(values)[..., None]
    spread = total(weight * apart.square())
    scale = torch.where(spread > 0, total(weight * apart * (target - aim.to(values)[..., None])) / spread, 1.0)
    return scale, aim - scale * mean
