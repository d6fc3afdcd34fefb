"""How long a light-field image takes, where the time goes, and how right it is.

A row for every scene, cone and method. Times are those of `encode` to 8 bits, from Gaussians in memory to the image in
memory; errors are those of the very image that was timed, against the float64 oracle rounded to 8 bits likewise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from lightfield_gs.bench.measure import measure
from lightfield_gs.bench.oracle import ORACLE_SAMPLES, oracle_samples
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.panels.panel import Panel

COUNTERS = (
    "stages_ms",
    "kernel",
    "pairs",
    "evaluations_per_subpixel",
    "colour_error",
    "work_bytes",
    "memory_bytes",
    "memory_bytes_unchunked",
)  # keys of encode's stats; None where a method does not tell


@dataclass(frozen=True)
class Case:
    """What is drawn: a scene by name, before a panel, in a cone (degrees, a name, or None: the panel's).

    sh_degree: of a synthetic scene; None: as the scene is.
    """

    scene: str
    panel: Panel
    cone: str | float | None
    sh_degree: int | None


def bench_case(
    case: Case,
    methods: list[str],
    device: str,
    repeats: int | None,
    threads: int | None = None,
    memory_budget: int | None = None,
    samples: int = ORACLE_SAMPLES,
    complain: Callable[[str], None] = lambda line: None,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of one case, a method each, and how the others' images compare with the first method's.

    memory_budget: bytes, of the method "sorted". samples: sub-pixels of the oracle. complain: hears how far it is.
    Raises InputError.
    """
    complain(f"{case.scene}: making or reading the scene")
    gaussians = load_scene(case.scene, case.sh_degree).to(device)
    panel, rig = case.panel, benchmark_rig(case.scene, gaussians, case.panel, case.cone)
    complain(f"{case.scene}: oracle, {samples} sub-pixels")
    oracle = oracle_samples(gaussians, panel, rig, samples)
    what = {
        "scene": case.scene,
        "gaussians": gaussians.count,
        "sh_degree": gaussians.sh_degree,
        "panel": panel.name,
        "cone": "panel" if case.cone is None else case.cone,
        "cone_deg": rig.cone_deg,
    }
    rows: list[dict[str, Any]] = []
    comparisons: list[dict[str, Any]] = []
    first = None
    for method in methods:
        budget = memory_budget if method == "sorted" else None
        measured = measure(gaussians, panel, rig, method, repeats, threads, budget)
        complain(f"{case.scene}: {method}, {len(measured.times_ms)} runs, fastest {min(measured.times_ms):.3f} ms")
        counters = {key: measured.stats.get(key) for key in COUNTERS}
        rows.append(
            {
                **what,
                "method": method,
                "device": device,
                **measured.summary(),
                **counters,
                "memory_budget": budget,
                "peak_bytes": measured.peak_bytes,
                **oracle.errors(measured.image),
            }
        )
        if first is None:
            first = measured.image
        else:
            comparisons.append(
                {
                    **what,
                    "methods": [methods[0], method],
                    "times_faster": rows[-1]["ms_median"] / rows[0]["ms_median"],
                    **differences(first, measured.image),
                }
            )
    return rows, comparisons


def harmonics_cost(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """How many times as long each row took as that of the same scene, cone and method with the least SH degree."""
    least: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        key = (row["scene"], row["cone"], row["method"])
        if key not in least or row["sh_degree"] < least[key]["sh_degree"]:
            least[key] = row
    costs = []
    for row in rows:
        base = least[row["scene"], row["cone"], row["method"]]
        if row["sh_degree"] > base["sh_degree"]:
            costs.append(
                {
                    "scene": row["scene"],
                    "cone": row["cone"],
                    "method": row["method"],
                    "sh_degrees": [base["sh_degree"], row["sh_degree"]],
                    "times_as_long": row["ms_median"] / base["ms_median"],
                }
            )
    return costs


def differences(a: torch.Tensor, b: torch.Tensor) -> dict[str, float]:
    """Of all sub-pixels of two 8-bit images: the largest difference in 1/255, how many differ, how many by over 1."""
    difference = (a.to(torch.int16) - b).abs_()
    return {
        "subpixels": difference.numel(),
        "max_difference_255": int(difference.max()),
        "differing": int((difference > 0).sum()),
        "over_1": int((difference > 1).sum()),
    }
