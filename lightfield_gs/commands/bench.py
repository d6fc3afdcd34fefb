"""`lightfield-gs bench`: measure speed and accuracy."""

from __future__ import annotations

import argparse

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench.benchmarks import BENCHMARKS, DEFAULT, load
from lightfield_gs.bench.timing import machine, machine_line
from lightfield_gs.io.atomic import check_output_path, check_outputs
from lightfield_gs.io.text_files import write_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the default benchmark, and a subcommand for each benchmark."""
    parser.description = "Measures speed and accuracy. BENCHMARK --help has the options of each."
    load(DEFAULT).add_arguments(parser)
    kinds = parser.add_subparsers(
        title="benchmarks", dest="what", metavar="BENCHMARK", parser_class=type(parser), required=False
    )
    for name, purpose in BENCHMARKS.items():
        try:
            benchmark = load(name)
        except InputError:  # `run` gives the reason. Without a prefix of options all words are taken until then.
            missing = kinds.add_parser(name, help=f"{purpose} (in a checkout)", prefix_chars="\0", add_help=False)
            missing.add_argument("words", nargs="*")
        else:
            benchmark.add_arguments(kinds.add_parser(name, help=purpose, description=f"{purpose}.", allow_abbrev=False))
    parser.set_defaults(what=DEFAULT)


def run(args: argparse.Namespace) -> int:
    """Run a benchmark, print its table, and write the JSON. Raises InputError."""
    benchmark = load(args.what)
    choose_device(args.device)
    if getattr(args, "repeats", None) is not None and args.repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, got {args.repeats}")
    if args.json is not None:
        check_output_path(args.json)
    check_outputs((args.json, getattr(args, "plot", None)), _inputs(args))
    result, text = benchmark.run(args)
    result["machine"] = machine(args.device)
    print(machine_line(result["machine"]))
    print(text)
    if args.json is not None:
        write_json(result, args.json)
    return 0


def _inputs(args: argparse.Namespace) -> list:
    """Return the files that the benchmark reads, so that no output overwrites them."""
    several = [path for name in ("scene", "photo") for path in (getattr(args, name, None) or "").split(",") if path]
    return [*several, *(getattr(args, name, None) for name in ("model", "panel", "capture"))]
