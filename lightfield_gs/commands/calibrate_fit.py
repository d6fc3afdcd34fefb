"""`lightfield-gs calibrate fit`: estimate the lens of a panel from photographs of a pattern that it shows."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import load_panel, why_no_eye
from lightfield_gs.base.cli_messages import note, say, say_next
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import quoted
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.panels.calibration_fit import CalibrationFit, ViewpointFit, fit_lens
from lightfield_gs.panels.calibration_photos import Viewpoint, load_viewpoint, read_viewpoints
from lightfield_gs.panels.lens_change import check_profile_path
from lightfield_gs.panels.lens_history import write_kept
from lightfield_gs.panels.lens_words import change_lines

_MOST_SPREAD_VIEWS = 0.2  # about the lens found; photographs of one exposure, sharp and upright, stay below
_MOST_OFFSET_VIEWS = 0.3  # between a place and the lens of all, above which its eye or the profile is doubtful


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Photographs of a pattern that a panel shows.

    Attributes:
        photos: the photographs, or a .yaml that lists them.
        output: the profile with the lens found.
        panel: the profile that the pattern was drawn for.
        eye: position of the camera for each place, mm.
        corners: of the panel in the photographs of each place, eight pixels.
        one_place: whether photographs from one place will do.
        refine: whether the lens is refined by every sub-pixel.
    """

    photos: list[Path]
    output: Path
    panel: PanelOptions
    eye: list[tuple[float, float, float]] | None = None
    corners: list[tuple[float, ...]] | None = None
    one_place: bool = False
    refine: bool = False


def run(args: argparse.Namespace) -> None:
    """Estimate the lens and write it. Raises InputError."""
    options = read_options(CalibrationOptions, args)
    profile, serial = args.panel, args.device_serial
    path = check_profile_path(options.output, profile)
    check_outputs((path,), (profile, *options.photos))
    start = load_panel(options.panel)
    if why := why_no_eye(start):
        raise InputError(why)
    photographs = read_photographs(options)
    fit, how = fit_lens(photographs, start, options.one_place), []
    if options.refine:
        from lightfield_gs.panels.calibration_refine import refine_lens  # it needs torch

        refined = refine_lens(photographs, start, fit)
        fit = replace(fit, panel=refined.panel)
        how = [f"refined: every sub-pixel left {refined.before:.3g} views over before, and {refined.after:.3g} after"]
    lines = change_lines(profile, start, fit.panel, serial)
    write_kept(path, profile, fit.panel, serial, f"by photographs: {lines[0]}")
    print(
        f"{path}: {profile} with the lens of the photographs, for eyes at {start.viewing_distance_mm:g} mm; the way "
        f"back: {quoted('lightfield-gs', 'calibrate', 'undo', path)}"
    )
    say(*lines, *how, *map(_place_line, fit.viewpoints))
    for words in implausible_places(fit):
        note(words)
    say_next("encode", "photo.jpg", "-o", "out.png", "--panel", path)


def implausible_places(fit: CalibrationFit) -> list[str]:
    """Return a line for each place whose photographs spread too far about the lens found, or lie off it."""
    spread = [
        f"{place.name}: what is seen spreads by {place.spread_views:.2g} views about the lens found, and good "
        f"photographs by less than {_MOST_SPREAD_VIEWS:g}: the lens may be wrong; check that all have one exposure and "
        "white balance, that none is turned or blurred, that nothing moved, and the corners"
        for place in fit.viewpoints
        if place.spread_views > _MOST_SPREAD_VIEWS
    ]
    off = [
        f"{place.name}: it sees the panel {place.offset_views:+.2g} views off the lens found, and good photographs by "
        f"less than {_MOST_OFFSET_VIEWS:g}: the lens may be wrong; check its eye, and cone_deg and "
        "viewing_distance_mm of the profile"
        for place in fit.viewpoints
        if abs(place.offset_views) > _MOST_OFFSET_VIEWS
    ]
    return spread or off


def read_photographs(options: CalibrationOptions) -> list[Viewpoint]:
    """Read the photographs of each place, by a .yaml or by --eye and --corners. Raises InputError."""
    is_list = [photo.suffix.lower() in (".yaml", ".yml") for photo in options.photos]
    if any(is_list):
        if len(options.photos) > 1 or options.eye or options.corners:
            raise InputError(
                "a .yaml says all of the photographs: give it alone, without --eye, --corners and other files"
            )
        return read_viewpoints(options.photos[0])
    eyes: Sequence[tuple[float, float, float]] = options.eye or ()
    each = {len(eyes): 1, 3 * len(eyes): 3}.get(len(options.photos))
    if each is None:
        raise InputError(
            f"expected three photographs for each --eye (shifts 0, 1, 2), or one (rgb), got {len(options.photos)} "
            f"photographs and {len(eyes)} --eye"
        )
    if options.corners is not None and len(options.corners) != len(eyes):
        raise InputError(f"expected --corners for each --eye, or none, got {len(options.corners)} for {len(eyes)}")
    corners = [np.reshape(one, (4, 2)).tolist() for one in options.corners] if options.corners else [None] * len(eyes)
    return [
        load_viewpoint(options.photos[each * k : each * (k + 1)], eye, at)
        for k, (eye, at) in enumerate(zip(eyes, corners))
    ]


def _place_line(place: ViewpointFit) -> str:
    corners = "  ".join(f"{x:.1f},{y:.1f}" for x, y in place.corners_px)
    return (
        f"{place.name}: {place.offset_views:+.3f} views off the lens found, spread {place.spread_views:.3f}; "
        f"corners {corners}"
    )
