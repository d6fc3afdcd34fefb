"""`lightfield-gs bench training-step`: forward and backward of the rasterizer in a training step."""

from __future__ import annotations

import argparse
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import training
from lightfield_gs.commands.options import bench as options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    options.add_repeats(parser)
    options.add_machine(parser, several_threads=True)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """A row for each number of threads, on CUDA one, and gsplat's where it can be had; and their text."""
    if args.device == "cpu":
        found = training.cpu_rows(options.thread_counts(args.threads), args.repeats)
    else:
        found = [training.cuda_row(args.repeats)]
        try:
            found.append(training.gsplat_row(args.repeats))
        except InputError as error:
            options.progress(f"no row of gsplat: {error}")
    return {"rows": found}, training.table(found)
