"""Ranges of numbers in configurations."""

from __future__ import annotations

from lightfield_gs.base.checks import real_number, whole_number

MOST = 10**9  # for counts that nothing else bounds


def check_ranges(config: object, where: str = "", **ranges: tuple[float, float]) -> None:
    """Check that each of these fields, or every element of one, lies in its range, ends included.

    Args:
        where: Text before the field's name in messages.
        ranges: Ranges of the fields; a lower end of type int asks for whole numbers.

    Raises:
        InputError: a number is out of its range.
    """
    for field, (low, high) in ranges.items():
        value = getattr(config, field)
        for number in value if isinstance(value, (tuple, list)) else (value,):
            (whole_number if isinstance(low, int) else real_number)(where + field, number, low, high)
