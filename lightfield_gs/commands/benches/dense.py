"""`lightfield-gs bench dense`: forward and backward of one camera before many Gaussians."""

from __future__ import annotations

import argparse
from typing import Any

import torch

from lightfield_gs.bench import dense
from lightfield_gs.commands.options import bench as options
from lightfield_gs.commands.options.parser import whole_numbers


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument(
        "--gaussians",
        type=whole_numbers(1, 100_000_000),
        metavar="N",
        help=f"how many, several with commas (default: {_listed(dense.COUNTS['cuda'])}, on the CPU "
        f"{_listed(dense.COUNTS['cpu'])})",
    )
    parser.add_argument(
        "--size",
        type=whole_numbers(16, 16_384, "x", 2),
        metavar="WxH",
        help=f"of the image, px (default: {_listed(dense.SIZES_PX['cuda'], 'x')}, on the CPU "
        f"{_listed(dense.SIZES_PX['cpu'], 'x')})",
    )
    options.add_repeats(parser)
    options.add_machine(parser)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Rows of every number of Gaussians, gsplat's too where it can be had on CUDA, and their text."""
    torch.set_num_threads(options.one_thread_count(args.threads) or torch.get_num_threads())
    counts, size = args.gaussians or dense.COUNTS[args.device], args.size or dense.SIZES_PX[args.device]
    found = dense.rows(counts, size, args.device, args.repeats, options.progress)
    return {"rows": found}, dense.table(found)


def _listed(values: tuple[int, ...], separator: str = ",") -> str:
    return separator.join(map(str, values))
