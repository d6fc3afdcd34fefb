"""Objects that are in two folders: sources from the one, targets from the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from training.data.cache import CachedSet


def _places(cached: CachedSet) -> list[Path]:
    """Where each object of a set is within its folder."""
    return [Path(views.name).relative_to(cached.root) for views in cached.objects]


def find_partners(sets: list[CachedSet], target_sets: list[CachedSet]) -> np.ndarray:
    """Return for each object of `sets` the number of the object with its targets, among sets + target_sets.

    Args:
        target_sets: a set for each set, with an object of the same path for each of its objects. Empty: every object
            has its own targets.

    Raises:
        InputError: a set or an object has no partner.
    """
    if not target_sets:
        return np.arange(sum(len(cached.objects) for cached in sets))
    if len(target_sets) != len(sets):
        raise InputError(f"target_data: expected a folder for each of the {len(sets)} of data, got {len(target_sets)}")
    first, found = sum(len(cached.objects) for cached in sets), []
    for cached, targets in zip(sets, target_sets):
        numbers = {place: first + number for number, place in enumerate(_places(targets))}
        missing = [str(place) for place in _places(cached) if place not in numbers]
        if missing:
            raise InputError(
                f"target_data: {targets.root}: expected every object of {cached.root}, {len(missing)} are "
                f"missing: {', '.join(missing[:3])}{' ...' if len(missing) > 3 else ''}"
            )
        found += [numbers[place] for place in _places(cached)]
        first += len(targets.objects)
    return np.array(found)
