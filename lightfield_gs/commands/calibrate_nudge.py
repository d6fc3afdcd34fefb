"""`lightfield-gs calibrate nudge`: change the lens of a profile a little."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.base.cli_messages import confirm, say, say_next
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import quoted
from lightfield_gs.commands.calibrate_pattern import PatternOptions, draw_pattern, write_pattern
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.panels.lens_change import LensChange, changed, check_profile_path
from lightfield_gs.panels.lens_history import write_kept
from lightfield_gs.panels.lens_words import LARGE, change_lines, large_changes, lens_slope, pitch_lpi
from lightfield_gs.panels.panel import Panel

_CHANGES = ("pitch_by", "slope_by", "centre_by", "line_number_by", "slant_by", "phase_by")


@dataclass(frozen=True, slots=True)
class NudgeOptions:
    """Changes of a lens; amounts are (value, whether it is percent), the others have one value.

    Attributes:
        profile: name of the profile, or a path to it.
        output: the changed profile.
        device_serial: the display, where the profile has several.
        pitch_by, slope_by, centre_by: in the terms of Looking Glass.
        line_number_by, slant_by, phase_by: in the units of a .yaml.
        pattern: kind of the pattern that is written too.
        yes: whether a large change is meant.
    """

    profile: str
    output: Path
    device_serial: str | None = None
    pitch_by: tuple[float, bool] | None = None
    slope_by: tuple[float, bool] | None = None
    centre_by: tuple[float] | None = None
    line_number_by: tuple[float] | None = None
    slant_by: tuple[float] | None = None
    phase_by: tuple[float] | None = None
    pattern: str | None = None
    yes: bool = False


def run(args: argparse.Namespace) -> None:
    """Write the changed profile. Raises InputError."""
    _nudge(read_options(NudgeOptions, args))


def _nudge(options: NudgeOptions) -> None:
    profile, serial, kind = options.profile, options.device_serial, options.pattern
    path = check_profile_path(options.output, profile)
    pattern = path.with_name(f"{path.stem}-{kind}.png") if kind else None
    check_outputs((path, pattern), ())  # a profile may be changed in its place: its history keeps what it was
    before = Panel.load(profile, serial=serial)
    after = changed(before, lens_change(options, before))
    if words := large_changes(before, after):
        confirm(f"{path}: {words}, and calibrations are seldom wrong by {LARGE:.0%}", options.yes)
    image = None if kind is None else draw_pattern(after, PatternOptions(kind))
    lines = change_lines(profile, before, after, serial)
    write_kept(path, profile, after, serial, f"{_change_words(options)}: {lines[0]}")
    print(f"{path}: {profile} with another lens; the way back: {quoted('lightfield-gs', 'calibrate', 'undo', path)}")
    say(*lines)
    if pattern is not None and kind is not None and image is not None:
        write_pattern(pattern, after, kind, image)
        print(f"{pattern}: {kind}, for the new profile; show it full screen, unscaled")
        say_next("show", pattern)
    else:
        say_next("calibrate", "pattern", "pitch", "--panel", path, "-o", path.with_name(f"{path.stem}-pitch.png"))


def lens_change(options: NudgeOptions, panel: Panel) -> LensChange:
    """Return the change that the options ask for.

    Raises:
        InputError: there is no change, or the profile cannot express it.
    """
    if all(getattr(options, change) is None for change in _CHANGES):
        names = ", ".join(f"--{change.replace('_', '-')}" for change in _CHANGES)
        raise InputError(f"nothing to change; give one or more of {names}")
    others = (options.centre_by, options.line_number_by, options.slant_by, options.phase_by)
    centre, line_number, slant, phase = (value[0] if value else 0.0 for value in others)
    pitch = slope = 0.0
    if options.pitch_by is not None:
        pitch, relative = options.pitch_by
        if not relative:
            pitch *= 100 / pitch_lpi(panel)
    if options.slope_by is not None:
        slope, relative = options.slope_by
        if not relative:
            slope *= 100 / lens_slope(options.profile, panel, options.device_serial)
    return LensChange(pitch, slope, centre, line_number, slant, phase)


def _change_words(options: NudgeOptions) -> str:
    """Return the changes that are asked for, as "pitch by 0.1%, centre by 0.05"."""
    given = {change: getattr(options, change) for change in _CHANGES if getattr(options, change) is not None}
    return ", ".join(
        f"{name.replace('_', ' ')} {value[0]:g}{'%' if value[1:] == (True,) else ''}" for name, value in given.items()
    )
