"""`lightfield-gs displays`: the screens that are connected, the 3D displays among them, and their calibrations."""

from __future__ import annotations

import argparse
import json
from typing import Any

from lightfield_gs.base.cli_messages import say_next
from lightfield_gs.displays.calibrations import WHERE_IT_LIES
from lightfield_gs.displays.find import FoundDisplay, Survey, survey_displays
from lightfield_gs.panels.display_kinds import DISPLAY_KINDS


def run(args: argparse.Namespace) -> None:
    """Print what is connected."""
    survey = survey_displays()
    if args.json:
        print(json.dumps(_facts(survey), indent=1))
        return
    for screen in survey.screens:
        print(f"screen: {screen.describe()}")
    if not survey.screens:
        print("screen: none is told by this system; a desktop on this computer is needed")
    for display in survey.displays:
        print("\n".join(_lines(display)))
    if survey.displays:
        say_next("encode", "photo.jpg", "-o", "out.png")
    else:
        print("3D display: none was found")
        print(f"its calibration: {WHERE_IT_LIES}")
        for words in survey.problems:
            print(f"asked in vain: {words}")
        print(f"without one, --panel also takes a name: {', '.join(DISPLAY_KINDS)}")


def _lines(display: FoundDisplay) -> list[str]:
    """Return the lines on a 3D display."""
    place = f" on {display.screen.connector}" if display.screen else ", whose screen this system does not tell of"
    lines = [f"3D display: {display.title}{place}"]
    if display.calibration is not None:
        lines.append(f"its calibration: {display.calibration.where}")
    else:
        lines.append(f"its calibration: not found; {WHERE_IT_LIES}")
    scale = display.screen.scale if display.screen else None
    if scale is not None and abs(scale - 1) > 0.001:
        lines.append(f"its scale is {scale:.0%}: set it to 100 % in the settings of the desktop")
    lines.append("for it: lightfield-gs encode photo.jpg -o out.png")
    return lines


def _facts(survey: Survey) -> dict[str, Any]:
    displays = [
        {
            "title": one.title,
            "serial": one.serial,
            "connector": one.screen.connector if one.screen else None,
            "calibration": one.calibration.where if one.calibration else None,
        }
        for one in survey.displays
    ]
    return {"screens": [vars(screen) for screen in survey.screens], "displays": displays, "problems": survey.problems}
