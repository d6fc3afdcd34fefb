"""`lightfield-gs simulate`: what an eye sees of an encoded image."""

from __future__ import annotations

import argparse
import math

from lightfield_gs.commands.complaint import note
from lightfield_gs.commands.panel import at_distance, load_panel, why_no_eye
from lightfield_gs.commands.stopwatch import Stopwatch
from lightfield_gs.errors import InputError
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, read_image, read_info, write_image
from lightfield_gs.io.json_file import parse_json
from lightfield_gs.panel import Panel
from lightfield_gs.preview import to_integers
from lightfield_gs.simulate import simulate


def run(args: argparse.Namespace) -> None:
    """Simulates one eye before args.image. Raises InputError."""
    watch = Stopwatch(args.began)
    path = check_image_path(args.output)
    check_outputs((path,), (args.image, args.panel))
    watch.lap("start")
    panel = load_panel(args) if args.panel is not None else at_distance(_stored_panel(args), args.viewing_distance)
    if why := why_no_eye(panel):
        raise InputError(why)
    image = read_image(args.image, as_stored=True)
    watch.lap("load")
    seen = simulate(image, panel, args.eye, args.spread)
    watch.lap("simulate")
    write_image(path, seen if path.suffix.lower() == ".exr" else to_integers(seen, 8), compression="small")
    watch.lap("write")
    print(f"{path}: {seen.shape[1]} x {seen.shape[0]}, one sample a lens, from {tuple(args.eye)} mm")
    print(watch.line())
    if doubt := _doubt_of_eye(panel, args.eye):
        note(doubt)


def _doubt_of_eye(panel: Panel, eye_mm: tuple[float, float, float]) -> str | None:
    """Why a place (x, y, z in mm) of the eye is hardly meant, perhaps in other units; None where it may well be.

    Along the slant of the lenses the view stays the same, so that only the rest of the way counts for the cone.
    """
    x, y, z = eye_mm
    if not 0.1 <= z / panel.viewing_distance_mm <= 10:
        return (f"the eye is {z:g} mm from the panel, which is made for {panel.viewing_distance_mm:g} mm: "
                "views repeat or mix")
    aside_deg = math.degrees(math.atan2(abs(x - y * panel.slant_tan), z))
    if aside_deg > panel.cone_deg / 2:
        return (f"the eye is {aside_deg:.3g} degrees aside, the panel's viewing cone ends at {panel.cone_deg / 2:.3g}: "
                "views repeat")
    return None


def _stored_panel(args: argparse.Namespace) -> Panel:
    """The panel that the image was encoded for."""
    if args.device_serial is not None:
        raise InputError("--device-serial chooses among the calibrations of a --panel; give one, or leave it out")
    stored = read_info(args.image).metadata.get("panel")
    if stored is None:
        raise InputError(f"{args.image} does not say which panel it is for; give --panel")
    try:
        return Panel(**parse_json(stored))
    except (TypeError, ValueError) as error:
        raise InputError(f"{args.image}: its panel profile cannot be used ({error}); give --panel") from None
