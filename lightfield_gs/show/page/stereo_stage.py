"""A scene on a screen of two eyes, drawn for the page: in place of a panel's picture there is that of both eyes."""

from __future__ import annotations

import numpy as np
import torch

from lightfield_gs.base.options import StereoLayout
from lightfield_gs.encoding.stereo import join_eyes, render_eyes
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.stage import STILL_WIDTH_PX, Controls, Picture, Stage, StagedScene, timed


class StereoStage(Stage):
    """Draws the pictures of the page; see Stage, also for the other arguments.

    Args:
        panel: Of a StereoScreen.
        layout: One image of both eyes.
    """

    def __init__(self, scene: StagedScene, panel: Panel, layout: StereoLayout, device: str | None = None):
        super().__init__(scene, panel, device)
        self.layout = layout

    def eye(self, controls: Controls, width_px: int, still: bool) -> Picture:
        """Draw the picture that an eye at controls.eye sees: the screen has no lenses."""
        stages: dict[str, float] = {}
        with timed(stages, "view"):
            view = self._views(controls, [controls.eye], STILL_WIDTH_PX if still else width_px)[0]
        return Picture(view, f"one view, {view.shape[1]} x {view.shape[0]}", stages)

    def crop(self, controls: Controls, centre: tuple[float, float], size_px: tuple[int, int], still: bool) -> Picture:
        """Return pixels of the picture of both eyes one to one, around a point of it."""
        native, stages = self.native(controls)
        sides = native.shape[1::-1]
        sizes = [min(size, side) for size, side in zip(size_px, sides)]
        left, top = (round(part * (side - size)) for part, side, size in zip(centre, sides, sizes))
        right, bottom = left + sizes[0], top + sizes[1]
        words = f"pixels {left}..{right - 1} x {top}..{bottom - 1} of both eyes' picture, {self.layout}"
        return Picture(native[top:bottom, left:right], words, stages)

    def _encoded(self, panel: Panel, rig: Rig, controls: Controls, stats: dict | None = None) -> np.ndarray:
        stages = {} if stats is None else stats.setdefault("stages_ms", {})
        with torch.no_grad(), timed(stages, "eyes"):
            eyes = render_eyes(self.shown(controls), panel, rig, **self.drawn_as(controls))
            return join_eyes(eyes, self.layout).cpu().numpy()
