"""What is drawn of each frame: the native picture of the panel, a quilt, or what one eye sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, bytes_of
from lightfield_gs.base.options import QualityName, Views
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, reduced
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.video.quilt_tiles import QuiltTiles

_MOST_PIXELS = 4_000_000  # of views that are rendered at a time, so that small ones go in batches
_EYE_WIDTH_PX = 1920


@dataclass
class Drawing:
    """How a scene is drawn; see `encode`."""

    views: Views = "integer"
    background: Colour = (1.0, 1.0, 1.0)
    quality: QualityName = "exact"
    antialiased: bool = False


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
    """All views as tiles of one picture, uint8 [H, W, 3]."""

    def __init__(self, panel: Panel, drawing: Drawing, tiles: QuiltTiles):
        self.size_px = tiles.size_px
        self._tiles, self._drawing = tiles, drawing
        self._panel = replace(panel, width_px=tiles.tile_px[0], height_px=tiles.tile_px[1], views=tiles.views)
        self._scale = tiles.tile_px[0] / panel.width_px, tiles.tile_px[1] / panel.height_px
        order = range(tiles.views - 1, -1, -1)  # a quilt's first view is the left-most camera, a panel's goes right
        self._places = [view + 0.5 for view in (reversed(order) if panel.invert_views else order)]

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """The quilt, on the device of the Gaussians."""
        (fx, fy), (cx, cy), (x, y) = rig.focal_px, rig.principal_point_px, self._scale
        rig = replace(rig, focal_px=(fx * x, fy * y), principal_point_px=(cx * x, cy * y))
        views = rendered(gaussians, self._panel, rig, self._places, self._drawing)
        return self._tiles.joined(views)


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
        return rendered(gaussians, small, rig, [place], self._drawing)[0]


def rendered(gaussians: Gaussians, panel: Panel, rig: Rig, places: Sequence[float], drawing: Drawing) -> Tensor:
    """Views at these places x of the rig, uint8 [C, H, W, 3], at the panel's size."""
    each = max(1, _MOST_PIXELS // (panel.width_px * panel.height_px))
    parts = []
    for first in range(0, len(places), each):
        cameras = rig.cameras_at(panel, places[first : first + each])
        images = render(gaussians, cameras, background=drawing.background, antialiased=drawing.antialiased)
        parts.append(bytes_of(images))
    return torch.cat(parts)
