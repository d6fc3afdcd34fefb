"""Which screen a window fills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lightfield_gs.base.errors import InputError


@dataclass(frozen=True)
class Monitor:
    """A screen, as the window system tells of it.

    Attributes:
        name: The system's name for it.
        position: Of its left and top edge on the desktop.
        size_px: Width and height of its pixels.
        rate_hz: Pictures a second; 0 where not known.
    """

    name: str
    position: tuple[int, int]
    size_px: tuple[int, int]
    rate_hz: int = 0

    def words(self) -> str:
        """Return name, pixels and rate."""
        rate = f" at {self.rate_hz} Hz" if self.rate_hz else ""
        return f"{self.name}, {self.size_px[0]} x {self.size_px[1]} pixels{rate}"


def choose_monitor(
    monitors: Sequence[Monitor], position: tuple[int, int] | None, size_px: tuple[int, int]
) -> tuple[int, str]:
    """Return the number of the screen of a panel, and a line on the choice.

    It is the screen at the panel's position, else the only one of its size, else the first.

    Args:
        monitors: All screens, the usual one first.
        position: Of the panel's display on the desktop; None where not known.
        size_px: Width and height of the panel.

    Raises:
        InputError: There is no screen.
    """
    if not monitors:
        raise InputError("--window: this desktop has no screen; connect the panel's display and switch it on")
    there = [number for number, one in enumerate(monitors) if one.position == position]
    alike = [number for number, one in enumerate(monitors) if one.size_px == size_px]
    if there:
        number, reason = there[0], "where the display is"
    elif len(alike) == 1:
        number, reason = alike[0], "the only screen of the panel's size"
    else:
        number, reason = 0, "the desktop's first screen, for the panel's own is not known"
    line = f"window: {monitors[number].words()}: {reason} (Escape, Q or Ctrl-C ends it)"
    return number, line


def misfit(shown_px: tuple[int, int], size_px: tuple[int, int]) -> str | None:
    """Return a line where a window does not have a panel's pixels; None where it does."""
    if shown_px == size_px:
        return None
    return (
        f"window: it has {shown_px[0]} x {shown_px[1]} pixels and the panel {size_px[0]} x {size_px[1]}: the "
        "picture's upper left part is shown, which is no 3D picture there (--panel names another panel)"
    )
