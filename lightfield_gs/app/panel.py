"""The panel of a command, by its name or by the metadata of an encoded image; and facts for the metadata of images."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.io.atomic import sha256
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels.display_kinds import DisplayKind, kind_by_size
from lightfield_gs.panels.looking_glass import LOOKING_GLASS
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import missing_geometry

if TYPE_CHECKING:
    from lightfield_gs.displays.find import FoundDisplay, Survey
    from lightfield_gs.panels.quilt import QuiltLayout

_REMEDIES = {"viewing_distance_mm": "give --viewing-distance MM", "pixel_pitch_mm": "give a panel that has it"}


def load_panel(options: PanelOptions) -> Panel:
    """Return the panel, seen from the distance that is asked for, and note numbers that look like other units.

    Without a name it is the panel of the display that is connected, or else the default.

    Raises:
        InputError: there is no such panel, or its file cannot be used.
    """
    panel = found_panel(options.device_serial) if options.panel is None else _named_panel(options)
    panel = at_distance(panel, options.viewing_distance)
    if panel.viewing_distance_mm is None and (kind := _kind(panel)) is not None:
        assume(
            f"a viewing distance of {kind.viewing_distance_mm:g} mm, usual before a {kind.title} "
            "(another: viewing_distance_mm=MM)"
        )
        panel = at_distance(panel, kind.viewing_distance_mm)
    for words in implausible_units(panel):
        note(f"panel {panel.name}: {words}")
    return panel


def _named_panel(options: PanelOptions) -> Panel:
    """Return the panel of --panel."""
    name = str(options.panel)
    version = None
    with suppress(OSError):  # its reader says what is wrong with it
        found = Path(name).stat()
        version = found.st_size, found.st_mtime_ns
    return _read_panel(name, options.device_serial, version)


@lru_cache(maxsize=8)
def _read_panel(name: str, serial: str | None, version: tuple[int, int] | None) -> Panel:
    """Read a panel once for all inputs of a command, and again when its file has changed."""
    return Panel.load(name, serial=serial)


def found_panel(serial: str | None = None) -> Panel:
    """Return the panel of the display that is connected, or else the default, and say which in a line.

    Args:
        serial: Serial number of the display; None: the first.

    Raises:
        InputError: No display of the serial number is connected, or its calibration cannot be used.
    """
    panel, words = _found_panel(serial)
    if words:
        assume(words)
    return panel


@lru_cache(maxsize=8)
def _found_panel(serial: str | None) -> tuple[Panel, str]:
    """Return the panel, and words on it; "" where no display was looked up."""
    from lightfield_gs.displays.calibrations import WHERE_IT_LIES
    from lightfield_gs.displays.find import is_off

    if is_off():
        if serial is not None:
            raise InputError("--device-serial chooses among the calibrations of a --panel; give one, or leave it out")
        return Panel.load(DEFAULT_PANEL), ""
    survey = _survey()
    display = survey.chosen(serial)
    panel = display.load_panel() if display is not None else None
    if display is None or panel is None:
        words = f"panel {DEFAULT_PANEL}: no display was found (another: --panel; `lightfield-gs displays` lists all)"
        return Panel.load(DEFAULT_PANEL), words
    others = [one.title for one in survey.displays if one is not display]
    also = f"; also connected: {', '.join(others)} (--device-serial)" if others else ""
    source = f"by {display.calibration.where}" if display.calibration else WHERE_IT_LIES
    return panel, f"the panel of the {display.title}, which is connected, {source} (another: --panel){also}"


def _kind(panel: Panel) -> DisplayKind | None:
    """Return the kind of display of a Looking Glass' own calibration; None for other panels."""
    if panel.name != LOOKING_GLASS or panel.pixel_pitch_mm is None:
        return None
    return kind_by_size(panel.width_px, panel.height_px, 25.4 / panel.pixel_pitch_mm)


def implausible_units(panel: Panel) -> list[str]:
    """Return a line for each number of a panel that may be in another unit, with the number that may be meant."""
    slant, cone, distance, pitch = (panel.slant_tan, panel.cone_deg, panel.viewing_distance_mm, panel.pixel_pitch_mm)
    lines = []
    if abs(slant) > 1:
        lines.append(
            f"slant_tan {slant:g} leans the lenses by {math.degrees(math.atan(slant)):.3g} degrees; if it is "
            f"the slant in degrees, write its tangent, {math.tan(math.radians(slant)):.6g}"
        )
    if cone < 2:
        lines.append(f"cone_deg {cone:g} is hardly a cone; if it is in radians, write {math.degrees(cone):.6g}")
    if distance is not None and distance < 20:
        lines.append(
            f"viewing_distance_mm {distance:g} is hardly a distance of eyes; if it is in metres, write "
            f"{1000 * distance:g}"
        )
    if pitch is not None and not 0.01 <= pitch <= 20:
        lines.append(f"pixel_pitch_mm {pitch:g} is hardly the width of a pixel (0.05 to 1 mm of most displays)")
    return lines


def at_distance(panel: Panel, viewing_distance_mm: float | None) -> Panel:
    """Return the panel, seen from this distance in mm; None: from its own."""
    return panel if viewing_distance_mm is None else replace(panel, viewing_distance_mm=viewing_distance_mm)


