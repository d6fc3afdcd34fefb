"""`lightfield-gs bench`: how fast and how right the program is, a benchmark each of lightfield_gs/commands/benches."""

from __future__ import annotations

import argparse
import importlib

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench.tables import machine_line
from lightfield_gs.bench.timing import machine
from lightfield_gs.commands.benches import light_field
from lightfield_gs.io.atomic import check_output_path, check_outputs
from lightfield_gs.io.text_files import write_json

USUAL = "light-field"
BENCHMARKS = {
    USUAL: "a light-field image: run time, stages, memory and error against the oracle (when none is named)",
    "paper": "the tables of Shi et al.: ten scenes, times and memory of three methods",
    "training-step": "forward and backward of the rasterizer in a training step",
    "photo": "a photo through the network to the image",
    "pareto": "run time against error over the settings of quality",
    "skips": "what each skip of what a scene does not need saves",
    "video": "frames a second of a turntable, with and without writing them",
    "dense": "forward and backward of one camera before many Gaussians",
    "eyes": "what eyes across the cone see, with and without --view-filter",
    "fit": "fits to the photographs of a capture, beside gsplat's",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs bench`: those of a light-field image where no benchmark is named."""
    parser.description = "Measures speed and accuracy. BENCHMARK --help has the options of each."
    light_field.add_arguments(parser)
    kinds = parser.add_subparsers(
        title="benchmarks", dest="what", metavar="BENCHMARK", parser_class=type(parser), required=False
    )
    for name, purpose in BENCHMARKS.items():
        _module(name).add_arguments(kinds.add_parser(name, help=purpose, description=f"{purpose}.", allow_abbrev=False))
    parser.set_defaults(what=USUAL)


def run(args: argparse.Namespace) -> int:
    """Runs the benchmark, prints a table to stdout and writes the JSON. Raises InputError."""
    choose_device(args.device)
    if getattr(args, "repeats", None) is not None and args.repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, got {args.repeats}")
    if args.json is not None:
        check_output_path(args.json)
    check_outputs((args.json, getattr(args, "plot", None)), _inputs(args))
    result, text = _module(args.what).rows(args)
    result["machine"] = machine(args.device)
    print(machine_line(result["machine"]))
    print(text)
    if args.json is not None:
        write_json(result, args.json)
    return 0


def _module(name: str):
    return importlib.import_module(f"lightfield_gs.commands.benches.{name.replace('-', '_')}")


def _inputs(args: argparse.Namespace) -> list:
    """What is read, so that no output is written over it."""
    several = [path for name in ("scene", "photo") for path in (getattr(args, name, None) or "").split(",") if path]
    return [*several, *(getattr(args, name, None) for name in ("model", "panel", "capture"))]
