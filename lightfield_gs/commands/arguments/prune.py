"""The arguments of `lightfield-gs prune`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.options import DEVICES
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_messages
from lightfield_gs.commands.options.panel import add_camera, add_filters, add_look, add_panel
from lightfield_gs.commands.options.parser import Parser, within
from lightfield_gs.commands.options.scene import SAVED_FORMATS, SCENE_FORMATS, SCENES, add_reading


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs prune`."""
    parser.description = "Make a scene smaller: leave out what hardly shows on a display."
    parser.epilog = (
        "The contribution of each Gaussian counts from all viewpoints of the panel. The scene is then faster to draw."
    )
    parser.text.examples = (
        ("prune scene.ply -o small.ply", "for the connected display"),
        ("prune scene.ply -o small.spz --panel 27", "for a Looking Glass 27"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add("input", type=Path, metavar="INPUT", short=SCENES, help=f"a file of Gaussians: {SCENE_FORMATS}")
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="SCENE",
        short="the smaller scene: .ply, .glb, .usd, .spz or .splat",
        help=f"the pruned scene: {SAVED_FORMATS}",
    )
    add_reading(add)
    add(
        "--contribution-cut",
        type=within(0, 1),
        default=3e-4,
        metavar="FRACTION",
        short="0..1: allowed mean error (default 3e-4)",
        help="0..1, allowed mean error of colours in 0..1 (default 3e-4: 50 dB and more)",
    )
    add_filters(add)
    add_panel(add, "for framing, as `encode` takes it")
    add_camera(add)
    add_look(add)
    add(
        "--save-rig",
        type=Path,
        metavar="YAML",
        help="write the rig of the unpruned scene; automatic framing of a pruned scene may differ",
    )
    add("--device", choices=DEVICES, default="auto", help="device that draws the scene (default auto)")
    add_messages(add)