def why_no_eye(panel: Panel) -> str | None:
    """Return why no eye can be placed before the panel, and what to do; None where one can."""
    missing = missing_geometry(panel)
    if not missing:
        return None
    return f"panel {panel.name} lacks {' and '.join(missing)}; {', and '.join(_REMEDIES[key] for key in missing)}"


def panel_of_views(layout: QuiltLayout, panel: Panel) -> Panel:
    """Return the panel that a quilt's scene is framed for: this one, with the views and the aspect of the quilt."""
    own = replace(panel, views=layout.views, invert_views=False)
    if abs(layout.aspect * panel.height_px / panel.width_px - 1) < 0.01:
        return own
    return replace(own, width_px=max(1, round(panel.height_px * layout.aspect)))


def stored_panel(image: Path, device_serial: str | None) -> Panel:
    """Return the panel that an image was encoded for.

    Raises:
        InputError: the image does not name its panel, or a serial is given, which only a --panel has.
    """
    if device_serial is not None:
        raise InputError("--device-serial chooses among the calibrations of a --panel; give one, or leave it out")
    stored = read_info(image).metadata.get("panel")
    if stored is None:
        raise InputError(f"{image} does not say which panel it is for; give --panel")
    return parse_panel(image, stored)


def shown_panel(image: Path, device_serial: str | None) -> Panel:
    """Return the panel that an image was encoded for; for an image that names none, that of the connected display.

    Raises:
        InputError: the image names none, and no display is connected.
    """
    if read_info(image).metadata.get("panel") is None and _connected(device_serial) is not None:
        return found_panel(device_serial)
    return stored_panel(image, device_serial)


def is_display_connected() -> bool:
    """Return whether a display with lenses is connected."""
    return _connected(None) is not None


def connected_position() -> tuple[int, int] | None:
    """Return the left and top edge of the connected display on the desktop; None where none is known."""
    display = _connected(None)
    return None if display is None or display.screen is None else display.screen.position


BROWSER_OPENS = "the browser opens there (else: --no-open)"


def where_to_show(panel: Panel, opened: str | None = None) -> list[str]:
    """Return lines on the display that is connected, and on whether an image for this panel suits it.

    Args:
        panel: Of the image.
        opened: Words on the window that opens on the display by itself. None: a browser must be moved there.
    """
    from lightfield_gs.displays.find import is_off

    if is_off():
        return []
    display = _connected(None)
    if display is None:
        way = "; move the browser to the panel" if opened is None else ""
        return [f"display: none was found (`lightfield-gs displays`){way}"]
    screen = display.screen
    place = "" if screen is None or screen.position is None else " at {},{}".format(*screen.position)
    connector = "" if screen is None else f" on {screen.connector}{place}"
    lines = [f"display: {display.title}{connector}; {opened or 'move the browser there'} (another image's: --panel)"]
    with suppress(InputError):
        own = display.load_panel() if display.calibration is not None else None
        if own is not None and lens_differs(own, panel):
            lines.append(
                f"the image was made for panel {panel.name}, whose lens is not the display's: encode it again "
                "without --panel"
            )
    return lines


def connected_preset() -> str | None:
    """Return the preset of the quilts of the display that is connected, and say so; None without one."""
    display = _connected(None)
    if display is None or display.kind is None:
        return None
    preset = next(iter(display.kind.quilts))
    assume(f"the quilt of a {display.title}, which is connected (another: preset=NAME)")
    return preset


def _connected(serial: str | None) -> FoundDisplay | None:
    """Return the display that is connected; None without one, or where none is to be looked up. Raises InputError."""
    from lightfield_gs.displays.find import is_off

    return None if is_off() else _survey().chosen(serial)


@cache
def _survey() -> Survey:
    """Look the displays up, once in a command."""
    from lightfield_gs.displays.find import survey_displays

    return survey_displays()


def panel_words(name: str | None) -> tuple[str, ...]:
    """Return the words by which another command takes the same panel; none for the panel that it takes by itself."""
    return () if name is None else ("--panel", name)


def lens_differs(one: Panel, other: Panel) -> bool:
    """Return whether two panels differ in the geometry that decides where their views go."""
    names = ("width_px", "height_px", "line_number", "slant_tan", "phase", "subpixel_order", "subpixel_cells")
    return any(getattr(one, name) != getattr(other, name) for name in names)


def parse_panel(image: Path, stored: str) -> Panel:
    """Return the panel of the JSON text that is stored in an image. Raises InputError."""
    try:
        return Panel(**parse_json(stored))
    except (TypeError, ValueError) as error:
        raise InputError(f"{image}: its panel profile cannot be used ({error}); give --panel") from None


@cache
def package_versions() -> dict[str, str]:
    """Return the versions of this package and of the packages that affect the result."""
    from importlib.metadata import PackageNotFoundError, version

    versions = {}
    for name in ("lightfield-gs", "torch", "numpy", "openimageio"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def software() -> str:
    return f"lightfield-gs {package_versions()['lightfield-gs']}"


def file_facts(path: Path) -> dict[str, str]:
    return {"file": path.name, "sha256": sha256(path)}
