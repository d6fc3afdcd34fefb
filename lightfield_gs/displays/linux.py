"""Screens on Linux: the kernel's connectors in /sys/class/drm, and what xrandr tells of an X or XWayland desktop.

The kernel knows all screens and their own pixels, also where no desktop runs; only the desktop knows where they stand.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

from lightfield_gs.displays.edid import Edid, parse_edid
from lightfield_gs.displays.screens import Screen, output_of

_DRM = Path("/sys/class/drm")
# "HDMI-1 connected primary 1536x2048+1920+0 (0x48) left (normal left ...) 120mm x 160mm"; without a place: switched off
_OUTPUT = re.compile(
    r"(?P<name>\S+) connected(?: primary)?"
    r"(?: (?P<width>\d+)x(?P<height>\d+)\+(?P<x>-?\d+)\+(?P<y>-?\d+))?"
    r"(?: \(0x[0-9a-f]+\))?(?: (?P<turn>normal|left|right|inverted))?"
    r"[^)]*\)(?: (?P<across>\d+)mm x (?P<down>\d+)mm)?"
)
_MODE = re.compile(r"\s+(\d+)x(\d+)\s.*\*current")
_TEXT_DPI = re.compile(r"^Xft\.dpi:\s*([0-9.]+)", re.MULTILINE)
_USUAL_DPI = 96.0


@dataclass(frozen=True)
class _Output:
    """A screen, and the bytes of its EDID by which two sources tell of the same one."""

    screen: Screen
    edid: bytes


def read_screens() -> list[Screen]:
    """Return the connected screens."""
    desktop = text_dpi = ""
    if os.environ.get("DISPLAY"):
        desktop, text_dpi = output_of("xrandr", "--verbose"), output_of("xrdb", "-query")
    return merge_outputs(read_connectors(_DRM), parse_xrandr(desktop, text_dpi))


def read_connectors(root: Path) -> list[_Output]:
    """Return the connected screens of the kernel, in a folder such as /sys/class/drm."""
    found = []
    for folder in sorted(root.glob("card*-*")):
        try:
            if (folder / "status").read_text().strip() != "connected":
                continue
            edid = (folder / "edid").read_bytes()
            modes = (folder / "modes").read_text().split()
        except OSError:
            continue
        screen = _screen(folder.name.partition("-")[2], parse_edid(edid))
        size = re.match(r"(\d+)x(\d+)", modes[0]) if modes else None
        if size is not None:  # also of screens too wide for the first block of the EDID
            screen = replace(screen, width_px=int(size[1]), height_px=int(size[2]))
        found.append(_Output(screen, edid))
    return found


def parse_xrandr(text: str, text_dpi: str = "") -> list[_Output]:
    """Return the screens in the output of `xrandr --verbose`.

    Args:
        text: The output.
        text_dpi: The output of `xrdb -query`, whose Xft.dpi is the desktop's scaling of text and browsers.
    """
    dpi = _TEXT_DPI.search(text_dpi)
    scaling = float(dpi[1]) / _USUAL_DPI if dpi else 1.0
    found = []
    for part in re.split(r"\n(?=\S)", text):
        lines = part.splitlines()
        words = _OUTPUT.match(lines[0]) if lines else None
        if words is None:
            continue
        edid = _edid_bytes(lines)
        screen = _screen(words["name"], parse_edid(edid))
        if words["across"] and int(words["across"]):
            screen = replace(screen, size_mm=(int(words["across"]), int(words["down"])))
        if words["width"]:
            modes = [mode for line in lines if (mode := _MODE.match(line))]
            size = (int(modes[0][1]), int(modes[0][2])) if modes else (int(words["width"]), int(words["height"]))
            width, height = size[::-1] if words["turn"] in ("left", "right") else size
            screen = replace(
                screen,
                width_px=width,
                height_px=height,
                position=(int(words["x"]), int(words["y"])),
                scale=scaling * width / int(words["width"]),
            )
        found.append(_Output(screen, edid))
    return found


def merge_outputs(kernel: list[_Output], desktop: list[_Output]) -> list[Screen]:
    """Return the screens of both sources, each once: the desktop's, with what the kernel knows beside it."""
    rest = list(kernel)
    found: list[Screen] = []
    for output in desktop:
        screen = output.screen
        same = [one for one in rest if output.edid and one.edid == output.edid]
        same = same or [one for one in rest if _plain(one.screen.connector) == _plain(screen.connector)]
        if same:
            rest.remove(same[0])
            screen = _completed(screen, same[0].screen, bool(output.edid))
        found.append(screen)
    return found + [one.screen for one in rest]


def _completed(screen: Screen, known: Screen, is_native: bool) -> Screen:
    """Return a desktop's screen with the kernel's name and serial number, and its pixels where they are scaled."""
    screen = replace(screen, name=screen.name or known.name, serial=screen.serial or known.serial)
    if is_native or not (screen.width_px and known.width_px and known.height_px):
        return screen
    # XWayland gives the desktop's pixels as the screen's
    own = known.width_px, known.height_px
    if (own[0] > own[1]) != (screen.width_px > (screen.height_px or 0)):
        own = own[::-1]
    return replace(screen, width_px=own[0], height_px=own[1], scale=(screen.scale or 1.0) * own[0] / screen.width_px)


def _screen(connector: str, edid: Edid | None) -> Screen:
    if edid is None:
        return Screen(connector)
    width, height = edid.size_px or (None, None)
    return Screen(connector, edid.name or edid.maker, edid.serial, width, height, size_mm=edid.size_mm)


def _edid_bytes(lines: list[str]) -> bytes:
    """Return the bytes below the line "EDID:"; none where there is none, or it is damaged."""
    start = next((number for number, line in enumerate(lines) if line.strip() == "EDID:"), len(lines))
    digits = []
    for line in lines[start + 1 :]:
        if not re.fullmatch(r"\s+[0-9a-f]{32}", line):
            break
        digits.append(line.strip())
    return bytes.fromhex("".join(digits))


def _plain(connector: str) -> str:
    """Return a connector's name as all sources have it: HDMI-1 for the kernel's HDMI-A-1."""
    return connector.upper().replace("HDMI-A", "HDMI")
