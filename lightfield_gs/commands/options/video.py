"""The options of `lightfield-gs video`, and what they say together: which file, of what kind, by which codec."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import COMPRESSIONS
from lightfield_gs.commands.options.values import whole, whole_numbers, within
from lightfield_gs.io.atomic import check_folder, check_output_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QUILT_PRESETS, QuiltLayout, stated_layout, with_suffix
from lightfield_gs.show.bridge import BRIDGE_URL
from lightfield_gs.video.camera_path import MOST_FRAMES
from lightfield_gs.video.video_file import CODECS, KINDS, VIDEO_SUFFIXES, CodecName, Kind, choose_codec

DEFAULT_FPS, DEFAULT_SECONDS = Fraction(30), 10.0
_MOST_SIDE_PX = 4096  # of a quilt where no size is said: more than that many decoders of H.264 do not take
_MOST_SECONDS = 1e5


def add_motion(add: Callable[..., argparse.Action]) -> None:
    """How the cameras move, and how many frames there are."""
    add(
        "--turntable",
        type=within(1e-3, _MOST_SECONDS, "seconds"),
        metavar="SECONDS",
        help="the cameras go round what the middle of the panel shows, once in so many seconds, about the vertical "
        f"axis (default {DEFAULT_SECONDS:g} where there is no --path)",
    )
    add(
        "--degrees",
        type=within(-1e6, 1e6, "degrees"),
        metavar="DEG",
        help="of --turntable: 360 or a multiple goes on round, to the right where positive; another angle is a swing "
        "by that much in all, from the middle to both sides and back (default 360; 20 for photos)",
    )
    add(
        "--path",
        type=Path,
        metavar="FILE",
        help="keyframes that the cameras go through smoothly, in the scene's axes: .yaml or .json with keyframes, a "
        "list of time (seconds) and rig (the name of a rig's file, or its fields)",
    )
    add(
        "--reframe",
        action="store_true",
        help="of a sequence: each picture is framed by itself (default: all as the first, so that nothing jumps)",
    )
    add("--fps", type=_rate, metavar="RATE", help="frames a second, 1..1000, for example 30 or 30000/1001 (default 30)")
    add(
        "--frames",
        type=whole(1, MOST_FRAMES),
        metavar="N",
        help="number of frames, in place of seconds; of a sequence, the first so many",
    )


def add_result(add: Callable[..., argparse.Action]) -> None:
    """What is drawn, and how it is stored."""
    add(
        "--kind",
        choices=KINDS,
        help="native: the picture of the panel, only lossless; quilt: all views side by side, for Looking Glass; 2d: "
        "what one eye sees (default native, or quilt where the name or --quilt says so)",
    )
    add(
        "--codec",
        choices=CODECS,
        help="of a video. Lossless, for native: h264-rgb (default of .mp4 and .mov), ffv1 (default of .mkv). 4:2:0, "
        "for quilt and 2d: h264 (default), hevc",
    )
    add(
        "--crf", type=whole(0, 51), default=18, metavar="Q", help="of h264 and hevc: 0..51, less is better (default 18)"
    )
    add(
        "--quilt",
        type=_quilt,
        metavar="PRESET|CxR",
        help=f"of --kind quilt: what Looking Glass has for a device ({', '.join(QUILT_PRESETS)}), or columns and rows "
        "of views (default: what the name says, else 8x6)",
    )
    add(
        "--quilt-size",
        type=whole_numbers(2, 16384, "x", 2),
        metavar="WIDTHxHEIGHT",
        help="of the whole quilt, pixels; made even, and whole tiles (default: the preset's, else as large as fits "
        "into 4096x4096)",
    )
    add(
        "--sway",
        type=within(1e-3, _MOST_SECONDS, "seconds"),
        metavar="SECONDS",
        help="of --kind 2d: the eye goes from the middle to the right, to the left and back in so many (default: it "
        "stays in the middle; with --degrees 0 nothing else moves)",
    )
    add("--compression", choices=COMPRESSIONS, default="fast", help="of PNG files: quick to write, or small")
    add(
        "--writers",
        type=whole(1, 256),
        metavar="N",
        help="threads that write PNG files (default: one a core, up to 16)",
    )
    add(
        "--overwrite",
        action="store_true",
        help="remove frames that are in the folder (default: those of the same job are kept, others refused)",
    )
    add(
        "--bridge",
        nargs="?",
        const=BRIDGE_URL,
        metavar="URL",
        help=f"have Looking Glass Bridge show the quilt when it is done (default address {BRIDGE_URL})",
    )


@dataclass(frozen=True)
class Result:
    """Where the frames go. codec: None for a folder of PNG files. layout: of a quilt, with its size."""

    path: Path
    kind: Kind
    codec: CodecName | None
    layout: QuiltLayout | None


def checked_result(args: argparse.Namespace, panel: Panel) -> Result:
    """What the options say of the result. Raises InputError where they do not go together, or it cannot be written."""
    path: Path = args.output
    stated = stated_layout(path)
    kind: Kind = args.kind or ("quilt" if args.quilt or args.quilt_size or stated else "native")
    if args.kind is None and args.sway is not None:
        kind = "2d"
    _refuse(args, kind)
    layout = _layout(args, panel, stated) if kind == "quilt" else None
    if not path.suffix or path.is_dir():
        if args.codec is not None:
            raise InputError(f"--codec is of videos, and {path} is a folder of PNG files; leave out one of them")
        return Result(check_folder(path), kind, None, layout)
    codec = choose_codec(path, kind, args.codec)
    if args.overwrite:
        raise InputError("--overwrite is about folders of frames; a video is written anew in any case, leave it out")
    return Result(check_output_path(path if layout is None else with_suffix(path, layout)), kind, codec, layout)


def _layout(args: argparse.Namespace, panel: Panel, stated: QuiltLayout | None) -> QuiltLayout:
    """The layout of a quilt with its size: even sides, which 4:2:0 needs, and tiles that fill it. Raises InputError."""
    aspect = stated.aspect if stated is not None else panel.width_px / panel.height_px
    base = args.quilt or stated or QuiltLayout(8, 6, aspect)  # as many as Looking Glass Portrait
    if not isinstance(base, QuiltLayout):
        base = QuiltLayout(base[0], base[1], aspect)
    width, height = args.quilt_size or (base.width_px, base.height_px)
    if width is None or height is None:
        across = min(_MOST_SIDE_PX // base.columns, int(_MOST_SIDE_PX // base.rows * base.aspect))
        width, height = across * base.columns, round(across / base.aspect) * base.rows
    sides = [_filled(side, tiles) for side, tiles in ((width, base.columns), (height, base.rows))]
    if min(sides) < 1:
        raise InputError(f"--quilt-size: {width} x {height} pixels are too few for {base.columns} x {base.rows} views")
    return replace(base, width_px=sides[0], height_px=sides[1])


def _filled(side_px: int, tiles: int) -> int:
    """The largest even multiple of the number of tiles up to a side."""
    each = side_px // tiles
    return tiles * (each - each * tiles % 2)


def _quilt(text: str) -> QuiltLayout | tuple[int, ...]:
    """ "portrait" -> its layout; "8x6" -> (8, 6)."""
    return QUILT_PRESETS[text] if text in QUILT_PRESETS else whole_numbers(1, 1000, "x", 2)(text)


def _refuse(args: argparse.Namespace, kind: Kind) -> None:
    """Raises InputError for options of another kind, and for those that take each other's place."""
    for name, of in (("quilt", "quilt"), ("quilt_size", "quilt"), ("bridge", "quilt"), ("sway", "2d")):
        if getattr(args, name) is not None and kind != of:
            raise InputError(f"--{name.replace('_', '-')} is for --kind {of}, not {kind}; leave out one of them")
    if args.bridge is not None and args.output.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(f"--bridge shows one file, and {args.output} is a folder; give a name that ends in .mp4")
    of_path = (("path", name) for name in ("turntable", "degrees", "rig", "camera", "up"))
    for one, other in (*of_path, ("turntable", "frames")):
        if getattr(args, one) is not None and getattr(args, other) is not None:
            raise InputError(f"--{one} and --{other} take each other's place; leave out one of them")


def _rate(text: str) -> Fraction:
    """ "30", "29.97" or "30000/1001" -> frames a second."""
    try:
        rate = Fraction(text).limit_denominator(1001)
    except (ValueError, ZeroDivisionError):
        rate = Fraction(0)
    if not 1 <= rate <= 1000:
        raise argparse.ArgumentTypeError(f"expected frames a second, 1..1000, such as 30 or 30000/1001, got '{text}'")
    return rate
