"""Where the calibration of a Looking Glass lies: on the drive of the display, in Bridge's folders, or told by Bridge.

The display appears as a small drive with the file LKG_calibration/visual.json. Looking Glass Bridge tells the same on
its local HTTP interface (Bridge.js), and older services keep copies in a folder of the user.
"""

from __future__ import annotations

import ctypes
import string
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightfield_gs.base.assumptions import collect_assumptions
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import BRIDGE_URL
from lightfield_gs.io.text_files import read_json
from lightfield_gs.panels.display_kinds import DisplayKind, kind_by_hardware, kind_by_serial
from lightfield_gs.panels.looking_glass import LIMIT_BYTES, calibration_serials, find_calibration
from lightfield_gs.show.bridge import connected_displays

WHERE_IT_LIES = (
    "a Looking Glass keeps visual.json on a small drive of its own, in the folder LKG_calibration: "
    "/media/YOU/LKG-... on Linux, /Volumes/LKG-... on macOS, a letter such as E: on Windows; connect its USB cable, "
    "or start Looking Glass Bridge, or give the file as --panel visual.json"
)
_ON_DRIVE = "LKG_cal*/visual.json"
# Folders of a user below which Bridge and the services before it may keep copies; not documented by their maker
_SETTINGS = {
    "win32": ("AppData/Roaming/Looking Glass", "AppData/Local/Looking Glass"),
    "darwin": ("Library/Application Support/Looking Glass",),
    "linux": (".config/Looking Glass", ".local/share/Looking Glass"),
}
_DEPTHS = ("", "*/", "*/*/")
_DRIVE_SYSTEMS = ("vfat", "msdos", "exfat", "fuseblk")  # file systems of small drives: others may be slow networks
_FIXED, _REMOVABLE = 3, 2  # of GetDriveTypeW
_BRIDGE_TIMEOUT_S = 0.4


@dataclass(frozen=True)
class Calibration:
    """A calibration that was found.

    Attributes:
        data: Its contents, as Panel.from_looking_glass takes them.
        where: File or program that it is from.
        serial: Serial number of its display; "" where it tells none.
        kind: Kind of the display; None where not known.
        is_copy: Whether it may be of a display that is not connected.
    """

    data: Any
    where: str
    serial: str = ""
    kind: DisplayKind | None = None
    is_copy: bool = False

    def size_px(self) -> tuple[float, float] | None:
        """Return width and height of its screen; None where it tells none, or cannot be read."""
        try:
            with collect_assumptions():  # they are for those who use the calibration
                found = find_calibration(self.data, self.where, self.serial or None)
            return float(found["screenW"]), float(found["screenH"])
        except (InputError, KeyError, TypeError, ValueError):
            return None


def drives() -> list[Path]:
    """Return the folders of small drives that are mounted."""
    if sys.platform == "win32":
        libraries: Any = ctypes
        kernel = libraries.windll.kernel32
        roots = [f"{letter}:\\" for letter in string.ascii_uppercase[2:]]
        return [Path(root) for root in roots if kernel.GetDriveTypeW(root) in (_FIXED, _REMOVABLE)]
    if sys.platform == "darwin":
        return sorted(Path("/Volumes").glob("*"))
    try:
        return mounted_drives(Path("/proc/mounts").read_text(errors="replace"))
    except OSError:
        return []


def mounted_drives(mounts: str) -> list[Path]:
    """Return the folders of small drives in the text of /proc/mounts."""
    rows = [line.split() for line in mounts.splitlines()]
    places = [row[1] for row in rows if len(row) > 2 and row[2] in _DRIVE_SYSTEMS]
    return [Path(place.replace("\\040", " ").replace("\\134", "\\")) for place in places]


def find_calibrations(problems: list[str], url: str = BRIDGE_URL) -> list[Calibration]:
    """Return the calibrations on drives; else those that Bridge tells; else copies in its folders.

    Args:
        problems: Gains a line on each that cannot be read.
        url: Address of Bridge.
    """
    found = read_files(_below(drives(), (_ON_DRIVE,)), problems)
    if not found:
        found = ask_bridge(problems, url)
    if found:
        return found
    folders = [Path.home() / name for name in _SETTINGS.get(sys.platform, _SETTINGS["linux"])]
    copies = read_files(_below(folders, [f"{depth}visual.json" for depth in _DEPTHS]), problems)
    return [Calibration(one.data, one.where, one.serial, one.kind, is_copy=True) for one in copies]


def _below(folders: Iterable[Path], patterns: Iterable[str]) -> list[Path]:
    """Return the files of these patterns in folders that can be read."""
    found: list[Path] = []
    for folder in folders:
        for pattern in patterns:
            try:
                found += sorted(folder.glob(pattern))
            except OSError:
                continue
    return found


def read_files(paths: Iterable[Path], problems: list[str]) -> list[Calibration]:
    """Return the calibrations in files; a file that cannot be read is a problem."""
    found: list[Calibration] = []
    for path in paths:
        try:
            data = read_json(path, LIMIT_BYTES)
        except InputError as error:
            problems.append(str(error))
            continue
        found += _split(data, str(path))
    return found


def ask_bridge(problems: list[str], url: str = BRIDGE_URL) -> list[Calibration]:
    """Return the calibrations that Bridge tells, where it runs; that it does not run is a problem."""
    try:
        told = connected_displays(url, _BRIDGE_TIMEOUT_S)
    except InputError as error:
        problems.append(str(error))
        return []
    found: list[Calibration] = []
    for display in told.values():
        value = display.get("value", display) if isinstance(display, dict) else None
        hardware = value.get("hardwareVersion") if isinstance(value, dict) else None
        name = hardware.get("value") if isinstance(hardware, dict) else hardware
        kind = kind_by_hardware(name) if isinstance(name, str) else None
        found += _split(display, "Looking Glass Bridge", kind)
    return found


def _split(data: Any, where: str, kind: DisplayKind | None = None) -> list[Calibration]:
    """Return each calibration in `data`; none without a calibration."""
    found = []
    for serials in calibration_serials(data):
        serial = next((one for one in serials if one.upper().startswith("LKG")), serials[0] if serials else "")
        found.append(Calibration(data, where, serial, kind or kind_by_serial(serial)))
    return found
