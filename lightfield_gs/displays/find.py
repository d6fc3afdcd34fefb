"""The 3D displays that are connected: each a screen, a calibration, or both."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field

from lightfield_gs.base.errors import InputError
from lightfield_gs.displays.calibrations import Calibration, find_calibrations
from lightfield_gs.displays.screens import Screen
from lightfield_gs.panels.display_kinds import DISPLAY_KINDS, DisplayKind, kind_by_serial, kind_by_size
from lightfield_gs.panels.panel import Panel

LOOKUP = "LIGHTFIELD_GS_DISPLAYS"  # "off": nothing is looked up, for scripts and tests


@dataclass(frozen=True)
class FoundDisplay:
    """A Looking Glass that is connected.

    Attributes:
        screen: The screen; None where the system tells of none.
        calibration: Its calibration; None where none was found.
        kind: Its kind; None where not known.
    """

    screen: Screen | None
    calibration: Calibration | None
    kind: DisplayKind | None

    @property
    def serial(self) -> str:
        """Its serial number; "" where not known."""
        told = self.calibration.serial if self.calibration else ""
        return told or (self.screen.looking_glass_serial if self.screen else "")

    @property
    def title(self) -> str:
        """Its kind and its serial number."""
        kind = self.kind.title if self.kind else "Looking Glass"
        return f"{kind} {self.serial}".strip()

    def load_panel(self) -> Panel | None:
        """Return its panel by its calibration, or else that of a typical display of its kind; None without either.

        Raises:
            InputError: Its calibration cannot be used.
        """
        if self.calibration is not None:
            return Panel.from_looking_glass(self.calibration.data, serial=self.calibration.serial or None)
        names = [name for name, kind in DISPLAY_KINDS.items() if kind is self.kind]
        return Panel.load(names[0]) if names else None


@dataclass
class Survey:
    """All that was found.

    Attributes:
        screens: The screens, those of other makers among them.
        displays: The 3D displays.
        problems: Lines on what could not be read.
    """

    screens: list[Screen] = field(default_factory=list)
    displays: list[FoundDisplay] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def chosen(self, serial: str | None = None) -> FoundDisplay | None:
        """Return the display of a serial number, or the first; one with a calibration goes before others.

        Raises:
            InputError: No display has this serial number.
        """
        if serial is not None:
            found = [one for one in self.displays if one.serial.casefold() == serial.strip().casefold()]
            if not found:
                known = ", ".join(one.title for one in self.displays) or "none"
                raise InputError(f"no display with serial={serial} is connected; found: {known}")
            return found[0]
        ordered = sorted(self.displays, key=lambda one: one.calibration is None)
        return ordered[0] if ordered else None


def is_off() -> bool:
    """Return whether the user wants no display to be looked up."""
    return os.environ.get(LOOKUP, "").lower() == "off"


def connected_screens() -> list[Screen]:
    """Return the screens of this computer; none where the system tells of none."""
    if sys.platform == "win32":
        from lightfield_gs.displays.windows import read_screens
    elif sys.platform == "darwin":
        from lightfield_gs.displays.macos import read_screens
    else:
        from lightfield_gs.displays.linux import read_screens
    return read_screens()


def survey_displays() -> Survey:
    """Return the screens and the 3D displays that are connected."""
    survey = Survey(connected_screens())
    survey.displays = match_displays(survey.screens, find_calibrations(survey.problems))
    return survey


def match_displays(screens: list[Screen], calibrations: list[Calibration]) -> list[FoundDisplay]:
    """Return the displays of screens and calibrations, each with the other part that belongs to it.

    A calibration belongs to the screen of its serial number, or else of its size. Copies count only with a screen.
    """
    lookings = [screen for screen in screens if screen.is_looking_glass]
    rest, found = list(calibrations), []
    for screen in lookings:
        own = [one for one in rest if one.serial and one.serial.upper() == screen.looking_glass_serial]
        if not own:
            taken = [other.looking_glass_serial for other in lookings if other is not screen]
            own = [one for one in rest if one.serial.upper() not in taken and _is_size(one, screen)]
        calibration = own[0] if own else None
        if calibration is not None:
            rest.remove(calibration)
        found.append(FoundDisplay(screen, calibration, _kind(screen, calibration)))
    for calibration in rest:
        if not calibration.is_copy:
            others = [one for one in screens if not one.is_looking_glass and _is_size(calibration, one)]
            found.append(FoundDisplay(others[0] if len(others) == 1 else None, calibration, _kind(None, calibration)))
    return found


def _is_size(calibration: Calibration, screen: Screen) -> bool:
    """Return whether a calibration is of a screen of this size, upright or on its side."""
    size = calibration.size_px()
    return size is not None and sorted(size) == sorted((screen.width_px or 0, screen.height_px or 0))


def _kind(screen: Screen | None, calibration: Calibration | None) -> DisplayKind | None:
    """Return the kind of display by its serial number, what Bridge calls it, or its size."""
    if calibration is not None and calibration.kind is not None:
        return calibration.kind
    size = calibration.size_px() if calibration is not None else None
    if screen is not None:
        if kind := kind_by_serial(screen.looking_glass_serial):
            return kind
        size = size or (screen.width_px or 0, screen.height_px or 0)
    return kind_by_size(int(size[0]), int(size[1])) if size else None
