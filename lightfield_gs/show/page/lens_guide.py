"""The guided page of a calibration: a pattern on the panel, and keys that move its lens until it looks right."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.cells import subpixel_phases
from lightfield_gs.panels.lens_change import LensChange, changed
from lightfield_gs.panels.panel import Panel
from lightfield_gs.show.page.server import Answer, Query, Route, as_json, number, page_file, text

_MOST_PERCENT, _MOST_LENSES = 50.0, 10.0


@dataclass(frozen=True)
class LensGuide:
    """A lens that a page changes.

    Attributes:
        panel: The panel with the lens to begin with.
        save: Writes the panel with another lens, described in words, and returns lines on it.
        describe: Returns lines on a changed panel, and what is unusual about it, "" where nothing is.
    """

    panel: Panel
    save: Callable[[Panel, str], list[str]]
    describe: Callable[[Panel], tuple[list[str], str]]

    def routes(self) -> dict[str, Route]:
        """Return the addresses of the page. Only /save changes anything, and only this page has its token."""
        token = secrets.token_urlsafe()
        files = ("calibrate.css", "calibrate.js", "pattern.js", "display.js")
        return {
            "/": page_file("calibrate.html"),
            **{f"/{name}": page_file(name) for name in files},
            "/guide.json": Route(lambda query: as_json({**self._facts(), "token": token})),
            "/lens.json": Route(self._lens),
            "/save": Route(self._save, token),
            "/favicon.ico": Route(lambda query: text("", 204)),
        }

    def _facts(self) -> dict[str, Any]:
        panel = self.panel
        return {
            "name": panel.name,
            "width_px": panel.width_px,
            "height_px": panel.height_px,
            "views": panel.views,
            "distance_mm": panel.viewing_distance_mm,
            "has_slope": panel.slant_tan != 0,
        }

    def _changed(self, query: Query) -> tuple[Panel, str]:
        """Return the panel with the lens of a query, and its change in words."""
        pitch, slope = (number(query, key, -_MOST_PERCENT, _MOST_PERCENT) for key in ("pitch", "slope"))
        centre = number(query, "centre", -_MOST_LENSES, _MOST_LENSES)
        parts = {"pitch": (pitch, " %"), "slope": (slope, " %"), "centre": (centre, " lens widths")}
        words = [f"{name} by {value:+.4g}{unit}" for name, (value, unit) in parts.items() if value]
        return changed(self.panel, LensChange(pitch, slope, centre)), ", ".join(words)

    def _lens(self, query: Query) -> Answer:
        """Return the lens phases of a changed panel, in 2^-32 lens widths, as pattern.js takes them."""
        panel, _ = self._changed(query)
        start, across, down = panel.phase_steps()
        lines, warning = self.describe(panel)
        return as_json(
            {
                "start": start >> 32,
                "across": 3 * across % (1 << 64) >> 32,
                "down": down >> 32,
                "offsets": (subpixel_phases(panel) >> 32).astype(int).reshape(-1).tolist(),
                "lines": lines,
                "warning": warning,
            }
        )

    def _save(self, query: Query) -> Answer:
        panel, words = self._changed(query)
        if not words:
            raise InputError("nothing was changed yet")
        return as_json({"lines": self.save(panel, words)})
