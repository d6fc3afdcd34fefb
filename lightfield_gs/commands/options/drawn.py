"""How a command draws a scene, by its options, or else by what the scene's file says of its fit."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from lightfield_gs.base.errors import named
from lightfield_gs.commands.options.values import background, within
from lightfield_gs.scene.fitted import rgb, stated_fit, trained_antialiased

if TYPE_CHECKING:
    from lightfield_gs.scene.files import SceneFile

_WHITE = (1.0, 1.0, 1.0)


def add_antialiased(add: Callable[..., argparse.Action]) -> None:
    add(
        "--antialiased",
        action=argparse.BooleanOptionalAction,
        help="for scenes trained with anti-aliasing (Mip-Splatting, gsplat's antialiased mode), which look too bright "
        "and too thick without: what a pixel blurs becomes fainter by as much (default: as the file says that "
        "it was trained, else without)",
    )


def add_view_filter(add: Callable[..., argparse.Action]) -> None:
    add(
        "--view-filter",
        type=within(0, 65536, "views"),
        default=0.0,
        metavar="VIEWS",
        help="anti-aliasing between views, of a rig: each sub-pixel's picture is averaged over camera positions this "
        "many views wide, so that what lies far before or behind the panel is blurred in place of seen double; 0: off, "
        "1: the width of a view (default 0)",
    )


def add_background(add: Callable[..., argparse.Action]) -> None:
    add(
        "--background",
        type=background,
        metavar="R,G,B",
        help="0..1 each (default: what the file says that lightfield-gs fitted it before, else 1,1,1)",
    )


def settle_drawing(args: argparse.Namespace, file: SceneFile | None) -> list[str]:
    """Sets those of args.antialiased and args.background that the command has and that nobody gave; lines on what was
    taken from the file. file: None for a photo. Raises InputError where the file's word on its fit cannot be read."""
    open_ones = [name for name in ("antialiased", "background") if getattr(args, name, ()) is None]
    comments = file.comments if file is not None and open_ones else ()
    with named(args.input):
        fitted, trained = stated_fit(comments), trained_antialiased(comments)
    messages = []
    if "antialiased" in open_ones:
        args.antialiased = trained is not None
        if args.antialiased:
            messages.append(
                f"drawn with anti-aliasing: the file says that it was {trained} so (without: --no-antialiased)"
            )
    if "background" in open_ones:
        args.background = (fitted and fitted.background) or _WHITE
        if fitted is not None and fitted.background is not None:
            messages.append(f"background: {rgb(fitted.background)}, which the scene was fitted before (--background)")
    return messages
