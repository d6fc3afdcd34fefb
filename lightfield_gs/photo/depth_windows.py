"""Depths of a video by a network that sees many pictures at once: overlapping windows in one scale."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from lightfield_gs.photo.depth_models.model import Pixels, as_tensor
from lightfield_gs.photo.steady_depth import PictureEstimate, fit_scale, is_cut

_OVERLAP = 8  # pictures that a window shares with the one before


def in_windows(
    pictures: Iterable[tuple[int, Pixels]],
    disparities: Callable[[list[Pixels]], list[Tensor]],
    at_once: int,
    has_scale: bool,
) -> Iterator[tuple[int, PictureEstimate]]:
    """Yield the estimates of pictures in a row.

    Each window is fitted to the one before by scale and offset, and fades into it. No window reaches across a cut.

    Args:
        pictures: Numbers and pictures, uint8 [h, w, 3].
        disparities: Function from the pictures of a window to their maps [h, w].
        at_once: Pictures of a window, at most.
        has_scale: Whether the disparities are of distances: then they are fitted by their scale alone.
    """
    window: list[tuple[int, Pixels]] = []
    known: list[Tensor] = []  # disparities of the window's first pictures

    def estimates(count: int) -> Iterator[tuple[int, PictureEstimate]]:
        for (number, picture), values in zip(window[:count], known):
            yield number, PictureEstimate.of(values, picture)

    for number, picture in pictures:
        ends = bool(window) and bool(is_cut(*(as_tensor(part) / 255 for part in (window[-1][1], picture))))
        if ends or len(window) == at_once:
            known = _continued(known, disparities([part for _, part in window]), has_scale)
            done = len(window) if ends else len(window) - _OVERLAP
            yield from estimates(done)
            window, known = window[done:], known[done:]
        window.append((number, picture))
    if len(window) > len(known):
        known = _continued(known, disparities([part for _, part in window]), has_scale)
    yield from estimates(len(window))


def _continued(known: list[Tensor], values: list[Tensor], has_scale: bool) -> list[Tensor]:
    """Return the maps of a window in the scale of the known ones at its beginning, which fade into them."""
    if not known:
        return values
    before, after = (torch.stack(part).double().flatten() for part in (known, values[: len(known)]))
    scale, offset = fit_scale(after, before, torch.ones_like(after), has_scale)
    values = [scale * part + offset for part in values] if scale > 0 else values
    fading = [torch.lerp(old, new, (i + 1) / (len(known) + 1)) for i, (old, new) in enumerate(zip(known, values))]
    return fading + values[len(known) :]
