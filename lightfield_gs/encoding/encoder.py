"""Frame after frame for one panel: what `encode` does, without what only the first frame needs."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, background_tensor
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Output, QualityName, Views
from lightfield_gs.encoding.encode import (
    check_options,
    check_view_filter,
    check_webgpu,
    encode,
    refuse_gradients,
    wants_gradients,
)
from lightfield_gs.encoding.encoder_frames import STAGES, CpuFrameCache, CudaFrameCache
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, lenticular_camera
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.webgpu.devices import check_on_cpu


class Encoder:
    """Draw images of a panel one after the other, for animation, video or editing, by method "direct" of `encode`.

    An unchanged frame is not drawn again, and its image is the same to the bit. `stats` counts this: {"frames": n,
    "reused": {stage: number of frames that skipped it}}. There are no gradients.

    `rig` and `background` may be set between frames, and the rig altered: a moving zero plane, another cone or pose.
    The other arguments are read-only, because stages and graphs depend on them.

    On the CPU the encoder compares values with copies, so it sees any change. Each image is a tensor of its own. If
    nothing has changed, the image is copied; if only the background has changed, only the composite runs. By WebGPU
    the image is copied likewise, and any change draws the whole frame.

    On CUDA a comparison would wait for the device. The whole frame is one CUDA graph, captured for the tensors of the
    first call. Later calls with the same tensors replay it; their values may change. Then nothing waits for the device,
    and values are checked at the capture alone. Other tensors make another capture, and so does the second frame of a
    rig. For the first frame of a rig the same kernels are launched one by one, with colours as fine as the rigs so far
    needed. The rounding to bytes may then differ from `encode`, which chooses colours by its own rig. The same holds
    for a frame whose scene outgrows the capacity of earlier frames: its tiles share one list. The next frame has enough
    capacity.

    Args:
        panel: see `encode`, also for rig, views, background, output, quality, antialiased, view_filter and device.
        versioned: promise that only torch's in-place operations change values; torch counts them. Then a tensor without
            new operations counts as unchanged. Order and bins are kept if only sh changes, but not for another rig.
            torch does not count changes through .data, DLPack, CUDA graphs and other kernels: call `forget` after
            those. Inference tensors have no count and are always drawn.

    Raises:
        InputError: for arguments of other types or values.
    """

    def __init__(
        self,
        panel: Panel,
        rig: Rig,
        *,
        views: Views = "integer",
        background: Colour = (1.0, 1.0, 1.0),
        output: Output = "uint8",
        quality: QualityName | Quality = "exact",
        versioned: bool = False,
        antialiased: bool = False,
        view_filter: float = 0.0,
        device: str | None = None,
    ):
        check_options("direct", views, output)
        expect("panel", panel, Panel)
        expect("rig", rig, Rig)
        expect("versioned", versioned, bool)
        expect("antialiased", antialiased, bool)
        background_tensor(background, torch.empty(0))
        self._panel, self._views, self._output = panel, views, output
        self._view_filter = check_view_filter(view_filter)
        self._quality, self._versioned, self._antialiased = Quality.of(quality), versioned, antialiased
        if output == "float64" and not self.quality.is_exact:
            raise InputError("quality is for output 'uint8' or 'float32': 'float64' is exact only")
        if device is not None:
            check_webgpu(device, output)
        self._device = device
        self.rig, self.background = rig, background
        self.stats: dict[str, Any] = {"frames": 0, "reused": dict.fromkeys(STAGES, 0)}
        self.forget()

    @property
    def panel(self) -> Panel:
        """The panel whose images are drawn."""
        return self._panel

    @property
    def views(self) -> Views:
        """ "integer" or "continuous"."""
        return self._views

    @property
    def output(self) -> Output:
        """ "uint8", "float32" or "float64"."""
        return self._output

    @property
    def quality(self) -> Quality:
        """The allowed errors, for less time."""
        return self._quality

    @property
    def versioned(self) -> bool:
        """Whether only torch's own in-place operations change values, as promised."""
        return self._versioned

    @property
    def antialiased(self) -> bool:
        """Whether the scenes were trained with anti-aliasing."""
        return self._antialiased

    @property
    def view_filter(self) -> float:
        """Width in views of the box of camera positions over which each sub-pixel is averaged."""
        return self._view_filter

    @property
    def device(self) -> str | None:
        """The adapter of WebGPU that draws; None: the device of the Gaussians."""
        return self._device

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and pickles take: all but the memory of the frame before."""
        return {**self.__dict__, "_frames": None}

    def forget(self) -> None:
        """Draw the next frame in full, and free the memory that was kept for it."""
        self._frames: CpuFrameCache | CudaFrameCache | None = None

    def __call__(self, gaussians: Gaussians) -> Tensor:
        """Return the image [H, W, 3]. On CUDA it is the same tensor every time, which the next call overwrites.

        Raises InputError where gradients are wanted: for a float output, and Gaussians or a background that require
        one.
        """
        expect("gaussians", gaussians, Gaussians)
        if wants_gradients(gaussians.fields().values(), self.background, self.output):
            refuse_gradients("an Encoder")
        return self._draw(gaussians)

    @torch.no_grad()
    def _draw(self, gaussians: Gaussians) -> Tensor:
        expect("rig", self.rig, Rig)
        gaussians.validate_layout()
        if gaussians.is_batched:
            raise InputError(f"an Encoder takes one scene, means [N, 3], got {list(gaussians.means.shape)}")
        if self.device is not None:
            check_on_cpu(self.device, gaussians)
        on_cuda, as_bytes = gaussians.means.is_cuda, self.output == "uint8"
        if on_cuda and not (
            self.output != "float64"
            and all(t.dtype == torch.float32 and t.is_contiguous() for t in gaussians.fields().values())
        ):
            self.stats["frames"] += 1
            return encode(
                gaussians,
                self.panel,
                self.rig,
                views=self.views,
                background=self.background,
                output=self.output,
                quality=self.quality,
                antialiased=self.antialiased,
                view_filter=self.view_filter,
            )
        if not isinstance(self._frames, CudaFrameCache if on_cuda else CpuFrameCache):
            precision = torch.float64 if self.output == "float64" else torch.float32
            self._frames = (
                CudaFrameCache(as_bytes, self.quality, self.versioned, self.antialiased)
                if on_cuda
                else CpuFrameCache(precision, as_bytes, self.quality, self.antialiased, self.device)
            )
        view = lenticular_camera(self.panel, self.rig, self.views == "continuous", self.view_filter)
        image, kept = self._frames.draw(gaussians, self.background, view)
        self.stats["frames"] += 1
        for stage in kept:
            self.stats["reused"][stage] += 1
        return image
