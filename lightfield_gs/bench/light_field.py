"""Measure the time of a light-field image, of its stages, and its error.

A row for every scene, cone and method. `encode` to 8 bits is timed from Gaussians in memory to the image in memory. The
error compares the timed image with the float64 oracle, also rounded to 8 bits.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Method
from lightfield_gs.bench import options
from lightfield_gs.bench.benchmarks import load_from_checkout
from lightfield_gs.bench.names import (
    BENCH_METHODS,
    GSPLAT,
    LIGHT_FIELD_METHODS,
    LIGHT_FIELD_SCENES,
    NAMED_CONES,
    ORACLE_SAMPLES,
)
from lightfield_gs.bench.report import aligned, in_ms, megabytes, or_dash
from lightfield_gs.bench.scenes import benchmark_rig, load_scene, oracle_samples
from lightfield_gs.bench.timing import timed
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

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
    """A scene by name, before a panel, in a cone.

    Attributes:
        cone: Degrees, a name, or None for the panel's cone.
        sh_degree: Degree of a synthetic scene; None leaves the scene as it is.
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
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return a row for each method of one case, and comparisons of the other images with the first method's.

    Args:
        memory_budget: Bytes, of the method "sorted".
        samples: Number of sub-pixels that the oracle evaluates.

    Raises:
        InputError: the case cannot be drawn.
    """
    options.progress(f"{case.scene}: making or reading the scene")
    gaussians = load_scene(case.scene, case.sh_degree).to(device)
    panel, rig = case.panel, benchmark_rig(case.scene, gaussians, case.panel, case.cone)
    options.progress(f"{case.scene}: oracle, {samples} sub-pixels")
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
        options.progress(
            f"{case.scene}: {method}, {len(measured.times_ms)} runs, fastest {min(measured.times_ms):.3f} ms"
        )
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


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as text, one a line."""
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


def _cone(row: dict[str, Any]) -> str:
    named = row["cone"] in NAMED_CONES
    return f"{row['cone']} ({row['cone_deg']:.3g})" if named else f"{row['cone_deg']:g}"


def comparison_line(c: dict[str, Any]) -> str:
    """Return a line that compares times and images of two methods."""
    return (
        f"{c['scene']} {_cone(c)} SH {c['sh_degree']}: {c['methods'][0]} is {c['times_faster']:.1f} times as fast "
        f"as {c['methods'][1]}; of {c['subpixels']} sub-pixels {c['differing']} differ, {c['over_1']} by more than "
        f"1/255, at most by {c['max_difference_255']}/255"
    )


def cost_line(c: dict[str, Any]) -> str:
    """Return a line on the cost of harmonics."""
    low, high = c["sh_degrees"]
    return (
        f"{c['scene']} {c['cone']} {c['method']}: SH degree {high} takes {c['times_as_long']:.2f} times as long as "
        f"degree {low}"
    )


