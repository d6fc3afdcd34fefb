"""`lightfield-gs bench`: how long a light-field image takes, where the time goes, and how right it is.

A row for every scene, cone and method. Times are those of `encode` to 8 bits, from Gaussians in memory to the image in
memory; errors are those of the very image that was timed, against the float64 oracle rounded to 8 bits likewise.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lightfield_gs import bench_training, build_info
from lightfield_gs.bench_scenes import ZERO_DEPTH, load_scene
from lightfield_gs.errors import InputError
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.io.atomic import atomic_path, check_output_path
from lightfield_gs.panel import DEFAULT_PANEL, Panel
from lightfield_gs.rendering import METHODS, encode
from lightfield_gs.rig import Rig

ORACLE_SAMPLES = 20_000
ORACLE_SEED = 1
SECONDS_PER_METHOD = 60.0  # no further repeat once a method has run for so long
PSNR_CAP_DB = 120.0  # of images without any error


@dataclass(frozen=True)
class OracleSamples:
    """Random sub-pixels (rows, columns, channels [M]) and the 8-bit values [M] that they must have."""

    rows: np.ndarray
    columns: np.ndarray
    channels: np.ndarray
    values: np.ndarray

    def errors(self, image: torch.Tensor) -> dict[str, float]:
        """psnr_db, max_error_255 (in 1/255) and share_over_1 (share off by more than 1/255) of an 8-bit image."""
        shown = image[self.rows, self.columns, self.channels].cpu().numpy()
        error = np.abs(shown.astype(np.int64) - self.values)
        mean_square = np.mean((error / 255) ** 2)
        psnr_db = PSNR_CAP_DB if mean_square == 0 else min(PSNR_CAP_DB, -10 * np.log10(mean_square))
        return {"psnr_db": float(psnr_db), "max_error_255": int(error.max()), "share_over_1": float(np.mean(error > 1))}


def oracle_samples(gaussians: Gaussians, panel: Panel, rig: Rig, count: int = ORACLE_SAMPLES) -> OracleSamples:
    """Random sub-pixels of a panel, before a white background, by lightfield_gs.reference."""
    from lightfield_gs.reference import subpixel_colours

    random = np.random.default_rng(ORACLE_SEED)
    rows = random.integers(0, panel.height_px, count)
    columns = random.integers(0, panel.width_px, count)
    channels = random.integers(0, 3, count)
    colours = subpixel_colours(gaussians, panel, rig, rows, columns, channels)
    return OracleSamples(rows, columns, channels, np.rint(255 * np.clip(colours, 0, 1)).astype(np.int64))


def benchmark_rig(scene: str, gaussians: Gaussians, panel: Panel, cone_deg: float | None) -> Rig:
    """The rig of a scene: that of the synthetic ones (module bench_scenes), or automatic framing of a .ply file."""
    if Path(scene).suffix.lower() == ".ply":
        rig = Rig.frame(gaussians, panel)
        return Rig(rig.world_to_camera, rig.focal_px, rig.principal_point_px, rig.zero_depth, cone_deg)
    focal, centre = (panel.width_px, panel.width_px), (panel.width_px / 2, panel.height_px / 2)
    return Rig(np.eye(4), focal, centre, ZERO_DEPTH, cone_deg)


def time_method(gaussians: Gaussians, panel: Panel, rig: Rig, method: str, repeats: int,
                threads: int | None = None) -> tuple[torch.Tensor, list[float], dict[str, Any]]:
    """The image, the times in ms (sorted), and the counters of the run of median time (`stats` of encode)."""
    runs, spent = [], 0.0
    while len(runs) < repeats and (not runs or spent < SECONDS_PER_METHOD):
        stats: dict[str, Any] = {}
        if gaussians.means.is_cuda:  # counters make the stages wait for each other: time without, then count
            took, image = _seconds_on_cuda(lambda: encode(gaussians, panel, rig, method))
            encode(gaussians, panel, rig, method, stats=stats)
        else:
            begin = time.perf_counter()
            image = encode(gaussians, panel, rig, method, stats=stats, threads=threads)
            took = time.perf_counter() - begin
        spent += took
        runs.append((1e3 * took, stats))
    runs.sort(key=lambda run: run[0])
    return image, [ms for ms, _ in runs], runs[(len(runs) - 1) // 2][1]


def _seconds_on_cuda(render: Callable[[], torch.Tensor]) -> tuple[float, torch.Tensor]:
    """The time of a warm run by CUDA events, and its result."""
    render()
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    image = render()
    end.record()
    end.synchronize()
    return start.elapsed_time(end) / 1e3, image


def bench_scene(scene: str, panel: Panel, cone_deg: float | None, methods: list[str], device: str, repeats: int,
                threads: int | None = None) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of one scene and cone, a method each, and how the others' images compare with the first method's.

    Raises InputError.
    """
    _progress(f"{scene}: making or reading the scene")
    gaussians = load_scene(scene)
    rig = benchmark_rig(scene, gaussians, panel, cone_deg)
    _progress(f"{scene}: oracle, {ORACLE_SAMPLES} sub-pixels")
    oracle = oracle_samples(gaussians, panel, rig)

    gaussians = gaussians.to(device)
    rows, comparisons, first = [], [], None
    for method in methods:
        _progress(f"{scene}: {method}, at most {repeats} runs")
        image, times, stats = time_method(gaussians, panel, rig, method, repeats, threads)
        rows.append({
            "scene": scene, "gaussians": gaussians.count, "panel": panel.name,
            "cone_deg": panel.cone_deg if rig.cone_deg is None else rig.cone_deg, "method": method, "device": device,
            "ms_median": statistics.median(times), "ms_min": times[0], "ms_max": times[-1],
            "stages_ms": stats["stages_ms"], "pairs": stats["pairs"],
            "evaluations_per_subpixel": stats["evaluations_per_subpixel"], "work_bytes": stats["work_bytes"],
            **oracle.errors(image)})
        if first is None:
            first = image
        else:
            comparisons.append({"scene": scene, "cone_deg": rows[0]["cone_deg"], "methods": [methods[0], method],
                                "times_faster": rows[-1]["ms_median"] / rows[0]["ms_median"],
                                **differences(first, image)})
    return rows, comparisons


