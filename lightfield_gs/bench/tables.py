"""The rows of the benchmarks as text."""

from __future__ import annotations

from typing import Any

from lightfield_gs.bench.scenes import NAMED_CONES


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as text, a line each."""
    head = (
        "scene",
        "Gaussians",
        "SH",
        "cone",
        "method",
        "kernel",
        "ms",
        "min",
        "max",
        "pairs",
        "eval/sub-px",
        "work MB",
        "peak MB",
        "PSNR dB",
        "max /255",
        "over 1/255",
    )
    lines = [
        (
            row["scene"],
            str(row["gaussians"]),
            str(row["sh_degree"]),
            _cone(row),
            row["method"],
            row["kernel"] or "-",
            in_ms(row["ms_median"]),
            in_ms(row["ms_min"]),
            in_ms(row["ms_max"]),
            or_dash(row["pairs"], "d"),
            or_dash(row["evaluations_per_subpixel"], ".1f"),
            megabytes(row["work_bytes"]),
            megabytes(row["peak_bytes"]),
            f"{row['psnr_db']:.1f}",
            str(row["max_error_255"]),
            f"{row['share_over_1']:.2g}",
        )
        for row in rows
    ]
    text = aligned([head, *lines])
    return "\n".join([*text, *map(_stages_line, rows)])


def _stages_line(row: dict[str, Any]) -> str:
    stages = ", ".join(f"{stage} {in_ms(ms)}" for stage, ms in row["stages_ms"].items())
    return f"stages of {row['scene']} {_cone(row)} SH {row['sh_degree']} {row['method']}, ms: {stages}"


def aligned(lines: list[tuple[str, ...]]) -> list[str]:
    """Lines of cells as text, the columns flush right."""
    widths = [max(map(len, column)) for column in zip(*lines)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in lines]


def _cone(row: dict[str, Any]) -> str:
    named = row["cone"] in NAMED_CONES
    return f"{row['cone']} ({row['cone_deg']:.3g})" if named else f"{row['cone_deg']:g}"


def in_ms(value: float) -> str:
    """A time in ms, three digits or more."""
    return f"{value:.0f}" if value >= 100 else f"{value:.2f}" if value >= 10 else f"{value:.3f}"


def or_dash(value: float | None, form: str) -> str:
    """A number in a format, or a dash where there is none."""
    return "-" if value is None else format(value, form)


def megabytes(value: int | None) -> str:
    """Bytes in MB, or a dash where they are not known."""
    return or_dash(None if value is None else value / 1e6, ".1f")


def machine_line(found: dict[str, Any]) -> str:
    """Where the times were taken."""
    gpu = f"{found['gpu']}, CUDA {found['cuda']}, " if "gpu" in found else ""
    return f"{gpu}{found['processor']}, {found['cores']} cores, torch {found['torch']}"


def comparison_line(c: dict[str, Any]) -> str:
    """How two methods' times and images compare."""
    return (
        f"{c['scene']} {_cone(c)} SH {c['sh_degree']}: {c['methods'][0]} is {c['times_faster']:.1f} times as fast "
        f"as {c['methods'][1]}; of {c['subpixels']} sub-pixels {c['differing']} differ, {c['over_1']} by more than "
        f"1/255, at most by {c['max_difference_255']}/255"
    )


def cost_line(c: dict[str, Any]) -> str:
    """What harmonics cost."""
    low, high = c["sh_degrees"]
    return (
        f"{c['scene']} {c['cone']} {c['method']}: SH degree {high} takes {c['times_as_long']:.2f} times as long as "
        f"degree {low}"
    )
