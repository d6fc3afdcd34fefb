"""Rows of benchmarks as text and as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import check_output_path

PLOT_SUFFIXES = (".png", ".svg", ".pdf", ".webp")


def aligned(lines: list[tuple[str, ...]]) -> list[str]:
    """Return lines of cells as text, the columns flush right."""
    widths = [max(map(len, column)) for column in zip(*lines)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in lines]


def in_ms(value: float) -> str:
    """Format a time in ms, with three digits or more."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2f}" if value >= 10 else f"{value:.3f}"


def or_dash(value: float | None, form: str) -> str:
    """Format a number, or return a dash for None."""
    return "-" if value is None else format(value, form)


def megabytes(value: int | None) -> str:
    """Format bytes in MB, or return a dash if they are not known."""
    return or_dash(None if value is None else value / 1e6, ".1f")


def check_plot(path: Path) -> None:
    """Raise InputError if no plot can be written to this path."""
    check_output_path(path)
    if path.suffix.lower() not in PLOT_SUFFIXES:
        raise InputError(f"plot=: expected {', '.join(PLOT_SUFFIXES)}, got {path.name}")
    new_figure()


def new_figure(**options: Any) -> Any:
    """Return a Figure of matplotlib with these options. Raises InputError without matplotlib."""
    try:
        from matplotlib.figure import Figure  # not pyplot, which looks for a display
    except ImportError:
        raise InputError("plot= needs matplotlib: pip install 'lightfield-gs[plot]', or leave plot= out") from None
    return Figure(**options)
