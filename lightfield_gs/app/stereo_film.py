"""The frames of a film of stereo pairs: one scale of depth for all of them, and parallaxes that do not flicker."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.app.photo_pair import guessed_pair, pair_depth, pair_of
from lightfield_gs.io.stereo_names import PairLayout

if TYPE_CHECKING:
    from lightfield_gs.app.photo import ReadPhoto
    from lightfield_gs.photo.steady_depth import PictureEstimate

SAMPLES = 9  # frames by which the parallax of a film is found
REACH = 3  # frames to either side that are averaged


def layout_of_film(path: Path, options: PhotoOptions) -> PairLayout | None:
    """Return the layout of a film by one of its frames; None where it is no film of pairs. Raises InputError."""
    from lightfield_gs.app.photo import quilt_in_name
    from lightfield_gs.io.images import read_picture

    if (stated := pair_of(path, options)) is not None or quilt_in_name(path):
        return stated
    return guessed_pair(options, read_picture(path))


def sample_numbers(count: int) -> list[int]:
    """Return the numbers of the frames of `count` by which the parallax of a film is found."""
    return sorted({round(index * (count - 1) / (SAMPLES - 1)) for index in range(SAMPLES)})


def film_parallax(samples: Iterable[ReadPhoto]) -> tuple[float, float] | None:
    """Return x_left - x_right of the farthest and the nearest things, by the width; None of no samples."""
    import torch

    from lightfield_gs.photo.joint_upsampling import percentiles

    ends = []
    for source in samples:
        assert source.matched is not None
        shifts = source.matched.found.shifts
        ends.append([end / shifts.shape[1] for end in percentiles(torch.from_numpy(shifts))])
    return (min(low for low, _ in ends), max(high for _, high in ends)) if ends else None


def steady_pairs(sources: Iterable[tuple[int, ReadPhoto]], ahead: int | None = None) -> Iterator[tuple[int, ReadPhoto]]:
    """Yield pairs in a row, each with parallaxes that are averaged with its neighbours' up to the next cut.

    Pairs that did not match stay as they are, and count for no other. ahead: see `steadied`.
    """
    from lightfield_gs.photo.steady_depth import steadied

    pending: dict[int, ReadPhoto] = {}

    def estimates() -> Iterator[tuple[int, PictureEstimate]]:
        for number, source in sources:
            pending[number] = source
            yield number, _estimate(source)

    for number, estimate in steadied(estimates(), False, REACH, True, ahead):
        source = pending.pop(number)
        matched = source.matched
        if matched is None or not matched.found.matched:
            yield number, source
            continue
        matched = matched._replace(found=replace(matched.found, shifts=estimate.disparities.numpy()))
        depth, second = pair_depth(source.options, source.photo, matched)
        yield number, replace(source, depth=depth, second=second, matched=matched)


def _estimate(source: ReadPhoto) -> PictureEstimate:
    """Return the parallaxes of a pair; of one that did not match an estimate of no size, which is left alone."""
    import torch

    from lightfield_gs.photo.steady_depth import PictureEstimate

    matched = source.matched
    if matched is None or not matched.found.matched:
        return PictureEstimate(torch.zeros(1, 1), torch.zeros(1, 1, 3))
    return PictureEstimate.of(torch.from_numpy(matched.found.shifts), source.photo.floats())
