"""The arguments of `lightfield-gs batch`."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group, rarely
from lightfield_gs.commands.options.messages import add_quiet
from lightfield_gs.commands.options.panel import add_encoding
from lightfield_gs.commands.options.parser import Parser, whole


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs batch`."""
    parser.description = "Encode all photos, scenes and videos of a folder or a list."
    parser.epilog = (
        "Captures are fitted, and their scenes encoded, in one to four processes for each GPU. DIR/batch.jsonl "
        "records the results. After any stop the same command goes on: it leaves finished items alone, and "
        "retries failed ones. Options of `encode` apply to all items."
    )
    parser.text.examples = (
        ("batch photos -o pictures", "all pictures of a folder"),
        ("batch list.txt -o pictures --panel 27", "the files that a list names"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "input",
        type=Path,
        metavar="FOLDER|LIST",
        short="a folder, or a text file with a path on each line",
        help="a folder of inputs; or a text file with a path or a JSON object on each line. Keys of an object: "
        "input, and optionally output, command (encode, fit, video), fit_options, and options by their "
        "names",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        short="folder of the pictures and of batch.jsonl",
        help="the folder of images and of batch.jsonl",
    )
    add(
        "--format",
        choices=("png", "tif", "exr"),
        default="png",
        short="of the pictures: png, tif or exr",
        help="format of the images, which are named as their inputs (default png)",
    )
    add(
        "--processes",
        type=whole(1, 4096),
        metavar="N",
        short="how many work side by side",
        help="number of processes (default: 1 to 4 a GPU, one for 8 of its cores; without a GPU one for 4 cores)",
    )
    add(
        "--devices",
        metavar="cuda:0,...|cpu",
        short="cuda:0,cuda:1 or cpu (default: all)",
        help="devices of the processes (default: all GPUs, or the CPU without one)",
    )
    add(
        "--shard",
        type=_shard,
        metavar="I/N",
        help="take every N-th item from the I-th on, in one process: for GNU parallel, Slurm and Ray, which "
        "place the N processes on GPUs and machines. All must see the files under the same paths",
    )
    add("--fit-options", metavar="TEXT", help="options of `fit`, for captures, in quotation marks")
    add("--video-options", metavar="TEXT", help="options of `video`, for videos, in quotation marks")
    add("--overwrite", action="store_true", short="repeat what is finished", help="repeat finished items")
    add(
        "--check",
        action="store_true",
        short="look for changed files, and repeat them",
        help="read all inputs and images of finished items, and repeat items that have changed",
    )
    add_encoding(rarely(add))
    add_quiet(add)


def _shard(text: str) -> tuple[int, int]:
    """Parse "2/8"."""
    match = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"expected I/N, such as 1/8 to 8/8, got '{text}'")
    return int(match[1]), int(match[2])
