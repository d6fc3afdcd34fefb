"""`lightfield-gs bench`: how long a light-field image takes, where the time goes, and how right it is.

A row for every scene, cone and method. Times are those of `encode` to 8 bits, from Gaussians in memory to the image in
memory; errors are those of the very image that was timed, against the float64 oracle rounded to 8 bits likewise.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.options import METHODS
from lightfield_gs.bench import dense, eyes, fit, fit_plot, fit_report, paper, pareto, peers, photo, skips, training
from lightfield_gs.bench.fit_data import Photographs
from lightfield_gs.bench.measure import measure
from lightfield_gs.bench.oracle import ORACLE_SAMPLES, oracle_samples
from lightfield_gs.bench.pareto_plot import check_plot, plot
from lightfield_gs.bench.scenes import NAMED_CONES, benchmark_rig, check_scene, load_scene
from lightfield_gs.bench.tables import comparison_line, cost_line, machine_line, table
from lightfield_gs.bench.timing import machine
from lightfield_gs.commands.options.bench_fits import add_fit_options
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.values import byte_size
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.atomic import atomic_path, check_output_path, check_outputs
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.panels.panel import DEFAULT_PANEL, Panel
from lightfield_gs.photo.load import load_photo

BENCH_METHODS = (*METHODS, *peers.PEERS)
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
DEFAULT_SCENES, DEFAULT_METHODS = ("sheet:128",), ("direct",)
_DRAWN = ("light-field", "paper")
# Which benchmarks take each option that not all of them take
OPTIONS_OF = {
    "scene": (*_DRAWN, "pareto", "skips", "eyes"),
    "cone": (*_DRAWN, "pareto", "skips", "eyes"),
    "sh_degree": (*_DRAWN, "skips", "eyes"),
    "methods": _DRAWN,
    "memory_budget": _DRAWN,
    "oracle_samples": _DRAWN,
    "photo": ("photo", "pareto"),
    "model": ("photo",),
    "plot": ("pareto", "fit"),
    "repeats": (*_DRAWN, "training-step", "photo", "pareto", "skips", "dense"),
    "gaussians": ("dense", "fit"),
    "size": ("dense",),
    **dict.fromkeys(("capture", "steps", "seeds", "arms", "longest_px", "test_every"), ("fit",)),
}


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
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of one case, a method each, and how the others' images compare with the first method's.

    memory_budget: bytes, of the method "sorted". samples: sub-pixels of the oracle. Raises InputError.
    """
    _progress(f"{case.scene}: making or reading the scene")
    gaussians = load_scene(case.scene, case.sh_degree).to(device)
    panel, rig = case.panel, benchmark_rig(case.scene, gaussians, case.panel, case.cone)
    _progress(f"{case.scene}: oracle, {samples} sub-pixels")
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
        _progress(f"{case.scene}: {method}, {len(measured.times_ms)} runs, fastest {min(measured.times_ms):.3f} ms")
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs bench`."""
    parser.add_argument(
        "what",
        nargs="?",
        default="light-field",
        choices=("light-field", "paper", "training-step", "photo", "pareto", "skips", "dense", "fit", "eyes"),
        help="a light-field image, the tables of Shi et al. (ten scenes, times and memory of three "
        "methods), forward and backward of the rasterizer in a training step, a photo through "
        "the network to the image, run time against error over the settings of quality, what "
        "each skip of what a scene does not need saves, forward and backward of one camera before many Gaussians, "
        "fits to the photographs of CAPTURE, or what eyes across the cone see, with and without --view-filter",
    )
    add_fit_options(parser)
    parser.add_argument(
        "--scene",
        help="sheet:S, cloud:N or a .ply; several with commas (default: sheet:128; of "
        f"pareto: {', '.join(pareto.SCENES)}; of skips: {', '.join(skips.SCENES)})",
    )
    parser.add_argument(
        "--photo",
        help=f"of photo and pareto: files, several with commas (default: the one inside, {photo.EXAMPLE.name})",
    )
    parser.add_argument(
        "--model",
        help="of photo: a checkpoint (.safetensors), or the configuration of an untrained "
        "network, a name or .yaml (default: the checkpoint inside)",
    )
    parser.add_argument(
        "--panel",
        default=DEFAULT_PANEL,
        help="name, YAML or visual.json (default: %(default)s); bench-8k-96v, bench-4k-71v: those of published figures",
    )
    add_device_serial(parser.add_argument)
    parser.add_argument(
        "--cone",
        help="viewing cone in degrees, or narrow (40 px of disparity over all views) or wide "
        "(53 degrees); several with commas (default: the panel's; of pareto: 5,40)",
    )
    parser.add_argument("--sh-degree", help="0..3 of synthetic scenes, several with commas (default: 0)")
    parser.add_argument(
        "--methods",
        help=f"with commas, of {', '.join(BENCH_METHODS)} (the last one on CUDA, when "
        f"gsplat is installed; default: direct)",
    )
    parser.add_argument(
        "--memory-budget",
        type=byte_size,
        metavar="SIZE",
        help="of the method sorted, for example 256MB, as `encode` takes it",
    )
    parser.add_argument(
        "--oracle-samples",
        type=int,
        metavar="N",
        help="of a light-field image: random sub-pixels that the oracle judges it by (default: "
        f"{ORACLE_SAMPLES}; near 80 dB one in 1,500 is off by 1/255, so that these leave an "
        "uncertainty of 1 dB)",
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument(
        "--repeats",
        type=int,
        help="runs of each, fewer of those beyond a minute (default: 5, and 20 of what takes less than 50 ms on CUDA)",
    )
    parser.add_argument(
        "--threads", help="threads (default: all cores); several with commas for training-step and photo"
    )
    parser.add_argument("--plot", type=Path, help="of pareto and fit: a picture of the rows, .png, .svg, .pdf or .webp")
    parser.add_argument("--json", type=Path, help="where to write the rows, and what machine they are from")


def run(args: argparse.Namespace) -> int:
    """Runs the benchmark, prints a table to stdout and writes the JSON. Raises InputError."""
    choose_device(args.device)
    if args.repeats is not None and args.repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, got {args.repeats}")
    threads = _thread_counts(args.threads)
    if args.json is not None:
        check_output_path(args.json)
    named = [*(args.scene or "").split(","), *(args.photo or "").split(",")]
    check_outputs((args.json, args.plot), (*filter(None, named), args.model, args.panel, args.capture))
    for option, kinds in OPTIONS_OF.items():
        if getattr(args, option) is not None and args.what not in kinds:
            name = "CAPTURE" if option == "capture" else "--" + option.replace("_", "-")
            raise InputError(f"{name} is for `bench {'` and `bench '.join(kinds)}`; leave it out")
    if args.what == "training-step":
        result, text = _training_step(args, threads)
    elif args.what == "photo":
        result, text = _photo(args, threads)
    elif args.what == "pareto":
        result, text = _pareto(args, threads)
    elif args.what == "skips":
        result, text = _skips(args, threads)
    elif args.what == "dense":
        result, text = _dense(args, threads)
    elif args.what == "eyes":
        result, text = _eyes(args, threads)
    elif args.what == "fit":
        result, text = _fit(args, threads)
    else:
        result, text = _light_field(args, threads, args.what == "paper")
    result["machine"] = machine(args.device)
    print(machine_line(result["machine"]))
    print(text)
    _write(result, args.json)
    return 0


def _write(result: dict[str, Any], path: Path | None) -> None:
    """The JSON, where one is asked for."""
    if path is not None:
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def _training_step(args: argparse.Namespace, threads: list[int | None]) -> tuple[dict[str, Any], str]:
    """Rows of the training step, gsplat's too where it can be had on CUDA, and their text."""
    if args.device == "cpu":
        rows = training.cpu_rows(threads, args.repeats)
    else:
        rows = [training.cuda_row(args.repeats)]
        try:
            rows.append(training.gsplat_row(args.repeats))
        except InputError as error:
            _progress(f"no row of gsplat: {error}")
    return {"rows": rows}, training.table(rows)


def _panel(args: argparse.Namespace) -> Panel:
    return Panel.load(args.panel, serial=args.device_serial)


def _photo(args: argparse.Namespace, threads: list[int | None]) -> tuple[dict[str, Any], str]:
    """Rows of every photo, and their text."""
    photos = [str(photo.EXAMPLE)] if args.photo is None else args.photo.split(",")
    _check_photos(photos)
    rows = photo.rows(photos, args.model, _panel(args), args.device, args.repeats, threads)
    return {"rows": rows}, photo.table(rows)


def _pareto(args: argparse.Namespace, threads: list[int | None]) -> tuple[dict[str, Any], str]:
    """Rows of every scene, photo, cone and setting, and their text; draws the plot."""
    if args.plot is not None:
        check_plot(args.plot)
    photos = [] if args.scene and not args.photo else (args.photo or str(photo.EXAMPLE)).split(",")
    _check_photos(photos)
    scenes = pareto.SCENES if not args.scene and not args.photo else args.scene.split(",") if args.scene else ()
    _check_scenes(scenes)
    rows, count = [], _one_thread_count(args, threads)
    for subject in pareto.subjects(
        scenes, photos, _panel(args), pareto.CONES if args.cone is None else _cones(args.cone), args.device
    ):
        made = subject()
        _progress(f"{made.name}, {made.rig.cone_deg:g} degrees: oracle, then all settings by turns")
        rows += pareto.rows(made, pareto.settings(), args.repeats, count)
    if args.plot is not None:
        plot(rows, args.plot)
    return {"rows": rows}, pareto.table(rows)


def _skips(args: argparse.Namespace, threads: list[int | None]) -> tuple[dict[str, Any], str]:
    """Rows of every skip, for every scene and cone, and their text."""
    scenes, panel = skips.SCENES if args.scene is None else args.scene.split(","), _panel(args)
    cones, count, rows = _cones(args.cone), _one_thread_count(args, threads), []
    degrees = _sh_degrees(args.sh_degree)
    _check_scenes(scenes, degrees)
    for scene in scenes:
        for degree in degrees:
            gaussians = load_scene(scene, degree).to(args.device)
            for cone in cones:
                subject = pareto.Subject(
                    Path(scene).name, gaussians, panel, benchmark_rig(scene, gaussians, panel, cone)
                )
                _progress(f"{subject.name}, {subject.rig.cone_deg:g} degrees: with and without every skip by turns")
                rows += skips.rows(subject, args.repeats, count)
    return {"rows": rows}, skips.table(rows)


def _eyes(args: argparse.Namespace, threads: list[int | None]) -> tuple[dict[str, Any], str]:
    """Rows of every width of the view filter, for every scene and cone, and their text."""
    scenes, panel = DEFAULT_SCENES if args.scene is None else args.scene.split(","), _panel(args)
    eyes.check_panel(panel)
    cones, degrees = _cones(args.cone), _sh_degrees(args.sh_degree)
    rows: list[dict[str, Any]] = []
    torch.set_num_threads(_one_thread_count(args, threads) or torch.get_num_threads())
    _check_scenes(scenes, degrees)
    for scene in scenes:
        for degree in degrees:
            gaussians = load_scene(scene, degree).to(args.device)
            for cone in cones:
                rig = benchmark_rig(scene, gaussians, panel, cone)
                _progress(f"{Path(scene).name}, {rig.cone_deg:g} degrees: {eyes.EYES} eyes")
                rows += eyes.rows(pareto.Subject(Path(scene).name, gaussians, panel, rig))
    return {"rows": rows}, eyes.table(rows)


def _dense(args: argparse.Namespace, threads: list[int | None]) -> tuple[dict[str, Any], str]:
    """Rows of every number of Gaussians, gsplat's too where it can be had on CUDA, and their text."""
    torch.set_num_threads(_one_thread_count(args, threads) or torch.get_num_threads())
    counts, size = args.gaussians or dense.COUNTS[args.device], args.size or dense.SIZES_PX[args.device]
    rows = dense.rows(counts, size, args.device, args.repeats, _progress)
    return {"rows": rows}, dense.table(rows)


def _fit(args: argparse.Namespace, threads: list[int | None]) -> tuple[dict[str, Any], str]:
    """Rows of every seed, arm and mark, each in the JSON as soon as it is known, and their text; draws the plot."""
    if args.plot is not None:
        check_plot(args.plot)
    if args.capture is None:
        raise InputError("`bench fit` needs the folder of a capture: lightfield-gs bench fit CAPTURE")
    torch.set_num_threads(_one_thread_count(args, threads) or torch.get_num_threads())
    arms = fit.usual_arms(args.device, _progress) if args.arms is None else args.arms.split(",")
    fit.check_arms(arms)
    (gaussians, *more) = args.gaussians or (fit.GAUSSIANS[args.device],)
    if more:
        raise InputError(f"--gaussians: expected one number for a fit, got {len(more) + 1}")
    settings = FitSettings(steps=args.steps or fit.STEPS[args.device], gaussians=gaussians)
    capture = read_capture(args.capture, longest_px=args.longest_px or fit.LONGEST_PX[args.device])
    _progress(f"{args.capture}: reading {len(capture.names)} photographs")
    photographs = Photographs.load(capture, args.test_every or 8, args.device)
    result: dict[str, Any] = {"protocol": fit.protocol(photographs, settings, arms, args.capture)}
    result |= {"machine": machine(args.device), "rows": []}
    for row in fit.rows(photographs, arms, settings, args.seeds or 1):
        _progress(fit_report.line(row))
        result["rows"].append(row)
        result["summary"] = fit_report.summary(result["rows"])
        _write(result, args.json)
    if args.plot is not None:
        fit_plot.plot(result["rows"], result["protocol"], args.plot)
    return result, fit_report.table(result["rows"], result["protocol"])


def _one_thread_count(args: argparse.Namespace, threads: list[int | None]) -> int | None:
    if len(threads) > 1:
        raise InputError(f"--threads: expected one number for `bench {args.what}`, got {args.threads}")
    return threads[0]


def _check_photos(photos: list[str]) -> None:
    """Raises InputError before the first is measured: what was measured until then would be lost."""
    for path in photos:
        with named("--photo"):
            load_photo(path)


def _check_scenes(scenes: Sequence[str], sh_degrees: Sequence[int | None] = (None,)) -> None:
    """Raises InputError before the first is measured: what was measured until then would be lost."""
    for scene in scenes:
        for degree in sh_degrees:
            check_scene(scene, degree)


def _light_field(args: argparse.Namespace, threads: list[int | None], published: bool) -> tuple[dict[str, Any], str]:
    """Rows of every case and method, and their text.

    published: those of the paper, unless others are named.
    """
    usual_scenes, usual = (paper.SCENES, paper.METHODS) if published else (DEFAULT_SCENES, DEFAULT_METHODS)
    scenes = usual_scenes if args.scene is None else args.scene.split(",")
    methods = _methods(list(usual) if args.methods is None else args.methods.split(","), args.device)
    count = _one_thread_count(args, threads)
    if args.memory_budget is not None and "sorted" not in methods:
        raise InputError(f"--memory-budget is for the method sorted, not {', '.join(methods)}; add it to --methods")
    if args.oracle_samples is not None and args.oracle_samples < 1:
        raise InputError(f"--oracle-samples: expected 1 or more, got {args.oracle_samples}")
    panel = _panel(args)
    degrees = _sh_degrees(args.sh_degree)
    _check_scenes(scenes, degrees)
    cases = [Case(scene, panel, cone, degree) for scene in scenes for cone in _cones(args.cone) for degree in degrees]
    rows, comparisons = [], []
    for case in cases:
        new_rows, new_comparisons = bench_case(
            case, methods, args.device, args.repeats, count, args.memory_budget, args.oracle_samples or ORACLE_SAMPLES
        )
        rows += new_rows
        comparisons += new_comparisons
    costs = harmonics_cost(rows)
    result = {"rows": rows, "comparisons": comparisons, "harmonics": costs, "peers": peers.versions(methods)}
    text = [paper.tables(rows)] if published else [table(rows), *map(comparison_line, comparisons)]
    return result, "\n".join([*text, *map(cost_line, costs)])


def _methods(methods: list[str], device: str) -> list[str]:
    if unknown := sorted(set(methods) - set(BENCH_METHODS)):
        raise InputError(f"--methods: expected of {', '.join(BENCH_METHODS)}, got {', '.join(unknown)}")
    if foreign := sorted(set(methods) & set(peers.PEERS)):
        if device != "cuda":
            raise InputError(f"--methods {', '.join(foreign)}: runs on a GPU alone, add --device cuda")
        peers.gsplat()  # the complaint comes before any work
    return methods


def _cones(text: str | None) -> list[str | float | None]:
    """Cones as `cone_degrees` takes them; [None] when the option was not given."""
    if text is None:
        return [None]
    return [part if part in NAMED_CONES else _cone(part) for part in text.split(",")]


def _cone(text: str) -> float:
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if not 0 < degrees < 180:
        raise InputError(f"--cone: expected degrees between 0 and 180, or {' or '.join(NAMED_CONES)}, got {text!r}")
    return degrees


def _sh_degrees(text: str | None) -> list[int | None]:
    if text is None:
        return [None]
    if not all(part in ("0", "1", "2", "3") for part in text.split(",")):
        raise InputError(f"--sh-degree: expected degrees 0..3 with commas between, got {text!r}")
    return [int(part) for part in text.split(",")]


def _thread_counts(text: str | None) -> list[int | None]:
    """The numbers of "1,2"; [None] when the option was not given."""
    if text is None:
        return [None]
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        counts = []
    if not counts or min(counts) < 1:
        raise InputError(f"--threads: expected positive numbers with commas between, got {text!r}")
    return [*counts]


def _progress(line: str) -> None:
    print(f"bench: {line}", file=sys.stderr, flush=True)
