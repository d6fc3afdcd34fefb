"""The arguments that `prune` and `simplify` have in common."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from lightfield_gs.base.options import DEVICES
from lightfield_gs.commands.options.messages import add_messages
from lightfield_gs.commands.options.panel import add_camera, add_filters, add_look, add_panel
from lightfield_gs.commands.options.scene import SAVED_FORMATS, SCENE_FORMATS, SCENES, add_reading


def add_scenes(add: Callable[..., Any]) -> None:
    """Add the scene that is read, and the smaller one."""
    add("input", type=Path, metavar="INPUT", short=SCENES, help=f"a file of Gaussians: {SCENE_FORMATS}")
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="SCENE",
        short="the smaller scene: .ply, .glb, .usd, .spz or .splat",
        help=f"the smaller scene: {SAVED_FORMATS}",
    )
    add_reading(add)


def add_drawing(add: Callable[..., Any]) -> None:
    """Add what the scene is drawn by."""
    add_filters(add)
    add_panel(add, "for framing, as `encode` takes it")
    add_camera(add)
    add_look(add)
    add(
        "--save-rig",
        type=Path,
        metavar="YAML",
        help="write the rig of the whole scene; automatic framing of the smaller one may differ",
    )
    add("--device", choices=DEVICES, default="auto", help="device that draws the scene (default auto)")
    add_messages(add)
