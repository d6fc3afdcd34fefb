"""`lightfield-gs simulate`: the picture that an eye sees of an encoded image."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import at_distance, load_panel, parse_panel, stored_panel, why_no_eye
from lightfield_gs.base.cli_messages import Stopwatch, note
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, read_image, read_info, write_image
from lightfield_gs.panels.comfort import EYE_SEPARATION_MM
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import Psf, eye_row, simulate_eyes

_NOT_OF_THE_LENS = ("name", "viewing_distance_mm", "pixel_pitch_mm")  # sub-pixels show the same whatever they are


@dataclass(frozen=True, slots=True)
class SimulateOptions:
    """Options of the picture that an eye sees of an encoded image.

    Attributes:
        image: the encoded image.
        output: the picture that is seen.
        panel: options of the panel; None in them: the panel that the image names.
        eye: position x, y, z in mm.
        eyes: positions from, to in mm, and their count. Without either, a viewer's two eyes before the middle.
        spread: width that a lens lights, sub-pixels.
        psf: file of a measured spread.
        lens_pixels: whether a lens is one pixel of the file; else the picture is enlarged to fill a screen.
        stats: whether to print the times of the stages.
    """

    image: Path
    output: Path
    panel: PanelOptions
    eye: tuple[float, float, float] | None = None
    eyes: tuple[float, float, float] | None = None
    spread: float | None = None
    psf: Path | None = None
    lens_pixels: bool = False
    stats: bool = False


def run(args: argparse.Namespace) -> None:
    """Simulate eyes before args.image. Raises InputError."""
    _simulate(read_options(SimulateOptions, args), Stopwatch(args.began))


def _simulate(options: SimulateOptions, watch: Stopwatch) -> None:
    from lightfield_gs.show.preview import enlarged, in_rows, to_integers

    path = check_image_path(options.output)
    check_outputs((path,), (options.image, options.panel.panel, options.psf))
    if options.eye is not None and options.eyes is not None:
        raise InputError("--eyes takes the place of --eye; leave out one of them")
    if options.psf is not None and options.spread is not None:
        raise InputError("--spread is for the usual spread of light, and --psf takes its place; leave out one of them")
    psf = None if options.psf is None else Psf.load(options.psf)
    watch.lap("start")
    if options.panel.panel is not None:
        panel = load_panel(options.panel)
    else:
        stored = stored_panel(options.image, options.panel.device_serial)
        panel = at_distance(stored, options.panel.viewing_distance)
    if why := why_no_eye(panel):
        raise InputError(why)
    image = read_image(options.image, as_stored=True)
    watch.lap("load")
    eyes = _eyes(options, panel)
    pictures = simulate_eyes(image, panel, eyes, options.spread or 1.0, psf=psf)
    watch.lap("simulate")
    height, width = pictures.shape[1:3]
    size = f"{width} x {height}, one sample a lens"
    if path.suffix.lower() == ".exr":  # for measurements
        seen = in_rows(list(pictures))
    elif options.lens_pixels:
        seen = in_rows([to_integers(picture, 8) for picture in pictures])
    else:
        large = enlarged(list(pictures))
        seen, times = in_rows(large), large[0].shape[0] // height
        size += f", enlarged {times} times" if times > 1 else ""
    write_image(path, seen, compression="small")
    watch.lap("write")
    positions = options.eye or f"{len(eyes)} places, {eyes[0][0]:g} to {eyes[-1][0]:g}"
    own = "" if options.eye or options.eyes else ", of a viewer's two eyes (others: --eye, --eyes)"
    print(f"{path}: {size}, from {positions} mm{own}")
    watch.say_if(options.stats)
    notes = {_implausible_eye(panel, eye): None for eye in (eyes[0], eyes[-1])}  # each once
    for words in (*notes, _other_lens(options, panel)):
        if words:
            note(words)


def _eyes(options: SimulateOptions, panel: Panel) -> list[tuple[float, float, float]]:
    """Return the positions x, y, z of the eyes, mm."""
    if options.eye is not None:
        return [options.eye]
    first, last, count = options.eyes or (-EYE_SEPARATION_MM / 2, EYE_SEPARATION_MM / 2, 2)
    return eye_row(panel, first, last, cast(int, count)).tolist()


def _implausible_eye(panel: Panel, eye_mm: Sequence[float]) -> str | None:
    """Return why the position (x, y, z in mm) of an eye is hardly meant, perhaps in other units; None where it may be.

    Along the slant of the lenses the view stays the same: only the rest of the way counts for the cone.
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


def _other_lens(options: SimulateOptions, panel: Panel) -> str | None:
    """Describe the difference of the lens from the panel in the image's metadata; None if there is none."""
    stored = None if options.panel.panel is None else read_info(options.image).metadata.get("panel")
    if stored is None:
        return None
    try:
        made_for = parse_panel(options.image, stored)
    except InputError:
        return f"{options.image}: the panel profile in it cannot be used, nor compared with --panel"
    others = [key for key, value in vars(panel).items() if key not in _NOT_OF_THE_LENS and value != vars(made_for)[key]]
    if not others:
        return None
    return (
        f"{options.image} was encoded for panel {made_for.name}, whose {' and '.join(others)} differ from those of "
        f"{panel.name}: the picture is that of an image on the wrong panel; leave out --panel for its own"
    )
