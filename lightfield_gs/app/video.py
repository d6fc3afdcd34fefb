"""Where the frames of a video go: which file, of what kind, by which codec."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import check_folder, check_output_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout, stated_layout, with_suffix
from lightfield_gs.video.video_file import VIDEO_SUFFIXES, CodecName, Kind, choose_codec

DEFAULT_FPS, DEFAULT_SECONDS = Fraction(30), 10.0
_MOST_SIDE_PX = 4096  # of a quilt where no size is said: more than that many decoders of H.264 do not take


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
