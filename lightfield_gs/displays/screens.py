"""A connected screen, and the programs that tell of it."""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass

_SERIAL = re.compile(r"LKG[-_ ]?[0-9A-Z][-0-9A-Z]*", re.IGNORECASE)
_LOOKING_GLASS = re.compile(r"\bLKG|looking ?glass", re.IGNORECASE)
_TIMEOUT_S = 5.0


@dataclass(frozen=True)
class Screen:
    """A connected screen.

    Attributes:
        connector: The system's name for it, such as HDMI-1.
        name: Its own name, from its EDID; "" without one.
        serial: Its serial number; "" without one.
        width_px, height_px: Its pixels as it stands; None where not known.
        position: Of its left and top edge on the desktop, in the desktop's pixels; None where not known, or switched
            off.
        scale: Screen pixels for one pixel of the desktop; None where not known.
        size_mm: Width and height of its picture; None where not known.
    """

    connector: str
    name: str = ""
    serial: str = ""
    width_px: int | None = None
    height_px: int | None = None
    position: tuple[int, int] | None = None
    scale: float | None = None
    size_mm: tuple[int, int] | None = None

    @property
    def is_looking_glass(self) -> bool:
        """Whether its name or serial number is one of Looking Glass."""
        return bool(_LOOKING_GLASS.search(f"{self.name} {self.serial}"))

    @property
    def looking_glass_serial(self) -> str:
        """The serial number LKG-... in its name or its serial number; "" without one."""
        found = _SERIAL.search(self.serial) or _SERIAL.search(self.name)
        return found[0].upper() if found else ""

    def describe(self) -> str:
        """Describe the screen in a line."""
        words = [self.name or "a screen without a name"]
        if self.serial and self.serial != self.name:
            words.append(f"(serial {self.serial})")
        words.append(f"on {self.connector}:")
        size = "size not known" if self.width_px is None else f"{self.width_px} x {self.height_px} pixels"
        parts = [size]
        if self.size_mm is not None:
            parts.append(f"{self.size_mm[0]} x {self.size_mm[1]} mm")
        if self.position is not None:
            parts.append("at {:d},{:d}".format(*self.position))
        if self.scale is not None:
            parts.append(f"scale {self.scale:.0%}")
        return f"{' '.join(words)} {', '.join(parts)}"


def output_of(*command: str) -> str:
    """Return what a command prints; "" where it is not there, or fails."""
    try:
        done = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.decode(errors="replace") if done.returncode == 0 else ""
