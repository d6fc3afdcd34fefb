"""Photos in a row whose depths do not flicker: by a network, or by two eyes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.app.photo import ReadPhoto
from lightfield_gs.app.photo_depth import steady_estimates
from lightfield_gs.app.stereo_film import steady_pairs


def steady_photos(
    photos: Iterable[tuple[int, ReadPhoto]], options: PhotoOptions, device: str, ahead: int | None = None
) -> Iterator[tuple[int, ReadPhoto]]:
    """Yield photos in a row, each with depths that are averaged with its neighbours' up to the next cut.

    Args:
        photos: Their numbers, and they as they were read.
        options: Of all of them: estimated depths, or stereo pairs with the parallax of the film. Others stay.
        device: Where a network works.
        ahead: Photos that each waits for, see `steadied`.

    Raises:
        InputError: As `steady_estimates`.
    """
    if options.is_estimated:
        pending: dict[int, ReadPhoto] = {}

        def pictures():
            for number, source in photos:
                pending[number] = source
                yield number, source.photo

        for number, estimate in steady_estimates(pictures(), options, device, ahead):
            yield number, replace(pending.pop(number), estimate=estimate)
    elif options.film_parallax is not None:
        yield from steady_pairs(photos, ahead)
    else:
        yield from photos
