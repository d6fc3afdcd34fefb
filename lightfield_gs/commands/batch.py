"""`lightfield-gs batch`: many photos, scenes, captures and videos to images for a panel, on all there is to do it."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.provenance import package_versions
from lightfield_gs.base.cli_messages import EXIT_INTERRUPTED, note, report_error
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.commands.options.encoding import add_encoding
from lightfield_gs.commands.options.parser import read_options, whole
from lightfield_gs.io.atomic import check_folder, remove_left_over

if TYPE_CHECKING:
    from lightfield_gs.batch.manifest import Manifest, Plan
    from lightfield_gs.batch.run import Worker
    from lightfield_gs.commands.batch_tasks import Setup

EXIT_SOME_FAILED = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs batch`."""
    parser.description = (
        "Encode all photos and scenes of a folder or a list, fit captures and encode their scenes, and "
        "make videos, in one to four processes for each GPU. DIR/batch.jsonl records the results. After "
        "any stop the same command goes on: it leaves finished items alone, and retries failed ones. "
        "Options of `encode` apply to all items."
    )
    add = parser.add_argument
    add(
        "input",
        type=Path,
        metavar="FOLDER|LIST",
        help="a folder of inputs; or a text file with a path or a JSON object on each line. Keys of an object: "
        "input, and optionally output, command (encode, fit, video), fit_options, and options by their "
        "names",
    )
    add("-o", "--output", type=Path, required=True, metavar="DIR", help="the folder of images and of batch.jsonl")
    add(
        "--format",
        choices=("png", "tif", "exr"),
        default="png",
        help="format of the images, which are named as their inputs (default png)",
    )
    add(
        "--processes",
        type=whole(1, 4096),
        metavar="N",
        help="number of processes (default: 1 to 4 a GPU, one for 8 of its cores; without a GPU one for 4 cores)",
    )
    add(
        "--devices",
        metavar="cuda:0,...|cpu",
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
    add("--overwrite", action="store_true", help="repeat finished items")
    add(
        "--check",
        action="store_true",
        help="read all inputs and images of finished items, and repeat items that have changed",
    )
    add_encoding(add)


def run(args: argparse.Namespace) -> int:
    """Run the unfinished items of args.input; return 1 if an item failed. Raises InputError."""
    from lightfield_gs.batch.items import read_items
    from lightfield_gs.batch.manifest import Manifest, make_plan
    from lightfield_gs.batch.run import now
    from lightfield_gs.batch.shards import choose_workers, run_shards

    setup, options = _setup(args)
    check_folder(args.output)
    args.since = now()
    if args.shard is not None:
        if args.processes is not None or args.devices not in (None, "cpu"):
            raise InputError(
                "--shard is one process, on the GPU of CUDA_VISIBLE_DEVICES; leave out --processes and --devices"
            )
        (worker,) = choose_workers(args.devices, 1, args.threads)
        worker = replace(worker, name="{} shard {}/{}".format(worker.device, *args.shard))
        return _without_waiting(partial(run_shard, args, args.shard, worker))
    items, left = read_items(args.input, f".{args.format}", args.output, with_maps=args.depth is None)
    if args.input.is_dir() and (paired := [item for item in items if item.words]):
        first = f"{paired[0].input} with {paired[0].words[0].partition('=')[2]}"
        note(f"{args.input}: {len(paired)} photos or videos are taken with the depth maps beside them, as {first}")
    if left:
        kinds = ", ".join(f"{count} {end}" for end, count in left.most_common(8))
        note(f"{args.input}: left out, for they are no photos, scenes or videos: {kinds}")
    with Manifest(args.output) as manifest:
        if manifest.damaged:
            note(f"{manifest.path}: {manifest.damaged} damaged lines; what they told of is done again")
        if manifest.is_unfinished:
            remove_left_over(args.output)
        plan = make_plan(items, manifest, options, overwrite=args.overwrite, check=args.check)
        if not plan.todo and not plan.failed:
            print(f"{args.output}: all {plan.kept} items were done before, by {manifest.path}")
            return 0
        have_gpus = any(item.is_long for item, _ in plan.todo)
        workers = choose_workers(args.devices, args.processes, args.threads, have_gpus)[: len(plan.todo) or 1]
        if len(workers) == 1:
            return _without_waiting(partial(_do, plan, manifest, workers[0], setup, options))
    return run_shards(run_shard, args, workers, args.output)


def run_shard(args: argparse.Namespace, shard: tuple[int, int], worker: Worker) -> int:
    """Run every N-th item in this process; return 1 if an item failed. Raises InputError."""
    from lightfield_gs.batch.items import read_items
    from lightfield_gs.batch.manifest import Manifest, make_plan

    setup, options = _setup(args)
    items, _ = read_items(args.input, f".{args.format}", args.output, with_maps=args.depth is None)
    with Manifest(args.output, shard) as manifest:
        some = items[shard[0] - 1 :: shard[1]]
        plan = make_plan(some, manifest, options, overwrite=args.overwrite, check=args.check, since=args.since)
        return _do(plan, manifest, worker, setup, options)


def _do(plan: Plan, manifest: Manifest, worker: Worker, setup: Setup, options: dict[str, Any]) -> int:
    from lightfield_gs.batch.run import Run
    from lightfield_gs.commands.batch_tasks import load

    heading = {"options": options, "versions": package_versions()}
    failures = Run(plan, manifest, worker, heading).run(partial(load, setup, worker))
    return EXIT_SOME_FAILED if failures else 0


def _without_waiting(call: Callable[[], int]) -> int:
    """Return what `call` returns; end the process at once if it is interrupted, while threads are at work."""
    try:
        return call()
    except (KeyboardInterrupt, SystemExit) as error:
        report_error("lightfield-gs", KeyboardInterrupt(), "")
        sys.stdout.flush()
        os._exit(error.code if isinstance(error, SystemExit) and isinstance(error.code, int) else EXIT_INTERRUPTED)


def _setup(args: argparse.Namespace) -> tuple[Setup, dict[str, Any]]:
    """Return the resources of all tasks, and the options that affect the outputs."""
    from lightfield_gs.batch.items import split
    from lightfield_gs.commands.batch_tasks import Setup, defaults

    usual = {name: value for name, value in defaults("encode").items() if name not in ("input", "output", "threads")}
    given = {name: vars(args)[name] for name in usual if hasattr(args, name) and vars(args)[name] != usual[name]}
    with named("--fit-options"):
        fit = split(args.fit_options)
    with named("--video-options"):
        video = split(args.video_options)
    words = {name: str(value) for name, value in sorted(given.items())}
    options = {
        "all": {"panel": load_panel(read_options(PanelOptions, args)).to_dict(), "given": words},
        "fit": fit,
        "video": video,
    }
    return Setup(Path(os.path.abspath(args.output)), given, fit, video), options


def _shard(text: str) -> tuple[int, int]:
    """Parse "2/8"."""
    match = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"expected I/N, such as 1/8 to 8/8, got '{text}'")
    return int(match[1]), int(match[2])
