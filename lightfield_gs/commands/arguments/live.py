"""The arguments of `lightfield-gs live`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.base.options import QUALITY_NAMES, VIEWS
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.eyes import add_eyes
from lightfield_gs.commands.options.groups import in_group, rarely
from lightfield_gs.commands.options.messages import add_quiet
from lightfield_gs.commands.options.panel import add_drawing_device, add_look, add_panel, add_rendering
from lightfield_gs.commands.options.parser import Parser, whole, within
from lightfield_gs.commands.options.scene import add_photo
from lightfield_gs.commands.options.serving import add_serving
from lightfield_gs.commands.options.stereo import add_stereo
from lightfield_gs.commands.options.video import add_codec, add_fps


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs live`."""
    parser.description = "Show a camera, the screen, a stream or a film on the 3D display, while it happens."
    parser.epilog = "A browser or a window shows it on the display. A line a second says how it fares. Ctrl-C ends it."
    parser.text.examples = (
        ("live camera:0 --depth auto", "a camera, whole, in depth"),
        ("live camera:0 --remove-background", "who sits before it, alone"),
        ("live screen:0,0,1280x720 --depth auto", "a part of the screen"),
        ("live rtsp://door/1 --depth auto -o out.mkv", "record it, too"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "source",
        metavar="SOURCE",
        short="camera:0, realsense:, screen:, an address, a video, or a folder that grows",
        help="camera:N or camera:NAME; realsense:, kinect: (of Orbbec) or record3d:, with their depths; screen: or "
        "a part of it, screen:X,Y,WxH; an address, as rtsp://... or http://...; a video, at its own rate; a folder, of "
        "which the newest picture is shown",
    )
    add(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        short="record the display's picture: .mkv, .mp4 or .mov",
        help="record the picture of the panel, without loss: .mkv, .mp4 or .mov, which `show` plays",
    )
    add_codec(add, "of the recording: h264-rgb (default of .mp4 and .mov) or ffv1 (default of .mkv)")
    add(
        "--window",
        action="store_true",
        short="a window on the display in place of the browser",
        help="show it in a window over the display's whole screen in place of the browser: at the screen's own rate, "
        "and from CUDA without a copy through the host (pip install 'lightfield-gs[window]'). Escape or Q ends it",
    )
    add(
        "--virtual-camera",
        metavar="DEVICE",
        short="a camera for calls: both eyes side by side",
        help="write the pictures of two eyes (--stereo, default half-sbs of 1280 x 720) to a virtual camera, for calls "
        "and OBS Studio, in place of the browser: /dev/videoN or a part of its name. Linux, v4l2loopback",
    )
    add = in_group(parser.add_argument, groups.MOTION)
    add("--loop", action="store_true", short="begin a film again at its end", help="begin a video again at its end")
    add(
        "--seconds",
        type=within(0.1, 1e7, "seconds"),
        metavar="S",
        short="end after so many seconds",
        help="end after so many seconds from the first picture (default: at Ctrl-C, or at the end of a film)",
    )
    add_fps(add, "frames a second to hold (default 30)")
    add(
        "--pixels",
        type=whole(10_000, 1_500_000),
        metavar="N",
        help="take so many pixels of each picture at most, 10000..1500000 (default: as many as the panel shows and "
        "hold --fps; a line says when they become fewer)",
    )
    add(
        "--network-px",
        type=whole(14, 2000),
        metavar="N",
        short="pixels that the depth network sees, less for speed",
        help="let the network of --depth auto see so many pixels to the shorter side of each picture, 14..2000 "
        "(default: as many as it was made for, and fewer where they do not hold --fps; a line says when)",
    )
    add(
        "--remember",
        action=argparse.BooleanOptionalAction,
        default=True,
        short="forget what was seen there before behind things",
        help="put behind things in front what was seen there before, while the camera stands still (default: yes)",
    )
    add_panel(parser.add_argument, "for framing")
    add_eyes(parser.add_argument)
    add_look(parser.add_argument)
    add_stereo(rarely(parser.add_argument), "--stereo and --eyes")
    add_photo(parser.add_argument, "cut the object out of each picture with rembg, as `encode` does", has_maps=False)
    add = in_group(parser.add_argument, groups.DRAWING)
    add("--views", choices=VIEWS, default="integer", help="as in `encode` (default integer)")
    add(
        "--quality",
        choices=QUALITY_NAMES,
        help="less time for more error, as `encode`; default: exact, or fast where that does not hold --fps",
    )
    add_rendering(rarely(parser.add_argument))
    add_drawing_device(rarely(parser.add_argument))
    add_serving(parser.add_argument)
    add_quiet(parser.add_argument)
