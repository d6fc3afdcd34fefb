"""Screens on macOS, from `system_profiler`, which tells no positions."""

from __future__ import annotations

import re
from typing import Any

from lightfield_gs.displays.screens import Screen, output_of
from lightfield_gs.io.text_files import parse_json

_SIZE = re.compile(r"(\d+)\s*x\s*(\d+)")


def read_screens() -> list[Screen]:
    """Return the connected screens."""
    return parse_profile(output_of("system_profiler", "SPDisplaysDataType", "-json"))


def parse_profile(text: str) -> list[Screen]:
    """Return the screens in the output of `system_profiler SPDisplaysDataType -json`; none for other texts."""
    try:
        cards = parse_json(text)["SPDisplaysDataType"]
        shown = [screen for card in cards for screen in card.get("spdisplays_ndrvs", ())]
    except (ValueError, TypeError, KeyError, AttributeError):
        return []
    return [_screen(number, one) for number, one in enumerate(shown, 1) if isinstance(one, dict)]


def _screen(number: int, told: dict[str, Any]) -> Screen:
    pixels, desktop = (_size(told.get(key)) for key in ("_spdisplays_pixels", "_spdisplays_resolution"))
    pixels = pixels or desktop
    return Screen(
        f"screen {number}",
        str(told.get("_name", "")),
        str(told.get("_spdisplays_display-serial-number2") or told.get("_spdisplays_display-serial-number") or ""),
        pixels[0] if pixels else None,
        pixels[1] if pixels else None,
        position=(0, 0) if told.get("spdisplays_main") == "spdisplays_yes" else None,
        scale=pixels[0] / desktop[0] if pixels and desktop else None,
    )


def _size(text: object) -> tuple[int, int] | None:
    found = _SIZE.search(str(text))
    return (int(found[1]), int(found[2])) if found else None
