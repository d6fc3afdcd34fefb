"""`lightfield-gs bench fit`: fits to the photographs of a capture, ours and what gsplat's strategies make of them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from lightfield_gs.bench import fit, fit_plot, fit_report
from lightfield_gs.bench.fit_data import Photographs
from lightfield_gs.bench.pareto_plot import check_plot
from lightfield_gs.bench.timing import machine
from lightfield_gs.commands.options import bench as options
from lightfield_gs.commands.options.parser import whole
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.json_file import write_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="the folder of a capture")
    parser.add_argument(
        "--gaussians",
        type=whole(1, 100_000_000),
        metavar="N",
        help="how many a scene has at the end, of the arms that are told (default: "
        f"{fit.GAUSSIANS['cuda']}, on the CPU {fit.GAUSSIANS['cpu']})",
    )
    parser.add_argument(
        "--steps",
        type=whole(1, 10_000_000),
        help=f"schedules are scaled to them (default: {fit.STEPS['cuda']}, on the CPU {fit.STEPS['cpu']})",
    )
    parser.add_argument("--seeds", type=whole(1, 1000), default=1, help="how many fits of each arm (default: 1)")
    parser.add_argument(
        "--arms",
        help=f"with commas, of {', '.join(fit.ARMS)} (default: {', '.join(fit.USUAL_ARMS)}, or ours alone on the CPU "
        "and where gsplat is not installed)",
    )
    parser.add_argument(
        "--longest-px",
        type=whole(16, 16_384),
        help="photographs are shrunk to this many pixels on their longer side (default: not at all, on the CPU to "
        f"{fit.LONGEST_PX['cpu']})",
    )
    parser.add_argument(
        "--test-every",
        type=whole(2, 1_000_000),
        metavar="K",
        default=8,
        help="one of K photographs is held out, the middle one (default: 8)",
    )
    options.add_plot(parser)
    options.add_machine(parser)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Rows of every seed, arm and mark, each in the JSON as soon as it is known, and their text; draws the plot."""
    if args.plot is not None:
        check_plot(args.plot)
    torch.set_num_threads(options.one_thread_count(args.threads) or torch.get_num_threads())
    arms = fit.usual_arms(args.device, options.progress) if args.arms is None else args.arms.split(",")
    fit.check_arms(arms)
    settings = FitSettings(
        steps=args.steps or fit.STEPS[args.device], cap_max=args.gaussians or fit.GAUSSIANS[args.device]
    )
    capture = read_capture(args.capture, longest_px=args.longest_px or fit.LONGEST_PX[args.device])
    options.progress(f"{args.capture}: reading {len(capture.names)} photographs")
    photographs = Photographs.load(capture, args.test_every, args.device)
    result: dict[str, Any] = {"protocol": fit.protocol(photographs, settings, arms, args.capture)}
    result |= {"machine": machine(args.device), "rows": []}
    for row in fit.rows(photographs, arms, settings, args.seeds):
        options.progress(fit_report.line(row))
        result["rows"].append(row)
        result["summary"] = fit_report.summary(result["rows"])
        if args.json is not None:
            write_json(result, args.json)
    if args.plot is not None:
        fit_plot.plot(result["rows"], result["protocol"], args.plot)
    return result, fit_report.table(result["rows"], result["protocol"])
