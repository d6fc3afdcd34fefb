"""The rows of `bench fit` over their seeds: tables, and how ours compares."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.fit_arms import GSPLAT_STRATEGIES, OURS
from benchmarks.fit_scores import CONE_SCORES, SCORES
from lightfield_gs.bench.report import aligned, in_ms, megabytes, new_figure, or_dash
from lightfield_gs.io.atomic import atomic_path

_NUMBERS = (*SCORES, *CONE_SCORES, "psnr_db_by_ours", "gaussians", "seconds", "ms_step", "ms_step_lately", "peak_bytes")
# Name, column and digits of the scores in tables
_SHOWN = (
    ("cc_ssim", "SSIM", 4),
    ("lpips", "LPIPS", 3),
    ("gradient_psnr_db", "sharpness dB", 2),
    ("cone_cc_psnr_db", "in the cone dB", 2),
    ("psnr_db", "colours as they are dB", 2),
)
_COLUMNS_OF_PLOTS = 3


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each capture, arm and step: of every number (median, least, most) over the seeds that have it."""
    groups: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["capture"], row["arm"], row["step"]), []).append(row)
    captures, arms = ([row[name] for row in rows] for name in ("capture", "arm"))
    order = sorted(groups, key=lambda group: (captures.index(group[0]), arms.index(group[1]), group[2]))
    return [
        {
            "capture": capture,
            "arm": arm,
            "step": step,
            "seeds": len(groups[capture, arm, step]),
            **{name: _spread(groups[capture, arm, step], name) for name in _NUMBERS},
        }
        for capture, arm, step in order
    ]


def _spread(group: list[dict[str, Any]], name: str) -> list[float] | None:
    values = [row[name] for row in group if row[name] is not None]
    return [statistics.median(values), min(values), max(values)] if values else None


def median(row: dict[str, Any] | None, name: str) -> float | None:
    """Return the median of a number in a row of the summary; None where there is none."""
    return None if row is None or row[name] is None else row[name][0]


def line(row: dict[str, Any]) -> str:
    """A row as it is known, while others are awaited."""
    return (
        f"{row['capture']}, {row['arm']}, seed {row['seed']}, {row['step']} steps: {row['cc_psnr_db']:.2f} dB, SSIM "
        f"{row['cc_ssim']:.4f}, {row['gaussians']} Gaussians, {row['seconds']:.1f} s"
    )


def table(result: dict[str, Any]) -> str:
    """Return the tables of each capture, and the table over several.

    Args:
        result: see Runs.
    """
    found, protocol = summary(result["rows"]), result["protocol"]
    parts = []
    for capture in result["captures"]:
        rows = [row for row in found if row["capture"] == capture["capture"]]
        if rows:
            parts += [_title(capture, protocol), *aligned([_HEAD, *map(_cells, rows)]), *_comparisons(rows), ""]
    if len(result["captures"]) > 1:
        parts += _over_captures(found, protocol)
    return "\n".join([*parts, protocol["scores"]])


_HEAD = (
    "arm",
    "steps",
    "seeds",
    "PSNR dB",
    "range",
    *(column for _, column, _ in _SHOWN),
    "Gaussians",
    "ms a step",
    "seconds",
    "peak MB",
    "by ours dB",
)


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    peak = median(row, "peak_bytes")
    return (
        row["arm"],
        str(row["step"]),
        str(row["seeds"]),
        f"{row['cc_psnr_db'][0]:.2f}",
        f"{row['cc_psnr_db'][1]:.2f}..{row['cc_psnr_db'][2]:.2f}",
        *(or_dash(median(row, name), f".{digits}f") for name, _, digits in _SHOWN),
        f"{row['gaussians'][0]:.0f}",
        in_ms(row["ms_step"][0]),
        f"{row['seconds'][0]:.1f}",
        megabytes(None if peak is None else round(peak)),
        f"{row['psnr_db_by_ours'][0]:.2f}",
    )


def _title(capture: dict[str, Any], protocol: dict[str, Any]) -> str:
    held_out, cone = len(capture["held_out"]), ""
    if capture["centre"] is not None:
        inside, degrees = len(capture["in_cone"]), protocol["cone_deg"]
        cone = f", {inside} of them in the cone of {degrees:g} degrees round {capture['centre']}"
    return (
        f"{capture['capture']}: {capture['photographs']} photographs of {capture['width_px']} x "
        f"{capture['height_px']} px, {held_out} held out{cone}, {capture['points']} points; "
        f"{protocol['steps']} steps, at most {protocol['gaussians']} Gaussians by mcmc; medians over the seeds"
    )


