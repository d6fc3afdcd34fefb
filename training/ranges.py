"""Ranges of numbers in configurations."""

from __future__ import annotations

from lightfield_gs.base.checks import real_number, whole_number

MOST = 10**9  # for counts that nothing else bounds


def check_ranges(config: object, where: str = "", **ranges: tuple[float, float]) -> None:
    """Raises InputError unless each of these fields, or every element of one, lies in its range, ends included.

    ranges: whole numbers are expected where the lower end is an int. where: goes before the field's name in messages.
    """
    for field, (low, high) in ranges.items():
        value = getattr(config, field)
        for number in value if isinstance(value, (tuple, list)) else (value,):
            (whole_number if isinstance(low, int) else real_number)(where + field, number, low, high)
