"""`lightfield-gs simulate`: what an eye sees of an encoded image."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import cast

from lightfield_gs.app.panel import at_distance, load_panel, profile, stored_panel, why_no_eye
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.panel import add_device_serial, add_viewing_distance
from lightfield_gs.commands.options.parser import numbers, within
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, read_image, read_info, write_image
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import Psf, eye_row, simulate_eyes

_NOT_OF_THE_LENS = ("name", "viewing_distance_mm", "pixel_pitch_mm")  # what sub-pixels show does not hang on them


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs simulate`."""
    parser.description = "The picture that an eye sees of an encoded image through the lenses, one sample a lens."
    add = parser.add_argument
    add("image", type=Path, metavar="IMAGE", help="an encoded image, as `encode` writes it")
    add("--panel", metavar="PANEL", help="name, .yaml or visual.json (default: the profile stored in the image)")
    add_device_serial(add)
    add_viewing_distance(add, "distance from which the panel shows one view all over, in place of the panel's own")
    add(
        "--eye",
        type=numbers(3),
        metavar="X,Y,Z",
        help="place of the eye in mm from the panel's centre: right, up, towards the viewer",
    )
    add(
        "--eyes",
        type=numbers(3),
        metavar="FROM,TO,COUNT",
        help="in place of --eye: COUNT eyes side by side at the viewing distance, from FROM to TO mm right of the "
        "panel's middle; their pictures in rows of four",
    )
    add(
        "--spread",
        type=within(0.01, 1000, "sub-pixels"),
        metavar="SUBPIXELS",
        help="width of what a lens lights, in sub-pixels; more is crosstalk (default 1)",
    )
    add(
        "--psf",
        type=Path,
        metavar="FILE",
        help="in place of --spread: how brightly the eye sees the sub-pixels beside the right one, as measured; a line "
        "each: sub-pixels to the right, light (any unit)",
    )
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=".png, .tif or .exr")


def run(args: argparse.Namespace) -> None:
    """Simulates one eye before args.image. Raises InputError."""
    from lightfield_gs.show.preview import to_integers
    from lightfield_gs.show.sheet import in_rows

    watch = Stopwatch(args.began)
    path = check_image_path(args.output)
    check_outputs((path,), (args.image, args.panel, args.psf))
    _check_choices(args)
    psf = None if args.psf is None else Psf.load(args.psf)
    watch.lap("start")
    panel = load_panel(args) if args.panel is not None else at_distance(stored_panel(args), args.viewing_distance)
    if why := why_no_eye(panel):
        raise InputError(why)
    image = read_image(args.image, as_stored=True)
    watch.lap("load")
    eyes = [args.eye] if args.eyes is None else eye_row(panel, *args.eyes).tolist()
    pictures = simulate_eyes(image, panel, eyes, args.spread or 1.0, psf=psf)
    seen = in_rows(list(pictures))
    watch.lap("simulate")
    write_image(path, seen if path.suffix.lower() == ".exr" else to_integers(seen, 8), compression="small")
    watch.lap("write")
    height, width = pictures.shape[1:3]
    places = tuple(args.eye) if args.eyes is None else f"{len(eyes)} places, {eyes[0][0]:g} to {eyes[-1][0]:g}"
    print(f"{path}: {width} x {height}, one sample a lens, from {places} mm")
    print(watch.line())
    doubts = {_doubt_of_eye(panel, eye): None for eye in (eyes[0], eyes[-1])}  # each once
    for doubt in (*doubts, _doubt_of_panel(args, panel)):
        if doubt:
            note(doubt)


def _check_choices(args: argparse.Namespace) -> None:
    """Raises InputError where not exactly one of two options that exclude each other was given, or both."""
    if (args.eye is None) == (args.eyes is None):
        raise InputError("simulate needs a place to look from: give --eye X,Y,Z or --eyes FROM,TO,COUNT, one of them")
    if args.psf is not None and args.spread is not None:
        raise InputError("--spread is for the usual spread of light, and --psf takes its place; leave out one of them")


def _doubt_of_eye(panel: Panel, eye_mm: Sequence[float]) -> str | None:
    """Why a place (x, y, z in mm) of the eye is hardly meant, perhaps in other units; None where it may well be.

    Along the slant of the lenses the view stays the same, so that only the rest of the way counts for the cone.
    """
    x, y, z = eye_mm
    distance_mm = cast(float, panel.viewing_distance_mm)  # or the eye would have had no place
    if not 0.1 <= z / distance_mm <= 10:
        return f"the eye is {z:g} mm from the panel, which is made for {distance_mm:g} mm: views repeat or mix"
    aside_deg = math.degrees(math.atan2(abs(x - y * panel.slant_tan), z))
    if aside_deg > panel.cone_deg / 2:
        return (
            f"the eye is {aside_deg:.3g} degrees aside, the panel's viewing cone ends at {panel.cone_deg / 2:.3g}: "
            "views repeat"
        )
    return None


def _doubt_of_panel(args: argparse.Namespace, panel: Panel) -> str | None:
    """How the lens of the panel differs from the one that the image says it was encoded for; None where it does not."""
    stored = None if args.panel is None else read_info(args.image).metadata.get("panel")
    if stored is None:
        return None
    try:
        made_for = profile(args.image, stored)
    except InputError:
        return f"{args.image}: the panel profile in it cannot be used, nor compared with --panel"
    others = [key for key, value in vars(panel).items() if key not in _NOT_OF_THE_LENS and value != vars(made_for)[key]]
    if not others:
        return None
    return (
        f"{args.image} was encoded for panel {made_for.name}, whose {' and '.join(others)} differ from those of "
        f"{panel.name}: the picture is that of an image on the wrong panel; leave out --panel for its own"
    )
