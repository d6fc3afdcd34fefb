"""What is drawn of each frame: the native picture of the panel, a quilt, or what one eye sees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from lightfield_gs.base.arrays import Colour, bytes_of
from lightfield_gs.base.options import QualityName, Views
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.encoding.quilt import quilt
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout
from lightfield_gs.panels.rig import Rig, reduced
from lightfield_gs.scene.gaussians import Gaussians

_EYE_WIDTH_PX = 1920


@dataclass
class Drawing:
    """How a scene is drawn; see `encode`."""

    views: Views = "integer"
    background: Colour = (1.0, 1.0, 1.0)
    quality: QualityName = "exact"
    antialiased: bool = False
    view_filter: float = 0.0

    def of_views(self) -> dict[str, Any]:
        """What of it concerns views that are pictures by themselves."""
        return {name: getattr(self, name) for name in ("background", "antialiased", "view_filter")}


class NativeFrames:
    """The picture of the panel, uint8 [H, W, 3]: what `encode` draws by its method direct.

    is_one_scene: all frames show the same Gaussians, so that an Encoder keeps what does not change; on CUDA it may then
    round colours otherwise than `encode`. Else each frame is one call of `encode`: an Encoder would make a CUDA graph
    for every scene.
    """

    def __init__(self, panel: Panel, drawing: Drawing, is_one_scene: bool):
        self.size_px = panel.width_px, panel.height_px
        self._panel, self._drawing, self._is_one_scene = panel, drawing, is_one_scene
        self._encoder: Encoder | None = None

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """The picture, on the device of the Gaussians; on CUDA the next call may draw over it."""
        how = vars(self._drawing)
        if not self._is_one_scene:
            return encode(gaussians, self._panel, rig, **how)
        if self._encoder is None:
            self._encoder = Encoder(self._panel, rig, **how)
        self._encoder.rig = rig
        return self._encoder(gaussians)


class QuiltFrames:
    """All views as tiles of one picture, uint8 [H, W, 3].

    panel: whose picture the rig is for, of the views' aspect. layout: with its size.
    """

    def __init__(self, panel: Panel, drawing: Drawing, layout: QuiltLayout):
        self.size_px = layout.width_px or 0, layout.height_px or 0
        self._panel, self._drawing, self._layout = panel, drawing, layout

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """The quilt, on the device of the Gaussians."""
        tile, fan = self._layout.fitted(self._panel, rig)
        return quilt(gaussians, self._layout, fan, tile, **self._drawing.of_views())


class EyeFrames:
    """What one eye sees, of 1920 pixels in width at most and of even sides, as 2D video needs; uint8 [h, w, 3].

    sway: frames in which the eye goes from the middle to the right, to the left and back; None: it stays in the middle.
    """

    def __init__(self, panel: Panel, drawing: Drawing, sway: float | None = None):
        width = min(_EYE_WIDTH_PX, panel.width_px)
        height = round(panel.height_px * width / panel.width_px)
        self.size_px = max(2, width - width % 2), max(2, height - height % 2)
        self._panel, self._drawing, self._sway = panel, drawing, sway

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """The view, on the device of the Gaussians."""
        small, rig = reduced(self._panel, rig, self.size_px[0])
        small = replace(small, width_px=self.size_px[0], height_px=self.size_px[1])
        share = 0.0 if self._sway is None else math.sin(2 * math.pi * number / self._sway)
        side = -1 if self._panel.invert_views else 1
        place = small.views / 2 - side * share * (small.views - 1) / 2
        return bytes_of(render_views(gaussians, small, rig, [place], **self._drawing.of_views())[0])
