"""The arguments of `lightfield-gs video`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.options import QUALITY_NAMES, VIEWS
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_messages
from lightfield_gs.commands.options.panel import (
    add_camera,
    add_depth_report,
    add_drawing_device,
    add_look,
    add_panel,
    add_rendering,
)
from lightfield_gs.commands.options.parser import Parser, threads
from lightfield_gs.commands.options.scene import add_scene
from lightfield_gs.commands.options.stereo import add_stereo
from lightfield_gs.commands.options.video import add_motion, add_result


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs video`."""
    parser.description = "Make a video for a 3D display: a turn round a scene, or a film in depth."
    parser.epilog = "The same command continues a stopped folder of frames."
    parser.text.examples = (
        ("video scene.ply -o out.mkv", "a turn in 10 seconds"),
        ("video scene.ply -o out_qs8x6a1.78.mp4", "a quilt of it"),
        ("video photo.jpg -o out.mp4 --kind 2d --sway 4", "for any screen"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "input",
        type=Path,
        metavar="INPUT",
        short="a scene or a photo; a folder of photos or scenes; a video",
        help="a scene or a photo, as `encode` takes it; or a sequence: a folder of photos, of RGB-D pictures or of "
        "numbered scenes, or a video of one of the first two",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="PATH",
        short="a folder for pictures, or .mp4, .mkv, .mov",
        help="a folder for PNG files, or .mp4, .mkv or .mov (pip install 'lightfield-gs[video]')",
    )
    add_motion(add)
    add_result(add)
    add_stereo(add)
    add_panel(add, "for framing")
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    cut_outs = "cut-out of a photo; of a sequence, a folder or a video of cut-outs"
    add_scene(add, "cut the object out of photos with rembg, as `encode` does", cut_outs, "PATH")
    add_drawing_device(add)
    add("--views", choices=VIEWS, default="integer", help="of native pictures, as in `encode` (default integer)")
    add(
        "--quality",
        choices=QUALITY_NAMES,
        default="exact",
        help="of native pictures: less time for more error (default exact)",
    )
    add_rendering(add)
    add("--threads", type=threads, metavar="N", help="number of threads that draw (default: all cores)")
    add_messages(add)
