"""`lightfield-gs bench` and `bench paper`: how long a light-field image takes, and how right it is."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import METHODS
from lightfield_gs.bench import paper, peers
from lightfield_gs.bench.light_field import Case, bench_case, harmonics_cost
from lightfield_gs.bench.oracle import ORACLE_SAMPLES
from lightfield_gs.bench.tables import comparison_line, cost_line, table
from lightfield_gs.commands.options import bench as options
from lightfield_gs.commands.options.parser import byte_size

BENCH_METHODS = (*METHODS, *peers.PEERS)
SCENES, USUAL_METHODS = ("sheet:128",), ("direct",)


def add_arguments(
    parser: argparse.ArgumentParser, scenes: Sequence[str] = SCENES, methods: Sequence[str] = USUAL_METHODS
) -> None:
    """Those of a light-field image; scenes, methods: what is measured where nothing is said."""
    options.add_scene(parser, scenes)
    options.add_panel(parser)
    options.add_cone(parser)
    options.add_sh_degree(parser)
    parser.add_argument(
        "--methods",
        help=f"with commas, of {', '.join(BENCH_METHODS)} (the last one on CUDA, when "
        f"gsplat is installed; default: {','.join(methods)})",
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
        help=f"random sub-pixels that the oracle judges the image by (default: {ORACLE_SAMPLES}; near 80 dB one in "
        "1,500 is off by 1/255, so that these leave an uncertainty of 1 dB)",
    )
    options.add_repeats(parser)
    options.add_machine(parser)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Rows of every case and method, and their text."""
    result = _measured(args, SCENES, USUAL_METHODS)
    lines = [table(result["rows"]), *map(comparison_line, result["comparisons"])]
    return result, "\n".join([*lines, *map(cost_line, result["harmonics"])])


def paper_rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """The same for the scenes and methods of the paper, unless others are named, in the form of its tables."""
    result = _measured(args, paper.SCENES, paper.METHODS)
    return result, "\n".join([paper.tables(result["rows"]), *map(cost_line, result["harmonics"])])


def _measured(args: argparse.Namespace, usual_scenes: Sequence[str], usual_methods: Sequence[str]) -> dict[str, Any]:
    scenes = usual_scenes if args.scene is None else args.scene.split(",")
    methods = _methods(list(usual_methods) if args.methods is None else args.methods.split(","), args.device)
    count = options.one_thread_count(args.threads)
    if args.memory_budget is not None and "sorted" not in methods:
        raise InputError(f"--memory-budget is for the method sorted, not {', '.join(methods)}; add it to --methods")
    if args.oracle_samples is not None and args.oracle_samples < 1:
        raise InputError(f"--oracle-samples: expected 1 or more, got {args.oracle_samples}")
    panel, degrees = options.panel_of(args), options.sh_degrees(args.sh_degree)
    options.check_scenes(scenes, degrees)
    found: list[dict[str, Any]] = []
    comparisons: list[dict[str, Any]] = []
    for case in (
        Case(s, panel, cone, degree) for s in scenes for cone in options.cones(args.cone) for degree in degrees
    ):
        new_rows, new_comparisons = bench_case(
            case,
            methods,
            args.device,
            args.repeats,
            count,
            args.memory_budget,
            args.oracle_samples or ORACLE_SAMPLES,
            options.progress,
        )
        found += new_rows
        comparisons += new_comparisons
    costs = harmonics_cost(found)
    return {"rows": found, "comparisons": comparisons, "harmonics": costs, "peers": peers.versions(methods)}


def _methods(methods: list[str], device: str) -> list[str]:
    if unknown := sorted(set(methods) - set(BENCH_METHODS)):
        raise InputError(f"--methods: expected of {', '.join(BENCH_METHODS)}, got {', '.join(unknown)}")
    if foreign := sorted(set(methods) & set(peers.PEERS)):
        if device != "cuda":
            raise InputError(f"--methods {', '.join(foreign)}: runs on a GPU alone, add --device cuda")
        peers.gsplat()  # the complaint comes before any work
    return methods
