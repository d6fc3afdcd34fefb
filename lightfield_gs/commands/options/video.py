"""Options of `lightfield-gs video`."""

from __future__ import annotations

import argparse
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.options import (
    BRIDGE_URL,
    CODECS,
    COMPRESSIONS,
    DEFAULT_SECONDS,
    MOST_FRAMES,
    PRESET_SIZES,
    VIDEO_KINDS,
)
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group
from lightfield_gs.commands.options.parser import whole, whole_numbers, within
from lightfield_gs.panels.display_kinds import QUILT_NAMES

if TYPE_CHECKING:
    from lightfield_gs.panels.quilt import QuiltLayout

_MOST_SECONDS = 1e5


def add_fps(add: Add, short: str = "frames a second (default 30)") -> None:
    """Add the frames a second of a film."""
    add(
        "--fps",
        type=_rate,
        metavar="RATE",
        short=short,
        help="frames a second, 1..1000, for example 30 or 30000/1001 (default 30)",
    )


def add_codec(add: Add, help: str) -> None:
    """Add the codec of a video."""
    add("--codec", choices=CODECS, help=help)


def add_motion(add: Add) -> None:
    """Add the options of the cameras' motion and of the number of frames."""
    add = in_group(add, groups.MOTION)
    add(
        "--turntable",
        type=within(1e-3, _MOST_SECONDS, "seconds"),
        metavar="SECONDS",
        short="seconds of one turn (default 10)",
        help="the cameras go round the content in the middle of the panel, about the vertical axis, once in "
        f"this time (default {DEFAULT_SECONDS:g} without --path)",
    )
    add(
        "--degrees",
        type=within(-1e6, 1e6, "degrees"),
        metavar="DEG",
        short="angle of the turn or swing (default 360; photos 20)",
        help="of --turntable: 360 or a multiple goes round, to the right if positive; another angle is a swing "
        "of this full angle from the middle to both sides and back (default 360; 20 for photos)",
    )
    add(
        "--path",
        type=Path,
        metavar="FILE",
        help="keyframes of a smooth camera path, in the scene's axes: .yaml or .json with keyframes, a list of "
        "time (seconds) and rig (the name of a rig's file, or its fields)",
    )
    add(
        "--reframe",
        action="store_true",
        help="of a sequence: frame each picture by itself (default: all like the first, so that nothing jumps)",
    )
    add_fps(add)
    add(
        "--frames",
        type=whole(1, MOST_FRAMES),
        metavar="N",
        help="number of frames, in place of seconds; of a sequence: the number of pictures from the first",
    )


def add_result(add: Add) -> None:
    """Add the options of the contents and the storage of a frame."""
    add = in_group(add, groups.STORAGE)
    add(
        "--kind",
        choices=VIDEO_KINDS,
        short="native: for the display; quilt; 2d: of one eye",
        help="native: the picture of the panel, only lossless; quilt: all views side by side, for Looking "
        "Glass; 2d: the picture of one eye (default native, or quilt by the name or --quilt)",
    )
    add(
        "--preset",
        choices=tuple(PRESET_SIZES),
        short="hololuminescent: for an HLD, on white",
        help="a display of ordinary videos. hololuminescent: Looking Glass's HLD, 3840x2160, white around the subject, "
        "9 %% of the height above it and 3 %% below",
    )
    add_codec(
        add,
        "of a video. Lossless, for native: h264-rgb (default of .mp4 and .mov), ffv1 (default of .mkv). "
        "4:2:0, for quilt and 2d: h264 (default), hevc",
    )
    add(
        "--crf",
        type=whole(0, 51),
        default=18,
        metavar="Q",
        help="quality of h264 and hevc: 0..51, less is better (default 18)",
    )
    add(
        "--quilt",
        type=_quilt,
        metavar="PRESET|CxR",
        short="tiles of a quilt: 8x6, or a display as portrait",
        help=f"of --kind quilt: the preset of a Looking Glass device ({', '.join(QUILT_NAMES)}), or columns "
        "and rows of views (default: by the name, else 8x6)",
    )
    add(
        "--quilt-size",
        type=whole_numbers(2, 16384, "x", 2),
        metavar="WIDTHxHEIGHT",
        help="size of the whole quilt, pixels; rounded to even numbers and whole tiles (default: the preset's, "
        "else the largest within 4096x4096)",
    )
    add(
        "--sway",
        type=within(1e-3, _MOST_SECONDS, "seconds"),
        metavar="SECONDS",
        help="of --kind 2d: the eye goes from the middle to the right, to the left and back in this time "
        "(default: it stays in the middle). With --degrees 0 nothing else moves",
    )
    add(
        "--compression",
        choices=COMPRESSIONS,
        default="fast",
        help="of PNG files. fast: quick to write; small: small files (default fast)",
    )
    add(
        "--writers",
        type=whole(1, 256),
        metavar="N",
        help="number of threads that write PNG files (default: one a core, up to 16)",
    )
    add(
        "--overwrite",
        action="store_true",
        help="remove the frames in the folder (default: keep frames of the same job, refuse others)",
    )
    add(
        "--bridge",
        nargs="?",
        const=BRIDGE_URL,
        metavar="URL",
        short="show the quilt by Looking Glass Bridge",
        help=f"show the finished quilt by Looking Glass Bridge (default address {BRIDGE_URL})",
    )


def _quilt(text: str) -> QuiltLayout | tuple[int, ...]:
    """Parse "portrait" to its layout, "8x6" to (8, 6)."""
    from lightfield_gs.panels.quilt import QUILT_PRESETS

    return QUILT_PRESETS[text] if text in QUILT_PRESETS else whole_numbers(1, 1000, "x", 2)(text)


def _rate(text: str) -> Fraction:
    """Parse "30", "29.97" or "30000/1001" to frames a second."""
    try:
        rate = Fraction(text).limit_denominator(1001)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 1 <= rate <= 1000:
        raise argparse.ArgumentTypeError(f"expected frames a second, 1..1000, such as 30 or 30000/1001, got '{text}'")
    return rate
