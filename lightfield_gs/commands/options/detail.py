"""How finely the photo of an object is laid over what the network makes of it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from lightfield_gs.base.options import DETAILS, Detail

if TYPE_CHECKING:
    from lightfield_gs.models.config import ModelConfig
    from lightfield_gs.models.detail import DetailLevel


def add_detail(add: Callable[..., argparse.Action]) -> None:
    """How finely the photo of an object is laid over what the network makes of it."""
    add(
        "--detail",
        type=lambda text: int(text) if text.isdecimal() else text,
        choices=(*DETAILS, "none"),
        help="resolution of the photo on the object: 1, 2 or 4 times the network's, none for the network's own soft "
        "colours, or auto, what a view of the panel can show (default auto)",
    )
    add("--detail-budget", type=int, metavar="N", help="Gaussians at most for --detail auto (default 1500000)")


def detail_given(args: argparse.Namespace) -> tuple[Detail | None, int]:
    """Return the detail and the budget of detail_level, by the options."""
    from lightfield_gs.photo.detail_level import DEFAULT_BUDGET

    detail: Detail | None = None if args.detail == "none" else args.detail or "auto"
    return detail, DEFAULT_BUDGET if args.detail_budget is None else args.detail_budget


def detail_words(level: DetailLevel | None, config: ModelConfig) -> str:
    """What was decided, in words."""
    if level is None:
        return "detail none: the network's own Gaussians"
    side = level.factor * config.image_size_px
    return f"detail {level.factor}: the object's square at {side} x {side} px"
