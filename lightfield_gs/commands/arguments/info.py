"""The arguments of `lightfield-gs info`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group, rarely
from lightfield_gs.commands.options.panel import add_device_serial, add_up
from lightfield_gs.commands.options.parser import Parser
from lightfield_gs.commands.options.scene import SCENE_FORMATS, add_reading


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs info`."""
    parser.description = "Say what is in a file: a scene, a picture, a display's calibration."
    parser.text.examples = (
        ("info scene.ply", "size, axes and cameras of a scene"),
        ("info out.png", "which display a picture is for"),
        ("info visual.json", "a calibration"),
        ("info --devices", "what can draw on this computer"),
        ("info --devices --report", "the same with all that an issue on a GPU needs"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "file",
        type=Path,
        nargs="?",
        metavar="FILE",
        short="a scene, a picture, a .yaml, visual.json, a display",
        help=f"a file of Gaussians ({SCENE_FORMATS}), an image, a panel or "
        "rig (.yaml, visual.json, panel name) or a .safetensors file",
    )
    add(
        "--devices",
        action="store_true",
        short="what --device can name on this computer",
        help="in place of a file: what --device can name here, and whether each adapter of WebGPU draws what the CPU "
        "draws, and how fast",
    )
    add(
        "--report",
        action="store_true",
        short="with --devices: what to paste into an issue on a GPU",
        help="with --devices: also the limits and features of each adapter of WebGPU, and the times of a frame, stage "
        "by stage, for an issue on a GPU that was not tried",
    )
    for add_more in (add_device_serial, add_reading, add_up):
        add_more(rarely(add))
