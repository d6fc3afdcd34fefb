"""`lightfield-gs batch`: many photos, scenes, captures and videos to images for a panel, on all there is to do it."""

from __future__ import annotations

import argparse
import os
import sys
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.provenance import package_versions
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import named
from lightfield_gs.commands.options.encoding import add_encoding
from lightfield_gs.commands.options.parser import read_options, whole
from lightfield_gs.io.atomic import check_folder, remove_left_over

if TYPE_CHECKING:
    from lightfield_gs.batch.dispatch import Crew
    from lightfield_gs.batch.item import Item
    from lightfield_gs.batch.manifest import Manifest
    from lightfield_gs.batch.plan import Plan

EXIT_SOME_FAILED = 1
_MOST_LISTED = 100  # failures, at the end


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs batch`."""
    parser.description = (
        "Encodes all photos and scenes of a folder or a list, fits captures and encodes their scenes, and makes "
        "videos, in one to four processes for each GPU. DIR/batch.jsonl tells what was done; the same command goes on "
        "where it was stopped, however that was, does what failed again, and leaves alone what was done. Options of "
        "`encode` are for all."
    )
    add = parser.add_argument
    add(
        "input",
        type=Path,
        metavar="FOLDER|LIST",
        help="a folder, with those in it, or a text file with a path on each line, or with JSON objects: input, and "
        "where wanted output, command (encode, fit, video), fit_options, and options by their names",
    )
    add("-o", "--output", type=Path, required=True, metavar="DIR", help="the folder of images and of batch.jsonl")
    add(
        "--format",
        choices=("png", "tif", "exr"),
        default="png",
        help="of the images, named as their inputs (default png)",
    )
    add(
        "--processes",
        type=whole(1, 4096),
        metavar="N",
        help="how many (default: 1 to 4 a GPU, one for 8 of its cores, or without one for 4)",
    )
    add("--devices", metavar="cuda:0,...|cpu", help="where they work (default: all GPUs, or the CPU without one)")
    add(
        "--ray",
        metavar="ADDRESS",
        help="processes of a Ray cluster in place of this machine's: auto, HOST:PORT, ray://HOST:PORT, or local for "
        "one of this machine (pip install 'lightfield-gs[ray]'); all machines must see the files under the same paths",
    )
    add("--fit-options", metavar="TEXT", help="options of `fit`, for captures, in quotation marks")
    add("--video-options", metavar="TEXT", help="options of `video`, for videos, in quotation marks")
    add("--overwrite", action="store_true", help="do again what was done")
    add("--check", action="store_true", help="read all inputs and images that were done, and do again what has changed")
    add_encoding(add)


def run(args: argparse.Namespace) -> int:
    """Does what is to be done of args.input into args.output; 1 where some of it failed. Raises InputError."""
    from lightfield_gs.batch.items import read_items
    from lightfield_gs.batch.manifest import Manifest
    from lightfield_gs.batch.plan import make_plan

    setup, options = _setup(args)
    check_folder(args.output)
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
        if not plan.todo:
            print(f"{args.output}: all {plan.kept} items were done before, by {manifest.path}")
            return 0
        with _crew(args, setup, plan) as crew:
            return Batch(args, plan, manifest, options, crew).run()


def _setup(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """What processes are told of all items, and the options that decide what comes out."""
    from lightfield_gs.batch.items import split
    from lightfield_gs.commands.batches.work import Setup, defaults

    usual = {name: value for name, value in defaults("encode").items() if name not in ("input", "output", "threads")}
    given = {name: vars(args)[name] for name in usual if hasattr(args, name) and vars(args)[name] != usual[name]}
    panel = load_panel(read_options(PanelOptions, args)).to_dict()
    with named("--fit-options"):
        fit = split(args.fit_options)
    with named("--video-options"):
        video = split(args.video_options)
    setup = Setup(Path(os.path.abspath(args.output)), Path.cwd(), given, fit, video)
    words = {name: str(value) for name, value in sorted(given.items())}
    return vars(setup), {"all": {"panel": panel, "given": words}, "fit": fit, "video": video}


def _crew(args: argparse.Namespace, setup: dict[str, Any], plan: Plan) -> Any:
    """The processes, no more than there are items."""
    from lightfield_gs.batch.worker import Job

    job = Job("lightfield_gs.commands.batches.work:maker", setup)
    count, have_gpus = len(plan.todo), any(item.is_long for item, _ in plan.todo)
    if args.ray is not None:
        from lightfield_gs.batch.ray_cluster import RayCluster

        return RayCluster(args.ray, job, args.devices, args.processes, args.threads, have_gpus, count)
    from lightfield_gs.batch.places import places_here
    from lightfield_gs.batch.processes import Processes

    return Processes(job, places_here(args.devices, args.processes, args.threads, have_gpus)[:count])


class Batch:
    """One run of a batch: hands out items, writes down how they end, and says so."""

    def __init__(
        self, args: argparse.Namespace, plan: Plan, manifest: Manifest, options: dict[str, Any], crew: Crew
    ) -> None:
        from lightfield_gs.batch.tally import Tally

        self._args, self._plan, self._manifest, self._options, self._crew = args, plan, manifest, options, crew
        self._tally = Tally(crew.places, len(plan.todo))
        self._failures: list[str] = []
        self._run = _now()

    def run(self) -> int:
        """0, or 1 where items failed. Raises InputError where none can be done at all."""
        from lightfield_gs.batch.dispatch import Dispatch

        versions = package_versions()
        places = [place.name for place in self._crew.places]
        self._manifest.append({"run": self._run, "options": self._options, "versions": versions, "places": places})
        dispatch = Dispatch(
            self._plan.todo,
            self._crew,
            ended=self._ended,
            began=self._began,
            ready=self._tally.ready,
            waiting=self._tally.show,
        )
        try:
            dispatch.run()
        finally:
            self._tally.clear()
            self._say()
        if not dispatch.deaths:  # else files may be left over, as of a run that was stopped
            self._manifest.append({"run": self._run, "ended": _now()})
        return EXIT_SOME_FAILED if self._failures else 0

    def _ended(self, item: Item, record: dict[str, Any], worker: int) -> None:
        self._append(item, {**record, "status": "done" if record["status"] == "kept" else record["status"]})
        self._tally.ended(record, worker)
        if record["status"] == "failed":
            self._failures.append(f"{item.input}: {record['reason']}")

    def _began(self, item: Item) -> None:
        """So that a fit or a video goes on where it is if this run ends before it does."""
        self._append(item, {"status": "begun"})

    def _append(self, item: Item, record: dict[str, Any]) -> None:
        words = {"options": item.words} if item.words else {}
        if item.fit_words:
            words["fit_options"] = item.fit_words
        first = {"item": item.name, "status": record["status"], "input": item.input, "command": item.command}
        last = {"job": self._plan.jobs[item.name], "run": self._run, "at": _now()}
        self._manifest.append({**first, **words, **record, **last})

    def _say(self) -> None:
        """What was done, what held it up, and what failed and why."""
        from lightfield_gs.base.checks import counted

        tally, plan = self._tally, self._plan
        total = len(plan.todo) + plan.kept
        print(f"{self._args.output}: {plan.kept + tally.done} of {total} items are done, {plan.kept} of them before")
        if tally.done + tally.failed:
            print("\n".join(tally.summary()), flush=True)
        for words in self._failures[:_MOST_LISTED]:
            print(f"failed: {words}", file=sys.stderr)
        if (more := len(self._failures) - _MOST_LISTED) > 0:
            print(f"failed: and {more} more", file=sys.stderr)
        if self._failures:
            print(
                f"{counted(len(self._failures))} failed; {self._manifest.path} has the reasons, and the same command "
                "tries them again",
                file=sys.stderr,
            )


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")
