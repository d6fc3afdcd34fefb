"""A scene on a screen of two eyes, drawn for the page: in place of a panel's picture there is that of both eyes."""

from __future__ import annotations

import numpy as np
import torch

from lightfield_gs.base.options import StereoLayout
from lightfield_gs.encoding.stereo import join_eyes, render_eyes
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.screen_stage import ScreenStage
from lightfield_gs.show.page.stage import Controls, StagedScene, timed


class StereoStage(ScreenStage):
    """Draws the pictures of the page; see Stage, also for the other arguments.

    Args:
        panel: Of a StereoScreen.
        layout: One image of both eyes.
    """

    fills_screen = True
    has_quality = False  # pictures of eyes are exact always

    def __init__(self, scene: StagedScene, panel: Panel, layout: StereoLayout, device: str | None = None):
        super().__init__(scene, panel, device)
        self.layout = layout
        self.picture_words = f"both eyes' picture, {layout}"

    def _encoded(self, panel: Panel, rig: Rig, controls: Controls, stats: dict | None = None) -> np.ndarray:
        stages = {} if stats is None else stats.setdefault("stages_ms", {})
        with torch.no_grad(), timed(stages, "eyes"):
            eyes = render_eyes(self.shown(controls), panel, rig, **self.drawn_as(controls))
            return join_eyes(eyes, self.layout).cpu().numpy()