def differences(a: torch.Tensor, b: torch.Tensor) -> dict[str, float]:
    """Of all sub-pixels of two 8-bit images: the largest difference in 1/255, how many differ, how many by over 1."""
    difference = (a.to(torch.int16) - b).abs_()
    return {"subpixels": difference.numel(), "max_difference_255": int(difference.max()),
            "differing": int((difference > 0).sum()), "over_1": int((difference > 1).sum())}


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as text, a line each."""
    head = ("scene", "Gaussians", "cone", "method", "ms", "min", "max", "pairs", "eval/sub-px", "work MB", "PSNR dB",
            "max /255", "over 1/255")
    lines = [(row["scene"], f"{row['gaussians']}", f"{row['cone_deg']:g}", row["method"], _ms(row["ms_median"]),
              _ms(row["ms_min"]), _ms(row["ms_max"]), f"{row['pairs']}",
              "-" if row["evaluations_per_subpixel"] is None else f"{row['evaluations_per_subpixel']:.1f}",
              f"{row['work_bytes'] / 1e6:.1f}", f"{row['psnr_db']:.1f}",
              f"{row['max_error_255']}", f"{row['share_over_1']:.2g}") for row in rows]
    widths = [max(len(line[column]) for line in (head, *lines)) for column in range(len(head))]
    text = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths)) for line in (head, *lines)]
    text += ["stages of " + f"{row['scene']} {row['cone_deg']:g} {row['method']}, ms: "
             + ", ".join(f"{stage} {ms:.1f}" for stage, ms in row["stages_ms"].items()) for row in rows]
    return "\n".join(text)


def _ms(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.2f}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs bench`."""
    parser.add_argument("what", nargs="?", default="light-field", choices=("light-field", "training-step"),
                        help="a light-field image, or forward and backward of the rasterizer in a training step")
    parser.add_argument("--scene", default="sheet:128", help="sheet:S, cloud:N or a .ply; several with commas")
    parser.add_argument("--panel", default=DEFAULT_PANEL, help="name, YAML or visual.json (default: %(default)s)")
    parser.add_argument("--cone", help="viewing cone in degrees, several with commas (default: the panel's)")
    parser.add_argument("--methods", default="direct", help=f"with commas, of {', '.join(METHODS)}")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each, fewer of those beyond a minute")
    parser.add_argument("--threads", help="threads (default: all cores); several with commas for training-step")
    parser.add_argument("--json", type=Path, help="where to write the rows")


def run(args: argparse.Namespace) -> int:
    """Runs the benchmark, prints a table to stdout and writes the JSON. Raises InputError."""
    if args.device not in ("cpu", "cuda"):
        raise InputError(f"--device: expected cpu or cuda, got {args.device!r}")
    if args.device == "cuda" and not ("cuda" in build_info()["devices"] and torch.cuda.is_available()):
        raise InputError("--device cuda: needs a GPU, and a build that found nvcc (LFGS_CUDA=ON insists on it)")
    if args.repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, got {args.repeats}")
    threads = _numbers("--threads", args.threads, int)
    if args.json is not None:
        check_output_path(args.json)
    if args.what == "training-step":
        rows = (bench_training.rows(threads, args.repeats) if args.device == "cpu" else
                [bench_training.cuda_row(args.repeats)])
        print(bench_training.table(rows))
        result = {"rows": rows}
    else:
        result = _light_field(args, threads)
        print(table(result["rows"]))
        for c in result["comparisons"]:
            print(f"{c['scene']} {c['cone_deg']:g}: {c['methods'][0]} is {c['times_faster']:.1f} times as fast as "
                  f"{c['methods'][1]}; of {c['subpixels']} sub-pixels {c['differing']} differ, {c['over_1']} by more "
                  f"than 1/255, at most by {c['max_difference_255']}/255")
    if args.json is not None:
        with atomic_path(args.json) as temporary:
            temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0


def _light_field(args: argparse.Namespace, threads: list[int | None]) -> dict[str, list[dict[str, Any]]]:
    methods = args.methods.split(",")
    if unknown := sorted(set(methods) - set(METHODS)):
        raise InputError(f"--methods: expected of {', '.join(METHODS)}, got {', '.join(unknown)}")
    if len(threads) > 1:
        raise InputError(f"--threads: expected one number for a light-field image, got {args.threads}")
    panel = Panel.load(args.panel)
    result: dict[str, list[dict[str, Any]]] = {"rows": [], "comparisons": []}
    for scene in args.scene.split(","):
        for cone in _numbers("--cone", args.cone, float):
            rows, comparisons = bench_scene(scene, panel, cone, methods, args.device, args.repeats, threads[0])
            result["rows"] += rows
            result["comparisons"] += comparisons
    return result


def _numbers(option: str, text: str | None, kind: type) -> list[Any]:
    """The positive numbers of "a,b,c"; [None] when the option was not given."""
    if text is None:
        return [None]
    try:
        values = [kind(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(0 < value < float("inf") for value in values):
        raise InputError(f"{option}: expected positive numbers with commas between, got {text!r}")
    return values


def _progress(line: str) -> None:
    print(f"bench: {line}", file=sys.stderr, flush=True)
