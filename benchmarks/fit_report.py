"""The rows of `bench fit` over their seeds: a table, and how ours compares."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from lightfield_gs.bench.report import aligned, in_ms, megabytes, new_figure
from lightfield_gs.io.atomic import atomic_path

OURS = "ours"
_NUMBERS = ("psnr_db", "psnr_db_by_ours", "ssim", "gaussians", "seconds", "ms_step", "ms_step_lately", "peak_bytes")


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each arm and step: of every number (median, least, most) over the seeds that have it."""
    groups: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["arm"], row["step"]), []).append(row)
    return [
        {"arm": arm, "step": step, "seeds": len(group), **{name: _spread(group, name) for name in _NUMBERS}}
        for (arm, step), group in sorted(groups.items(), key=lambda item: _first_seen(rows, item[0]))
    ]


def _first_seen(rows: list[dict[str, Any]], group: tuple[str, int]) -> tuple[int, int]:
    arm, step = group
    return [row["arm"] for row in rows].index(arm), step


def _spread(group: list[dict[str, Any]], name: str) -> list[float] | None:
    values = [row[name] for row in group if row[name] is not None]
    return [statistics.median(values), min(values), max(values)] if values else None


def line(row: dict[str, Any]) -> str:
    """A row as it is known, while others are awaited."""
    return (
        f"{row['arm']}, seed {row['seed']}, {row['step']} steps: {row['psnr_db']:.2f} dB, SSIM {row['ssim']:.4f}, "
        f"{row['gaussians']} Gaussians, {row['seconds']:.1f} s"
    )


def table(rows: list[dict[str, Any]], protocol: dict[str, Any]) -> str:
    """The protocol, a line for each arm and step, and comparisons of the arms' ends."""
    found = summary(rows)
    head = (
        "arm",
        "steps",
        "seeds",
        "PSNR dB",
        "range",
        "SSIM",
        "Gaussians",
        "ms a step",
        "seconds",
        "peak MB",
        "by ours dB",
    )
    lines = [
        (
            row["arm"],
            str(row["step"]),
            str(row["seeds"]),
            f"{row['psnr_db'][0]:.2f}",
            f"{row['psnr_db'][1]:.2f}..{row['psnr_db'][2]:.2f}",
            f"{row['ssim'][0]:.4f}",
            f"{row['gaussians'][0]:.0f}",
            in_ms(row["ms_step"][0]),
            f"{row['seconds'][0]:.1f}",
            megabytes(None if row["peak_bytes"] is None else round(row["peak_bytes"][0])),
            f"{row['psnr_db_by_ours'][0]:.2f}",
        )
        for row in found
    ]
    return "\n".join([_title(protocol), *aligned([head, *lines]), *_comparisons(found)])


def _title(protocol: dict[str, Any]) -> str:
    return (
        f"{protocol['capture']}: {protocol['photographs']} photographs of {protocol['width_px']} x "
        f"{protocol['height_px']} px, {len(protocol['held_out'])} held out, {protocol['points']} points; "
        f"{protocol['steps']} steps, at most {protocol['gaussians']} Gaussians by mcmc; medians over the seeds"
    )


def _comparisons(found: list[dict[str, Any]]) -> list[str]:
    """Compare ours with every other arm at the last step, and find when ours was as good as the arm's end."""
    last = max(row["step"] for row in found)
    ends = {row["arm"]: row for row in found if row["step"] == last}
    if OURS not in ends:
        return []
    ours, lines = ends.pop(OURS), []
    for arm, other in ends.items():
        better, times = (ours["psnr_db"][0] - other["psnr_db"][0], ours["seconds"][0] / other["seconds"][0])
        line = f"ours against {arm}: {better:+.2f} dB in {times:.2f} times its seconds"
        reached = [r for r in found if r["arm"] == OURS and r["psnr_db"][0] >= other["psnr_db"][0]]
        if reached:
            line += (
                f"; as good as its end after {reached[0]['step']} steps, {reached[0]['seconds'][0]:.1f} s in place of "
                f"{other['seconds'][0]:.1f}"
            )
        lines.append(line)
    return lines


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
