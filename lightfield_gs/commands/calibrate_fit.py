"""`lightfield-gs calibrate fit`: estimate the lens of a panel from photographs of a pattern that it shows."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.app.panel import load_panel, why_no_eye
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.calibrate_nudge import said_of_change
from lightfield_gs.commands.options.panel import add_device_serial, add_viewing_distance
from lightfield_gs.commands.options.parser import numbers
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.panels.calibration_fit import CalibrationFit, ViewpointFit, fit_lens, most_spread_views
from lightfield_gs.panels.calibration_photos import Viewpoint, load_viewpoint, read_viewpoints
from lightfield_gs.panels.lens_change import check_profile_path, write_profile

_MOST_OFFSET_VIEWS = 0.3  # between a place and the lens of all, above which its eye or the profile is doubtful


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs calibrate fit`."""
    parser.epilog = (
        "What to photograph: `calibrate pattern phase --shift 0`, 1 and 2 of the very profile START, shown full screen "
        "and unscaled, in a dark room, from each of two places at least, a twentieth of the viewing zone apart, best "
        "at the viewing distance; nothing but the pattern may change between the three: same exposure and white "
        "balance, no clipping, camera on a stand. Or one photograph of `calibrate pattern rgb` from each place, which "
        "is quicker, and as good as the camera keeps the colours apart."
    )
    add = parser.add_argument
    add(
        "photos",
        nargs="+",
        type=Path,
        metavar="PHOTO",
        help="the photographs, of shift 0, 1 and 2 from the first place, then from the next; or a .yaml that lists "
        "them: places, each with eye_mm, photos and perhaps corners_px",
    )
    add(
        "--panel",
        required=True,
        metavar="START",
        help="the profile that the pattern was drawn for: name, .yaml or .json",
    )
    add_device_serial(add)
    add_viewing_distance(add, "distance that the lens is made for, where START does not say it")
    add(
        "--eye",
        type=numbers(3),
        action="append",
        metavar="X,Y,Z",
        help="where the camera was, in mm from the panel's middle: right (as the viewer sees it), up, towards the "
        "viewer; once for each place",
    )
    add(
        "--corners",
        type=numbers(8),
        action="append",
        metavar="X,Y,...",
        help="upper left, upper right, lower right and lower left corner of the panel in the photographs, in pixels "
        "from their upper left; once for each place (default: they are found, where the room is dark)",
    )
    add(
        "--one-place",
        action="store_true",
        help="take photographs from one place: order, mirroring and eye go unchecked",
    )
    add("-o", "--output", type=Path, required=True, metavar="NEW", help="START with the lens found, in its own format")


def run(args: argparse.Namespace) -> None:
    """Estimates the lens and writes it. Raises InputError."""
    path = check_profile_path(args.output, args.panel)
    check_outputs((path,), (args.panel, *args.photos))
    start = load_panel(args)
    if why := why_no_eye(start):
        raise InputError(why)
    fit = fit_lens(places_of(args), start, args.one_place)
    write_profile(path, args.panel, fit.panel, args.device_serial)
    print(f"{path}: {args.panel} with the lens of the photographs, for eyes at {start.viewing_distance_mm:g} mm")
    for line in (
        *said_of_change(args.panel, start, fit.panel, args.device_serial),
        *map(_said_of_place, fit.viewpoints),
    ):
        print(line)
    for words in doubts_of(fit):
        note(words)


def doubts_of(fit: CalibrationFit) -> list[str]:
    """Lines on the places whose photographs spread too far about the lens found, or lie off it as a whole."""
    most = most_spread_views(fit.panel)
    spread = [
        f"{place.name}: what is seen spreads by {place.spread_views:.2g} views about the lens found, and good "
        f"photographs by less than {most:.2g}: the lens may be wrong; check that all have one exposure and white "
        "balance, that none is turned or blurred, that nothing moved, and the corners"
        for place in fit.viewpoints
        if place.spread_views > most
    ]
    off = [
        f"{place.name}: it sees the panel {place.offset_views:+.2g} views off the lens found, and good photographs by "
        f"less than {_MOST_OFFSET_VIEWS:g}: the lens may be wrong; check its eye, and cone_deg and "
        "viewing_distance_mm of the profile"
        for place in fit.viewpoints
        if abs(place.offset_views) > _MOST_OFFSET_VIEWS
    ]
    return spread or off


def places_of(args: argparse.Namespace) -> list[Viewpoint]:
    """The places of a .yaml, or of the photographs, --eye and --corners. Raises InputError."""
    is_list = [photo.suffix.lower() in (".yaml", ".yml") for photo in args.photos]
    if any(is_list):
        if len(args.photos) > 1 or args.eye or args.corners:
            raise InputError(
                "a .yaml says all of the photographs: give it alone, without --eye, --corners and other files"
            )
        return read_viewpoints(args.photos[0])
    eyes: Sequence[tuple[float, float, float]] = args.eye or ()
    each = {len(eyes): 1, 3 * len(eyes): 3}.get(len(args.photos))
    if each is None:
        raise InputError(
            f"expected three photographs for each --eye (shifts 0, 1, 2), or one (rgb), got {len(args.photos)} "
            f"photographs and {len(eyes)} --eye"
        )
    if args.corners is not None and len(args.corners) != len(eyes):
        raise InputError(f"expected --corners for each --eye, or none, got {len(args.corners)} for {len(eyes)}")
    corners = [np.reshape(one, (4, 2)).tolist() for one in args.corners] if args.corners else [None] * len(eyes)
    return [
        load_viewpoint(args.photos[each * k : each * (k + 1)], eye, at)
        for k, (eye, at) in enumerate(zip(eyes, corners))
    ]


def _said_of_place(place: ViewpointFit) -> str:
    corners = "  ".join(f"{x:.1f},{y:.1f}" for x, y in place.corners_px)
    return (
        f"{place.name}: {place.offset_views:+.3f} views off the lens found, spread {place.spread_views:.3f}; "
        f"corners {corners}"
    )
