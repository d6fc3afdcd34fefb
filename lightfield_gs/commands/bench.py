"""`lightfield-gs bench`: measure speed and accuracy."""

from __future__ import annotations

import argparse

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench.benchmarks import load
from lightfield_gs.bench.options import BenchmarkOptions
from lightfield_gs.bench.timing import machine, machine_line
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_output_path, check_outputs
from lightfield_gs.io.text_files import write_json


def run(args: argparse.Namespace) -> int:
    """Run a benchmark, print its table, and write the JSON. Raises InputError."""
    benchmark = load(args.what)
    options: BenchmarkOptions = read_options(benchmark.Options, args)
    choose_device(options.device)
    if options.repeats is not None and options.repeats < 1:
        raise InputError(f"--repeats: expected 1 or more, got {options.repeats}")
    if options.json is not None:
        check_output_path(options.json)
    check_outputs((options.json, getattr(options, "plot", None)), _inputs(options))
    result, text = benchmark.run(options)
    result["machine"] = machine(options.device)
    print(machine_line(result["machine"]))
    print(text)
    if options.json is not None:
        write_json(result, options.json)
    return 0


def _inputs(options: BenchmarkOptions) -> list:
    """Return the files that the benchmark reads, so that no output overwrites them."""
    texts = [getattr(options, name, None) or "" for name in ("scene", "photo")]
    several = [path for text in texts for path in text.split(",") if path]
    return [
        *several,
        *(getattr(options, name, None) for name in ("model", "panel", "protocol")),
        *getattr(options, "captures", ()),
    ]
