"""Large pictures a strip at a time, where all of one in floating point would take more memory than it is worth."""

from __future__ import annotations

from collections.abc import Iterator


def strips(height: int, width: int, pixels: int) -> Iterator[tuple[int, int]]:
    """Rows top .. bottom - 1 of about so many pixels, one after the other."""
    rows = max(1, pixels // width)
    return ((top, min(height, top + rows)) for top in range(0, height, rows))
