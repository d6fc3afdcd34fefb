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
from typing import Any

from lightfield_gs.app.panel import load_panel, package_versions
from lightfield_gs.base.cli_messages import EXIT_INTERRUPTED, note, report_error
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.items import Item, read_items
from lightfield_gs.batch.manifest import Manifest, Plan, make_plan
from lightfield_gs.batch.run import Run, Worker
from lightfield_gs.batch.shards import Shard, choose_workers, run_shards
from lightfield_gs.commands.batch_tasks import BatchOptions, load, read_batch_options
from lightfield_gs.commands.options.panel import add_encoding
from lightfield_gs.commands.options.parser import whole
from lightfield_gs.io.atomic import check_folder, remove_left_over

EXIT_SOME_FAILED = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `lightfield-gs batch`."""
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
    options = read_batch_options(args)
    job = _job_options(options)
    check_folder(options.output)
    if options.shard is not None:
        if options.processes is not None or options.devices not in (None, "cpu"):
            raise InputError(
                "--shard is one process, on the GPU of CUDA_VISIBLE_DEVICES; leave out --processes and --devices"
            )
        (worker,) = choose_workers(options.devices, 1, options.threads)
        worker = replace(worker, name="{} shard {}/{}".format(worker.device, *options.shard))
        return _without_waiting(partial(run_shard, options, options.shard, worker))
    items = _read_items(options, with_notes=True)
    with Manifest(options.output) as manifest:
        if manifest.damaged:
            note(f"{manifest.path}: {manifest.damaged} damaged lines; what they told of is done again")
        if manifest.is_unfinished:
            remove_left_over(options.output)
        plan = make_plan(items, manifest, job, overwrite=options.overwrite, check=options.check)
        if not plan.todo and not plan.failed:
            print(f"{options.output}: all {plan.kept} items were done before, by {manifest.path}")
            return 0
        have_gpus = any(item.is_long for item, _ in plan.todo)
        workers = choose_workers(options.devices, options.processes, options.threads, have_gpus)
        workers = workers[: len(plan.todo) or 1]
        if len(workers) == 1:
            return _without_waiting(partial(_do, plan, manifest, workers[0], options, job))
    return run_shards(run_shard, options, workers, options.output)


def run_shard(options: BatchOptions, shard: Shard, worker: Worker) -> int:
    """Run every N-th item in this process; return 1 if an item failed. Raises InputError."""
    job = _job_options(options)
    items = _read_items(options)[shard[0] - 1 :: shard[1]]
    with Manifest(options.output, shard) as manifest:
        plan = make_plan(items, manifest, job, overwrite=options.overwrite, check=options.check, since=options.since)
        return _do(plan, manifest, worker, options, job)


def _do(plan: Plan, manifest: Manifest, worker: Worker, options: BatchOptions, job: dict[str, Any]) -> int:
    heading = {"options": job, "versions": package_versions()}
    failures = Run(plan, manifest, worker, heading).run(partial(load, options, worker))
    return EXIT_SOME_FAILED if failures else 0


def _read_items(options: BatchOptions, with_notes: bool = False) -> list[Item]:
    """Return all items; with notes on depth maps and on files that are left out."""
    source = options.input
    items, left = read_items(source, f".{options.format}", options.output, with_maps="depth" not in options.given)
    if with_notes and source.is_dir() and (paired := [item for item in items if item.words]):
        first = f"{paired[0].input} with {paired[0].words[0].partition('=')[2]}"
        note(f"{source}: {len(paired)} photos or videos are taken with the depth maps beside them, as {first}")
    if with_notes and left:
        kinds = ", ".join(f"{count} {end}" for end, count in left.most_common(8))
        note(f"{source}: left out, for they are no photos, scenes or videos: {kinds}")
    return items


def _job_options(options: BatchOptions) -> dict[str, Any]:
    """Return the options that decide the outputs, as the manifest has them."""
    given = {name: str(value) for name, value in sorted(options.given.items())}
    everything = {"panel": load_panel(options.panel).to_dict(), "given": given}
    return {"all": everything, "fit": options.fit_options, "video": options.video_options}


def _without_waiting(call: Callable[[], int]) -> int:
    """Return what `call` returns; end the process at once if it is interrupted, while threads are at work."""
    try:
        return call()
    except (KeyboardInterrupt, SystemExit) as error:
        report_error("lightfield-gs", KeyboardInterrupt(), "")
        sys.stdout.flush()
        os._exit(error.code if isinstance(error, SystemExit) and isinstance(error.code, int) else EXIT_INTERRUPTED)


def _shard(text: str) -> Shard:
    """Parse "2/8"."""
    match = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"expected I/N, such as 1/8 to 8/8, got '{text}'")
    return int(match[1]), int(match[2])
