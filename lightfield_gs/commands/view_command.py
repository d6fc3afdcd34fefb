"""The command line that makes the picture of a page: `lightfield-gs encode` with the page's controls as options."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.app.options import LookOptions
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.exports import saved_name
from lightfield_gs.show.page.stage import Controls

Typed = Iterable[tuple[str, tuple[str, ...]]]
_LOOK = {"focus", "depth_amount", "cone", "zoom", "pan"}
_CAMERA = {"rig", "camera", "up", "turn", "tilt"}
_OF_THE_PAGE = {"port", "host", "no_open", "stats", "fps"}
_RELATIVE = 1e-6  # of numbers that a browser sent back as they were


@dataclass(frozen=True)
class ShownPicture:
    """A picture on the page, before its controls.

    Attributes:
        input: The photo or the scene.
        panel: The panel.
        rig: The rig that it opened with.
        look: The options of the look by which it opened.
        typed: The options by which it opened, as Parser.typed returns them.
        frames: The files of scenes in a row, which the rig that the page saves frames together.
    """

    input: Path
    panel: Panel
    rig: Rig
    look: LookOptions
    typed: Typed
    frames: tuple[Path, ...] = ()

    def command(self, controls: Controls) -> list[str]:
        """Return the command line that makes its picture with these controls.

        A turned picture needs the rig that the page saves, and so does one of scenes in a row.
        """
        own, replaced = self._camera_words(controls)
        if controls.background:
            own, replaced = [*own, f"--background={controls.background}"], replaced | {"background"}
        if controls.quality != "exact":
            own.append(f"--quality={controls.quality}")
        kept = [word for name, words in self.typed if name not in replaced | _OF_THE_PAGE for word in words]
        shown = self.frames[min(controls.frame, len(self.frames) - 1)] if self.frames else self.input
        return ["lightfield-gs", "encode", str(shown), "-o", saved_name(shown.name, "native.png"), *kept, *own]

    def _camera_words(self, controls: Controls) -> tuple[list[str], set[str]]:
        """Return the options of cameras and look, and the names of those that they take the place of."""
        if controls.yaw_deg or controls.pitch_deg or self.frames:
            return [f"--rig={saved_name(self.input.name, 'rig.yaml')}"], _LOOK | _CAMERA
        cone = self.rig.cone_deg or self.panel.cone_deg
        now = controls.focus or self.rig.zero_depth, controls.cone_deg or cone
        numbers = (*now, controls.depth_amount, controls.zoom, 1 + controls.pan_x, 1 + controls.pan_y)
        if all(map(_is_same, numbers, (self.rig.zero_depth, cone, 1, 1, 1, 1))):
            return [], set()
        zoom, pan = self.look.zoom or 1.0, self.look.pan or (0.0, 0.0)
        words = [f"--focus={now[0]:.6g}", f"--cone={now[1]:.6g}"]
        factors = {"depth-amount": controls.depth_amount, "zoom": zoom * controls.zoom}
        words += [f"--{name}={factor:.6g}" for name, factor in factors.items() if not _is_same(factor, 1)]
        moved = [controls.zoom * before + after for before, after in zip(pan, (controls.pan_x, controls.pan_y))]
        if any(moved):
            words.append("--pan={:.6g},{:.6g}".format(*moved))
        return words, _LOOK


def _is_same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=_RELATIVE)
