"""`lightfield-gs bench photo`: a photo through the network to the image."""

from __future__ import annotations

import argparse
from typing import Any

from lightfield_gs.app.photo import detail_given
from lightfield_gs.bench import photo
from lightfield_gs.commands.options import bench as options
from lightfield_gs.commands.options.scene import add_detail


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    options.add_photo(parser, photo.EXAMPLE)
    parser.add_argument(
        "--model",
        help="a checkpoint (.safetensors), or the configuration of an untrained network, a name or .yaml (default: the "
        "checkpoint inside)",
    )
    add_detail(parser.add_argument)
    options.add_panel(parser)
    options.add_repeats(parser)
    options.add_machine(parser, several_threads=True)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Rows of every photo and number of threads, and their text."""
    photos = [str(photo.EXAMPLE)] if args.photo is None else args.photo.split(",")
    options.check_photos(photos)
    threads, detail = options.thread_counts(args.threads), detail_given(args)
    found = photo.rows(photos, args.model, options.panel_of(args), args.device, args.repeats, threads, detail)
    return {"rows": found}, photo.table(found)
