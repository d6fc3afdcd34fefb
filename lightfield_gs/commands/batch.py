"""`lightfield-gs batch`: many photos, scenes, captures and videos to images for a panel, on all there is to do it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from lightfield_gs.app.panel import load_panel, package_versions
from lightfield_gs.base.cli_messages import EXIT_INTERRUPTED, note, report_error
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.items import Item, read_items
from lightfield_gs.batch.manifest import Manifest, Plan, make_plan
from lightfield_gs.batch.run import Run, Worker
from lightfield_gs.batch.shards import Shard, choose_workers, run_shards
from lightfield_gs.commands.batch_tasks import BatchOptions, load, read_batch_options
from lightfield_gs.io.atomic import check_folder, remove_left_over

EXIT_SOME_FAILED = 1


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
