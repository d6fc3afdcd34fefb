"""Draw scene after scene of one rig: on CUDA as one graph, into whose memory each scene is copied."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.live.detail import Detail
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians, from_tensors
from lightfield_gs.video.rendering import FrameOptions, NativeRenderer


class LiveRenderer:
    """Renders the image of the panel, uint8 [H, W, 3], as NativeRenderer does.

    On CUDA scenes of one number of Gaussians replay one graph. Its colours may be rounded otherwise than by `encode`.

    Args:
        panel: The panel.
        options: Of the rendering.
        detail: Its quality may become another.
    """

    def __init__(self, panel: Panel, options: FrameOptions, detail: Detail):
        self.size_px = panel.width_px, panel.height_px
        self._panel, self._options, self._detail = panel, options, detail
        self._native = NativeRenderer(panel, options, False)
        self._encoder: Encoder | None = None
        self._scene: Gaussians | None = None

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor:
        """Render on the device of the Gaussians, into memory of its own."""
        if self._options.quality != self._detail.quality:
            self._options = replace(self._options, quality=self._detail.quality)
            self._native, self._encoder = NativeRenderer(self._panel, self._options, False), None
        if not gaussians.means.is_cuda:
            return self._native(gaussians, rig, number)
        if self._encoder is None:
            self._encoder = Encoder(self._panel, rig, **vars(self._options))
        self._encoder.rig = rig
        if self._scene is None or self._scene.count != gaussians.count:
            self._scene = from_tensors(field.clone() for field in gaussians.fields().values())
        stream = torch.cuda.current_stream(gaussians.means.device)
        for own, given in zip(self._scene.fields().values(), gaussians.fields().values()):
            own.copy_(given)
            given.record_stream(stream)  # it is of the thread that made the scene
        return self._encoder(self._scene).clone()
