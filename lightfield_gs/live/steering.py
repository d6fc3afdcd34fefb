"""The owner's page of a live picture: depth, focus, size and all that `view` steers, for the pictures that follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from torch import Tensor

from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.page.screen_stage import ScreenStage
from lightfield_gs.show.page.server import Route
from lightfield_gs.show.page.stage import Controls, StagedScene
from lightfield_gs.show.page.steering import steering_routes
from lightfield_gs.video.rendering import FrameOptions, FrameRenderer

_FOLLOW_MS = 1000  # between two small pictures for the owner, who is not to slow the display down


class LiveStage(ScreenStage):
    """The newest scene of a live picture, on the owner's page; see Stage, also for the other arguments.

    Args:
        newest: Returns the newest picture of the panel, uint8 [H, W, 3].
        fills_screen: See Stage.
    """

    follow_ms = _FOLLOW_MS
    has_quality = False  # which holds the rate
    picture_words = "the display's picture"

    def __init__(
        self,
        scene: StagedScene,
        panel: Panel,
        newest: Callable[[], np.ndarray],
        device: str | None = None,
        fills_screen: bool = False,
    ):
        super().__init__(scene, panel, device)
        self._newest, self.fills_screen = newest, fills_screen

    def show(self, gaussians: Gaussians) -> None:
        """Take the newest scene."""
        self.scene = replace(self.scene, gaussians=gaussians)

    def native(self, controls: Controls) -> tuple[np.ndarray, dict[str, float]]:
        """Return the newest picture of the panel."""
        return self._newest(), {}

    def routes(self) -> dict[str, Route]:
        """Return the addresses of the owner's page."""
        return steering_routes(self, {})


class SteeredRenderer:
    """Draws the pictures of the panel as the owner's page says; a FrameRenderer.

    Args:
        stage: Of the owner's page.
        options: Of the drawing, but for what the page says.
        renderer: Returns what draws by options.
    """

    def __init__(self, stage: LiveStage, options: FrameOptions, renderer: Callable[[FrameOptions], FrameRenderer]):
        self._stage, self._options, self._renderer = stage, options, renderer
        self._draw = renderer(options)
        self.size_px = self._draw.size_px

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """Draw on the device of the Gaussians."""
        self._stage.show(gaussians)
        controls = self._stage.resting()
        options = replace(self._options, background=controls.colour(self._stage.scene.background))
        if options != self._options:
            self._options, self._draw = options, self._renderer(options)
        return self._draw(gaussians, controls.rig(rig, self._stage.panel), number)
