"""A scene for tracked eyes, drawn for the page: two pictures woven for a panel, or one on a plain screen."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from lightfield_gs.encoding.eyes import EyesDrawing, render_head_coupled
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.screen_stage import ScreenStage
from lightfield_gs.show.page.stage import STILL_WIDTH_PX, Controls, Picture, StagedScene, timed


class TrackedStage(ScreenStage):
    """Draws the pictures of the page; see Stage, also for the other arguments.

    Args:
        panel: With a viewing distance, and with a pixel pitch where it has lenses.
        eyes_mm: [2, 3], where the eyes are at first, see encode_eyes.
        is_plain: Whether the screen has no lenses.

    Attributes:
        drawing: Draws the picture of the screen, and knows how long that takes.
    """

    follow_ms = 0
    is_tracked = True
    has_quality = False

    def __init__(
        self, scene: StagedScene, panel: Panel, eyes_mm: np.ndarray, is_plain: bool, device: str | None = None
    ):
        super().__init__(scene, panel, device)
        self.fills_screen = is_plain
        self.picture_words = "the screen's picture" if is_plain else "both eyes' pictures, woven"
        self.drawing, self._eyes = EyesDrawing(panel, is_plain), eyes_mm

    def look(self, eyes_mm: np.ndarray) -> None:
        """Show the scene to eyes at another place."""
        with self._changed:
            self._eyes = eyes_mm
            self.version += 1
            self._changed.notify_all()

    def eye(self, controls: Controls, width_px: int, still: bool) -> Picture:
        """Draw the picture for the middle between both eyes."""
        stages: dict[str, float] = {}
        panel, rig = self._rig(controls).reduced(self.panel, STILL_WIDTH_PX if still else width_px)
        with timed(stages, "view"):
            view = render_head_coupled(self.shown(controls), panel, rig, self._eyes, **self._how(controls))
        return Picture(view.cpu().numpy(), f"from between the eyes, {view.shape[1]} x {view.shape[0]}", stages)

    def _how(self, controls: Controls) -> dict[str, Any]:
        """Return the arguments by which the scene is drawn: there are no views to average over."""
        return {name: value for name, value in self.drawn_as(controls).items() if name != "view_filter"}

    def _state(self, controls: Controls) -> object:
        return controls.picture(), self._eyes.tobytes()

    def _encoded(self, panel: Panel, rig: Rig, controls: Controls, stats: dict | None = None) -> np.ndarray:
        stages = {} if stats is None else stats.setdefault("stages_ms", {})
        with torch.no_grad(), timed(stages, "eyes"):
            return self.drawing(self.shown(controls), rig, self._eyes, **self._how(controls)).cpu().numpy()
