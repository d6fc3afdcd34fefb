"""`--depth auto`: the depth of a photo that comes without, estimated by a network."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.options import DEPTH_MODEL

if TYPE_CHECKING:
    from lightfield_gs.photo.depth import DepthMap
    from lightfield_gs.photo.load import Photo

AUTO = Path("auto")  # in place of the file of --depth


def add_depth_model(add: Callable[..., argparse.Action]) -> None:
    add(
        "--depth-model",
        metavar="NAME|FOLDER",
        help="the network of --depth auto: its name on huggingface.co, or a folder with its files (default "
        f"{DEPTH_MODEL})",
    )


def is_estimated(args: argparse.Namespace) -> bool:
    """Whether the depth of the photo is estimated by a network."""
    return args.depth == AUTO


def depth_file(args: argparse.Namespace) -> Path | None:
    """The file of --depth, where it is one."""
    return None if is_estimated(args) else args.depth


def depth_model(args: argparse.Namespace) -> str:
    """The network of --depth auto."""
    return args.depth_model or DEPTH_MODEL


def depth_by_network(args: argparse.Namespace, photo: Photo, device: str) -> DepthMap:
    """The depth map of --depth auto. Raises InputError."""
    from lightfield_gs.photo.depth_network import estimated_depth

    return estimated_depth(
        photo.floats(),
        depth_model(args),
        "cuda" if device == "cuda" else "cpu",
        kind=args.depth_kind,
        limits=args.depth_range,
        say=lambda words: print(words, flush=True),
    )