def harmonics_cost(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return each row's time relative to the same scene, cone and method with the least SH degree."""
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
    """Return the largest difference of two 8-bit images, in 1/255, and how many sub-pixels differ, and by over 1."""
    difference = (a.to(torch.int16) - b).abs_()
    return {
        "subpixels": difference.numel(),
        "max_difference_255": int(difference.max()),
        "differing": int((difference > 0).sum()),
        "over_1": int((difference > 1).sum()),
    }


@dataclass(frozen=True)
class Measurement:
    """An image, the times of the runs that made it, and counters.

    Attributes:
        image: 8 bits, [H, W, 3].
        times_ms: Times of the runs in their order.
        stats: As `encode` fills them.
        peak_bytes: Most device memory held beyond the scene and the image; None on the CPU.
    """

    image: Tensor
    times_ms: list[float]
    stats: dict[str, Any]
    peak_bytes: int | None = None

    def summary(self) -> dict[str, float]:
        """Return ms_median, ms_min, ms_max and the number of runs."""
        return {
            "ms_median": statistics.median(self.times_ms),
            "ms_min": min(self.times_ms),
            "ms_max": max(self.times_ms),
            "runs": len(self.times_ms),
        }


def measure(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    method: str,
    repeats: int | None = None,
    threads: int | None = None,
    memory_budget: int | None = None,
) -> Measurement:
    """Time a method of `encode`, or a peer, from Gaussians on their device to the 8-bit image on it.

    "direct" on CUDA is an Encoder's replayed frame.

    Args:
        repeats: Number of runs that count; None lets `timed` choose.
        threads: As `encode` takes them.
        memory_budget: As `encode` takes it, for "sorted" alone.

    Raises:
        InputError: the method cannot draw the scene.
    """
    if method == GSPLAT:
        peer = load_from_checkout("peers").GsplatClassic(gaussians, panel, rig)
        image, times = timed(peer, True, repeats)
        return Measurement(image, times, *_counted_on_cuda(peer.counted, image))
    draw = partial(encode, gaussians, panel, rig, cast(Method, method), threads=threads, memory_budget=memory_budget)
    if not gaussians.means.is_cuda:
        return _measure_on_cpu(draw, repeats)

    def counted() -> dict[str, Any]:  # apart from timing, for it makes the stages wait for each other
        stats: dict[str, Any] = {}
        draw(stats=stats)
        return stats

    frame = partial(Encoder(panel, rig), gaussians) if method == "direct" else draw
    image, times = timed(frame, True, repeats)
    return Measurement(image, times, *_counted_on_cuda(counted, image))


def _measure_on_cpu(draw: Callable[..., Tensor], repeats: int | None) -> Measurement:
    """Measure a case on the CPU. Counting costs nothing: the counters come from the run of median time."""
    collected: list[dict[str, Any]] = []

    def counted() -> Tensor:
        collected.append({})
        return draw(stats=collected[-1])

    image, times = timed(counted, False, repeats)
    by_time = sorted(range(len(times)), key=times.__getitem__)
    return Measurement(image, times, collected[by_time[(len(times) - 1) // 2]])


def _counted_on_cuda(counted: Callable[[], dict[str, Any]], image: Tensor) -> tuple[dict[str, Any], int]:
    """Return the counters, and the peak of additional device memory while collecting them."""
    before = torch.cuda.memory_allocated(image.device)
    torch.cuda.reset_peak_memory_stats(image.device)
    stats = counted()
    return stats, torch.cuda.max_memory_allocated(image.device) - before - image.numel()


add_arguments = options.add_light_field


@dataclass(frozen=True, kw_only=True)
class Options(options.SceneOptions):
    """The options of the benchmark.

    Attributes:
        methods: names with commas. None: those of LIGHT_FIELD_METHODS.
        memory_budget: bytes of the method sorted.
        oracle_samples: number of sub-pixels. None: ORACLE_SAMPLES.
    """

    methods: str | None = None
    memory_budget: int | None = None
    oracle_samples: int | None = None


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the rows of every case and method, and their text."""
    result = measure_cases(given, LIGHT_FIELD_SCENES, LIGHT_FIELD_METHODS)
    lines = [table(result["rows"]), *map(comparison_line, result["comparisons"])]
    return result, "\n".join([*lines, *map(cost_line, result["harmonics"])])


def measure_cases(given: Options, usual_scenes: Sequence[str], usual_methods: Sequence[str]) -> dict[str, Any]:
    scenes = usual_scenes if given.scene is None else given.scene.split(",")
    methods = _methods(list(usual_methods) if given.methods is None else given.methods.split(","), given.device)
    count = given.thread_count
    if given.memory_budget is not None and "sorted" not in methods:
        raise InputError(f"memory_budget= is for the method sorted, not {', '.join(methods)}; add it to methods=")
    if given.oracle_samples is not None and given.oracle_samples < 1:
        raise InputError(f"oracle_samples=: expected 1 or more, got {given.oracle_samples}")
    panel, degrees = given.load_panel(), options.sh_degrees(given.sh_degree)
    options.check_scenes(scenes, degrees)
    found: list[dict[str, Any]] = []
    comparisons: list[dict[str, Any]] = []
    for case in (
        Case(s, panel, cone, degree) for s in scenes for cone in options.cones(given.cone) for degree in degrees
    ):
        new_rows, new_comparisons = bench_case(
            case,
            methods,
            given.device,
            given.repeats,
            count,
            given.memory_budget,
            given.oracle_samples or ORACLE_SAMPLES,
        )
        found += new_rows
        comparisons += new_comparisons
    costs = harmonics_cost(found)
    return {"rows": found, "comparisons": comparisons, "harmonics": costs, "peers": _peer_versions(methods)}


def _methods(methods: list[str], device: str) -> list[str]:
    if unknown := sorted(set(methods) - set(BENCH_METHODS)):
        raise InputError(f"methods=: expected of {', '.join(BENCH_METHODS)}, got {', '.join(unknown)}")
    if GSPLAT in methods:
        if device != "cuda":
            raise InputError(f"methods={GSPLAT}: runs on a GPU alone, add device='cuda'")
        load_from_checkout("peers").gsplat()  # raises before any work
    return methods


def _peer_versions(methods: list[str]) -> dict[str, str]:
    return {"gsplat": load_from_checkout("peers").gsplat().__version__} if GSPLAT in methods else {}
