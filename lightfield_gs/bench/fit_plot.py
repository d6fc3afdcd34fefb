"""The rows of `bench fit` as a picture: PSNR against the seconds of the steps, a line for every arm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightfield_gs.bench.fit_report import summary
from lightfield_gs.bench.pareto_plot import new_figure
from lightfield_gs.io.atomic import atomic_path


def plot(rows: list[dict[str, Any]], protocol: dict[str, Any], path: Path) -> None:
    """Writes the picture: medians over the seeds, and bars as far as these spread. Raises InputError."""
    figure = new_figure(figsize=(6.4, 4.4), layout="constrained")
    axis = figure.subplots()
    found = summary(rows)
    for arm in dict.fromkeys(row["arm"] for row in found):
        some = [row for row in found if row["arm"] == arm]
        middle, low, high = (list(values) for values in zip(*(row["psnr_db"] for row in some)))
        spread = [[m - l for m, l in zip(middle, low)], [h - m for m, h in zip(middle, high)]]
        axis.errorbar(
            [row["seconds"][0] for row in some], middle, spread, marker="o", markersize=3, capsize=2, label=arm
        )
    axis.set_xscale("log")
    axis.set_xlabel("seconds of steps", fontsize=9)
    axis.set_ylabel("PSNR of held-out photographs, dB", fontsize=9)
    axis.set_title(f"{protocol['capture']}, {protocol['steps']} steps", fontsize=9)
    axis.grid(True, linewidth=0.3)
    axis.tick_params(labelsize=8)
    axis.legend(fontsize=8)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
