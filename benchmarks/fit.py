"""Compare fits: the quality of held-out photographs after some steps and seconds.

All arms fit the same Gaussians at the same points to the same photographs, one a step, in the same order. Coordinates
are the same, and the background is black. Cameras and exposures stay fixed.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks import fit_report, peers
from benchmarks.fit_arms import ARMS, PEER_ARMS, USUAL_ARMS, check_arms, usual_arms
from benchmarks.fit_runs import Runs, Source, each_fit
from benchmarks.fit_scores import PROTOCOL, load_lpips
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.bench import options
from lightfield_gs.bench.report import check_plot
from lightfield_gs.commands.options.parser import whole
from lightfield_gs.fitting.cone import read_cone
from lightfield_gs.fitting.settings import FitSettings

STEPS, GAUSSIANS, LONGEST_PX = {"cpu": 200, "cuda": 7000}, {"cpu": 5000, "cuda": 300_000}, {"cpu": 160, "cuda": None}


@dataclass(frozen=True, kw_only=True)
class Options(options.BenchmarkOptions):
    """The options of the benchmark.

    Attributes:
        captures: folders of captures.
        gaussians, steps, longest_px: None: those of GAUSSIANS, STEPS and LONGEST_PX.
        seeds: number of fits of each arm.
        arms: names with commas. None: see `usual_arms`.
        test_every: one of so many photographs is held out.
        cone: degrees, or a panel, of the scores in the cone.
        resume: whether finished fits in the file of rows are kept.
        plot: file for the picture of the rows.
    """

    captures: Sequence[Path] = ()
    gaussians: int | None = None
    steps: int | None = None
    seeds: int = 1
    arms: str | None = None
    longest_px: int | None = None
    test_every: int = 8
    cone: str = DEFAULT_PANEL
    resume: bool = False
    plot: Path | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE", help="folders of captures")
    parser.add_argument(
        "--gaussians",
        type=whole(1, 100_000_000),
        metavar="N",
        help="how many a scene has at the end, of the arms that are told (default: "
        f"{GAUSSIANS['cuda']}, on the CPU {GAUSSIANS['cpu']})",
    )
    parser.add_argument(
        "--steps",
        type=whole(1, 10_000_000),
        help=f"schedules are scaled to them (default: {STEPS['cuda']}, on the CPU {STEPS['cpu']})",
    )
    parser.add_argument("--seeds", type=whole(1, 1000), default=1, help="how many fits of each arm (default: 1)")
    parser.add_argument(
        "--arms",
        help=f"with commas, of {', '.join(ARMS)} (default: {', '.join(USUAL_ARMS)}, or ours alone on the CPU "
        "and where gsplat is not installed)",
    )
    parser.add_argument(
        "--longest-px",
        type=whole(16, 16_384),
        help="photographs are shrunk to this many pixels on their longer side (default: not at all, on the CPU to "
        f"{LONGEST_PX['cpu']})",
    )
    parser.add_argument(
        "--test-every",
        type=whole(2, 1_000_000),
        metavar="K",
        default=8,
        help="one of K photographs is held out, the middle one (default: 8)",
    )
    parser.add_argument(
        "--cone",
        default=DEFAULT_PANEL,
        metavar="DEGREES",
        help="held-out photographs in this cone round the one in the middle are scored apart: degrees, or a panel "
        "(default: %(default)s)",
    )
    parser.add_argument("--resume", action="store_true", help="keep the finished fits in the file of --json")
    options.add_plot(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Rows of every capture, seed, arm and mark, each in the JSON as soon as it is known, and their text.

    Also draws the plot. Raises InputError.
    """
    if given.plot is not None:
        check_plot(given.plot)
    if given.resume and given.json is None:
        raise InputError("resume= goes on with the rows of a file: give json= as well")
    torch.set_num_threads(given.thread_count or torch.get_num_threads())
    arms = usual_arms(given.device) if given.arms is None else given.arms.split(",")
    check_arms(arms)
    settings = FitSettings(steps=given.steps or STEPS[given.device], cap_max=given.gaussians or GAUSSIANS[given.device])
    longest_px = given.longest_px or LONGEST_PX[given.device]
    panel, _ = read_cone(given.cone)
    sources = _sources(given)
    for source in sources:
        source.read(longest_px)
    lpips, lpips_words = load_lpips(given.device)
    protocol = {
        "steps": settings.steps,
        "gaussians": settings.cap_max,
        "longest_px": longest_px,
        "cone_deg": panel.cone_deg,
        "scores": f"{PROTOCOL}; {lpips_words}",
        "gsplat": peers.gsplat().__version__ if set(arms) & set(PEER_ARMS) else None,
    }
    runs = Runs(protocol, given.device, given.json, given.resume)
    for source in sources:
        runs.run(source, longest_px, each_fit(arms, given.seeds, settings), lpips)
    if given.plot is not None:
        fit_report.plot(runs.result, given.plot)
    return runs.result, fit_report.table(runs.result)


def _sources(given: Options) -> list[Source]:
    """Return the captures. Raises InputError where two have one name."""
    names = [folder.resolve().name for folder in given.captures]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"expected captures of different names, got {twice[0]} twice: rename a folder")
    return [Source(name, folder, every=given.test_every) for name, folder in zip(names, given.captures)]
