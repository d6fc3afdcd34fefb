"""The rows of `bench pareto` as a picture: run time against PSNR, an axis for every scene and cone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path, check_output_path

COLUMNS = 4
SUFFIXES = (".png", ".svg", ".pdf", ".webp")


def check_plot(path: Path) -> None:
    """Raises InputError where no plot can be drawn to this path."""
    check_output_path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"--plot: expected {', '.join(SUFFIXES)}, got {path.name}")
    new_figure()


def new_figure(**options: Any) -> Any:
    """matplotlib's Figure with these options. Raises InputError where there is no matplotlib."""
    try:
        from matplotlib.figure import Figure  # not pyplot, which looks for a display
    except ImportError:
        raise InputError("--plot needs matplotlib: pip install 'lightfield-gs[plot]', or leave --plot out") from None
    return Figure(**options)


def plot(found: list[dict[str, Any]], path: Path) -> None:
    """Writes the picture. Raises InputError."""
    cases: dict[tuple[str, float, str], list[dict[str, Any]]] = {}
    for row in found:
        cases.setdefault((row["scene"], row["cone_deg"], row["device"]), []).append(row)
    columns = min(COLUMNS, len(cases))
    down = math.ceil(len(cases) / columns)
    figure = new_figure(figsize=(3.4 * columns, 3 * down), layout="constrained")
    axes = list(figure.subplots(down, columns, squeeze=False).flat)
    for axis, ((scene, cone, device), rows) in zip(axes, cases.items()):
        _draw(axis, rows)
        axis.set_title(f"{scene}, {cone:.3g} degrees, {device}", fontsize=9)
    for axis in axes[len(cases) :]:
        axis.set_visible(False)
    figure.supxlabel("ms", fontsize=9)
    figure.supylabel("PSNR, dB", fontsize=9)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw(axis: Any, rows: list[dict[str, Any]]) -> None:
    """The settings as dots, the named ones by name, and the front as a line."""
    front = sorted((row for row in rows if row["front"]), key=lambda row: row["ms"])
    axis.step(
        [row["ms"] for row in front],
        [row["psnr_db"] for row in front],
        where="post",
        color="0.6",
        linewidth=1,
        zorder=1,
    )
    for named, colour in ((False, "tab:grey"), (True, "tab:red")):
        some = [row for row in rows if row["named"] == named]
        axis.scatter([row["ms"] for row in some], [row["psnr_db"] for row in some], s=12, color=colour, zorder=2)
        for row in some if named else ():
            axis.annotate(
                row["setting"], (row["ms"], row["psnr_db"]), xytext=(4, 3), textcoords="offset points", fontsize=8
            )
    axis.set_xlim(left=0)
    axis.margins(0.12)
    axis.grid(True, linewidth=0.3)
    axis.tick_params(labelsize=8)