def _comparisons(found: list[dict[str, Any]]) -> list[str]:
    """Compare ours with every other arm at the last step, and find when ours was as good as the arm's end."""
    ends = _ends(found)
    if OURS not in ends:
        return []
    ours, lines = ends.pop(OURS), []
    for arm, other in ends.items():
        better, times = (ours["cc_psnr_db"][0] - other["cc_psnr_db"][0], ours["seconds"][0] / other["seconds"][0])
        words = f"ours against {arm}: {better:+.2f} dB in {times:.2f} times its seconds"
        reached = [r for r in found if r["arm"] == OURS and r["cc_psnr_db"][0] >= other["cc_psnr_db"][0]]
        if reached:
            words += (
                f"; as good as its end after {reached[0]['step']} steps, {reached[0]['seconds'][0]:.1f} s in place of "
                f"{other['seconds'][0]:.1f}"
            )
        lines.append(words)
    return lines


def _ends(found: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the rows of one capture after the last step, by arm."""
    last = max(row["step"] for row in found)
    return {row["arm"]: row for row in found if row["step"] == last}


# --- Over captures


def differences(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each capture: ours, the strategy of gsplat with the highest median, ours less the other.

    The highest is by PSNR with colours matched.

    Args:
        found: of `summary`.

    Returns:
        Rows of capture, ours_db, best (its name), best_db, the differences of the medians of SCORES and
        CONE_SCORES, and seconds: ours divided by the other's. None where an arm or a score is missing.
    """
    rows = []
    for capture in dict.fromkeys(row["capture"] for row in found):
        ends = _ends([row for row in found if row["capture"] == capture])
        ours, others = ends.get(OURS), [ends[arm] for arm in GSPLAT_STRATEGIES if arm in ends]
        best = max(others, key=lambda row: row["cc_psnr_db"][0], default=None)
        row = {"capture": capture, "ours_db": median(ours, "cc_psnr_db"), "best": best and best["arm"]}
        row["best_db"] = median(best, "cc_psnr_db")
        for name in (*SCORES, *CONE_SCORES):
            one, other = median(ours, name), median(best, name)
            row[name] = None if one is None or other is None else one - other
        one, other = median(ours, "seconds"), median(best, "seconds")
        rows.append(row | {"seconds": None if one is None or other is None else one / other})
    return rows


def _over_captures(found: list[dict[str, Any]], protocol: dict[str, Any]) -> list[str]:
    """Return the table over captures; its last rows are over the captures that have a difference."""
    rows, names = differences(found), ["cc_psnr_db", *(name for name, *_ in _SHOWN)]
    digits = {"cc_psnr_db": 2, **{name: count for name, _, count in _SHOWN}}
    heads = (
        "capture",
        "ours dB",
        "best of gsplat",
        "dB",
        "ours - best: dB",
        *(column for _, column, _ in _SHOWN),
        "seconds, ratio",
    )
    lines = [
        (
            row["capture"],
            or_dash(row["ours_db"], ".2f"),
            row["best"] or "-",
            or_dash(row["best_db"], ".2f"),
            *(or_dash(row[name], f"+.{digits[name]}f") for name in names),
            or_dash(row["seconds"], ".2f"),
        )
        for row in rows
    ]
    ways = (("median", statistics.median), ("least", min), ("most", max))
    for words, choose in ways if any(row["best"] for row in rows) else ():
        ends = {name: _chosen(rows, name, choose) for name in (*names, "seconds")}
        cells = (or_dash(ends[name], f"+.{digits[name]}f") for name in names)
        lines.append((words, "", "", "", *cells, or_dash(ends["seconds"], ".2f")))
    return [f"over captures, after {protocol['steps']} steps:", *aligned([heads, *lines]), ""]


def _chosen(rows: Sequence[dict[str, Any]], name: str, choose: Any) -> float | None:
    values = [row[name] for row in rows if row[name] is not None]
    return choose(values) if values else None


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw medians over the seeds, and bars as far as these spread: a panel for each capture. Raises InputError."""
    found, captures = summary(result["rows"]), [capture["capture"] for capture in result["captures"]]
    columns = min(_COLUMNS_OF_PLOTS, len(captures))
    lines = -(-len(captures) // columns)
    figure = new_figure(figsize=(6.4 * columns, 4.4 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for axis, capture in zip(axes, captures):
        _draw(axis, [row for row in found if row["capture"] == capture])
        axis.set_title(f"{capture}, {result['protocol']['steps']} steps", fontsize=9)
    for axis in axes[len(captures) :]:
        axis.set_axis_off()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw(axis: Any, found: list[dict[str, Any]]) -> None:
    for arm in dict.fromkeys(row["arm"] for row in found):
        some = [row for row in found if row["arm"] == arm]
        middle, low, high = (list(values) for values in zip(*(row["cc_psnr_db"] for row in some)))
        spread = [[m - l for m, l in zip(middle, low)], [h - m for m, h in zip(middle, high)]]
        axis.errorbar(
            [row["seconds"][0] for row in some], middle, spread, marker="o", markersize=3, capsize=2, label=arm
        )
    axis.set_xscale("log")
    axis.set_xlabel("seconds of steps", fontsize=9)
    axis.set_ylabel("PSNR of held-out photographs, colours matched, dB", fontsize=9)
    axis.grid(True, linewidth=0.3)
    axis.tick_params(labelsize=8)
    axis.legend(fontsize=8)
