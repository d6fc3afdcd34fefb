"""Compare fits: the quality of held-out photographs after some steps and seconds.

All arms fit the same Gaussians at the same points to the same photographs, one a step, in the same order. Coordinates
are the same, and the background is black. Cameras stay fixed. Ours fits an exposure for each photograph where
`fit` does by default; scores are therefore compared with colours matched.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks import fit_report, fit_standard, peers
from benchmarks.fit_arms import ARMS, PEER_ARMS, USUAL_ARMS, check_arms, usual_arms
from benchmarks.fit_protocol import HALVES, read_half
from benchmarks.fit_runs import Runs, Source, each_fit
from benchmarks.fit_scores import PROTOCOL, load_lpips
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.bench import options
from lightfield_gs.bench.report import check_plot
from lightfield_gs.commands.options.parser import whole
from lightfield_gs.fitting.cone import read_cone
from lightfield_gs.fitting.settings import FitSettings

TEST_EVERY = 8
STEPS, GAUSSIANS, LONGEST_PX = {"cpu": 200, "cuda": 7000}, {"cpu": 5000, "cuda": 300_000}, {"cpu": 160, "cuda": None}


@dataclass(frozen=True, kw_only=True)
class Options(options.BenchmarkOptions):
    """The options of the benchmark. Its captures come from one of captures, protocol and standard.

    Attributes:
        captures: folders of captures.
        protocol: file with captures in two halves.
        half: the half of it, one of HALVES.
        data: folders that hold the captures of the protocol.
        standard: folder of the published scenes.
        gaussians, steps, longest_px: None: those of GAUSSIANS, STEPS and LONGEST_PX, or of protocol or standard.
        seeds: number of fits of each arm. None: 1, or that of the protocol.
        arms: names with commas. None: see `usual_arms`.
        test_every: one of so many photographs is held out. None: TEST_EVERY.
        cone: degrees, or a panel, of the scores in the cone.
        resume: whether finished fits in the file of rows are kept.
        plot: file for the picture of the rows.
    """

    captures: Sequence[Path] = ()
    protocol: Path | None = None
    half: str | None = None
    data: Sequence[Path] = ()
    standard: Path | None = None
    gaussians: int | None = None
    steps: int | None = None
    seeds: int | None = None
    arms: str | None = None
    longest_px: int | None = None
    test_every: int | None = None
    cone: str = DEFAULT_PANEL
    resume: bool = False
    plot: Path | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("captures", type=Path, nargs="*", metavar="CAPTURE", help="folders of captures")
    parser.add_argument(
        "--protocol",
        type=Path,
        metavar="FILE",
        help="take the captures of one half of this file, as configs/fit-protocol.yaml, in place of CAPTURE",
    )
    parser.add_argument("--half", choices=HALVES, help="of --protocol: by which defaults are chosen, or reported ones")
    parser.add_argument(
        "--data", type=Path, nargs="+", metavar="FOLDER", default=(), help="folders with these captures"
    )
    parser.add_argument(
        "--standard",
        type=Path,
        metavar="FOLDER",
        short="fit the published scenes in this folder",
        help="take the scenes of mip-NeRF 360, Tanks and Temples and Deep Blending in this folder, as published, in "
        f"place of CAPTURE ({fit_standard.STEPS} steps, {fit_standard.GAUSSIANS} Gaussians)",
    )
    parser.add_argument(
        "--gaussians",
        type=whole(1, 100_000_000),
        metavar="N",
        help="how many a scene has at the end, of the arms that are told (default: "
        f"{GAUSSIANS['cuda']}, on the CPU {GAUSSIANS['cpu']}; with --protocol that of the file)",
    )
    parser.add_argument(
        "--steps",
        type=whole(1, 10_000_000),
        help=f"schedules are scaled to them (default: {STEPS['cuda']}, on the CPU {STEPS['cpu']})",
    )
    parser.add_argument(
        "--seeds", type=whole(1, 1000), help="how many fits of each arm (default: 1, or those of --protocol)"
    )
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
        help=f"one of K photographs is held out, the middle one (default: {TEST_EVERY})",
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


@dataclass(frozen=True)
class _Plan:
    """The captures of a run, its defaults, and the fields of its protocol that name the captures."""

    sources: list[Source]
    steps: int
    gaussians: int
    longest_px: int | None
    seeds: int
    fields: dict[str, Any]


def _planned(given: Options) -> _Plan:
    """Return the plan of the one kind of captures that is given. Raises InputError."""
    kinds = {"captures": given.captures, "protocol=": given.protocol, "standard=": given.standard}
    chosen = [name for name, value in kinds.items() if value]
    if len(chosen) != 1:
        what = " and ".join(chosen) or "none of them"
        raise InputError(f"expected captures, or protocol=, or standard=, got {what}: each is a run of its own")
    if given.protocol is None and (given.half is not None or given.data):
        raise InputError("half= and data= belong to a protocol: give protocol= as well")
    steps, gaussians, longest_px = STEPS[given.device], GAUSSIANS[given.device], LONGEST_PX[given.device]
    if given.standard is not None:
        if given.test_every is not None:
            raise InputError("standard=: the published scenes hold out every eighth photograph: leave test_every= out")
        sources = fit_standard.find_scenes(given.standard)
        return _Plan(sources, fit_standard.STEPS, fit_standard.GAUSSIANS, None, 1, {"standard": True})
    every = given.test_every or TEST_EVERY
    if given.protocol is not None:
        if given.half is None or not given.data:
            raise InputError(f"protocol=: give half={' or half='.join(HALVES)}, and data= with the captures' folders")
        half = read_half(given.protocol, given.half, given.data, every)
        fields = {"half": given.half, "missing": half.missing, "test_every": every}
        return _Plan(half.sources, steps, half.gaussians, longest_px, half.seeds, fields)
    return _Plan(_named_sources(given.captures, every), steps, gaussians, longest_px, 1, {"test_every": every})


def _named_sources(folders: Sequence[Path], every: int) -> list[Source]:
    """Return captures by the names of their folders. Raises InputError where two have one name."""
    names = [folder.resolve().name for folder in folders]
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"expected captures of different names, got {twice[0]} twice: rename a folder")
    return [Source(name, folder, every=every) for name, folder in zip(names, folders)]


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
    panel, _ = read_cone(given.cone)
    plan = _planned(given)
    settings = FitSettings(steps=given.steps or plan.steps, cap_max=given.gaussians or plan.gaussians)
    longest_px = given.longest_px or plan.longest_px
    for source in plan.sources:
        source.read(longest_px)
    lpips, lpips_words = load_lpips(given.device, from_zero=given.standard is not None)
    protocol = {
        **plan.fields,
        "steps": settings.steps,
        "gaussians": settings.cap_max,
        "longest_px": longest_px,
        "cone_deg": panel.cone_deg,
        "scores": f"{PROTOCOL}; {lpips_words}",
        "gsplat": peers.gsplat().__version__ if set(arms) & set(PEER_ARMS) else None,
    }
    runs = Runs(protocol, given.device, given.json, given.resume)
    for source in plan.sources:
        runs.run(source, longest_px, each_fit(arms, given.seeds or plan.seeds, settings), lpips)
    if given.plot is not None:
        fit_report.plot(runs.result, given.plot)
    text = fit_report.table(runs.result)
    return runs.result, text if given.standard is None else f"{text}\n\n{fit_standard.table(runs.result)}"
