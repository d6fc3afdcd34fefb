"""Frame after frame for one panel: what `encode` does, without what only the first frame needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from lightfield_gs import ops, rendering
from lightfield_gs.errors import InputError, expect
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.panel import Panel
from lightfield_gs.quality import Quality
from lightfield_gs.rig import Rig

if TYPE_CHECKING:
    from lightfield_gs.frame_cuda import Frame, FrameKind


class Encoder:
    """Draws the image of a panel again and again: animations, video, a scene under edit. Method "direct" of `encode`.

    panel, rig, views, background, output ("uint8" or "float32") and quality are those of `encode`. On CUDA the whole
    frame, from the Gaussians to the image, is one CUDA graph, captured for the tensors of the first call and replayed
    as long as the same tensors come, whose values may change: nothing waits for the device then, and values are checked
    at the capture only. Other tensors make another capture. On the CPU every call is an `encode`. No gradients. Raises
    InputError.
    """

    def __init__(self, panel: Panel, rig: Rig, *, views: str = "integer",
                 background: Sequence[float] | Tensor = (1.0, 1.0, 1.0), output: str = "uint8",
                 quality: str | Quality = "exact"):
        rendering.check_options("direct", views, output)
        expect("panel", panel, Panel)
        expect("rig", rig, Rig)
        rendering.background_tensor(background, torch.empty(0))
        self.quality = Quality.of(quality)
        if output == "float64" and not self.quality.is_exact:
            raise InputError("quality is for output 'uint8' or 'float32': 'float64' is exact only")
        self.panel, self.rig, self.views, self.background, self.output = panel, rig, views, background, output
        self._arguments = rendering.lens_arguments(panel, rig, views == "continuous")
        self._captured: _Capture | None = None

    @torch.no_grad()
    def __call__(self, gaussians: Gaussians) -> Tensor:
        """The image [H, W, 3]. On CUDA it is the same tensor every time: the next call draws over it."""
        expect("gaussians", gaussians, Gaussians)
        gaussians.validate_layout()
        fields = list(gaussians.fields().values())
        if not (gaussians.means.is_cuda and self.output != "float64"
                and all(t.dtype == torch.float32 and t.is_contiguous() for t in fields)):
            return rendering.encode(gaussians, self.panel, self.rig, views=self.views, background=self.background,
                                    output=self.output, quality=self.quality)
        if self._captured is None or not self._captured.reads(fields):
            gaussians.validate()
            background = rendering.background_tensor(self.background, gaussians.means).reshape(-1)
            self._captured = _Capture(fields, background, self._arguments, self.output == "uint8",
                                      self.quality)
        return self._captured.replay()


class _Capture:
    """One frame as a CUDA graph."""

    def __init__(self, fields: list[Tensor], background: Tensor, arguments: tuple, as_bytes: bool,
                 quality: Quality):
        self.fields = fields
        self.job = ops.LensArguments(*fields, background, *arguments)
        self.kind: FrameKind = ops.frame_kind(self.job, quality)
        with self.job.scene.guard:
            self.image = self.job.image(as_bytes)
            self._capture()

    def reads(self, fields: list[Tensor]) -> bool:
        return all(a.data_ptr() == b.data_ptr() and a.shape == b.shape for a, b in zip(self.fields, fields))

    def replay(self) -> Tensor:
        with self.job.scene.guard:
            if self.kind.adapt():
                self._capture()
            self.graph.replay()
            self.kind.mark()
        return self.image

    def _capture(self) -> None:
        self.frame: Frame = self.kind.frame(self.job.scene)
        torch.cuda.synchronize()
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.frame.draw(self.job.background, self.image)
            self.kind.note(self.frame)
