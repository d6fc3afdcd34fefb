"""Images of a panel from photo after photo: crop, network, framing and encoding in one go."""

from __future__ import annotations

import copy
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, background_tensor
from lightfield_gs.base.checks import expect
from lightfield_gs.base.device import capture_graph
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Detail, Output, QualityName, Views
from lightfield_gs.encoding.encode import check_options, check_webgpu, encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.models import crop
from lightfield_gs.models.crop import crop_on_device
from lightfield_gs.models.detail import DetailLevel
from lightfield_gs.models.splatter_net import SplatterNet, check_values, checked_photo
from lightfield_gs.panels.content import photo_extent
from lightfield_gs.panels.look import Look
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, frame_extent, frame_photo, lenticular_camera
from lightfield_gs.photo.detail_level import DEFAULT_BUDGET, detail_level
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.frame_cuda import DirectFrames
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.gaussians import Gaussians


class PhotoEncoder:
    """Draw the object in a photo for a panel: SplatterNet.predict, frame_photo and `encode` in one faster call.

    On CUDA the U-Net runs in bfloat16. Crop, network and framing are CUDA graphs, captured for the first photo of each
    size. The host waits for the device once a photo, for the position of the object. With a rig of all photos the frame
    is a graph too, and the host waits for nothing but the crop, while the network and the frame are under way.

    Args:
        net: The network, on the device to work on. The encoder copies its weights when it is made.
        panel: See `encode`.
        views: See `encode`.
        background: See `encode`.
        output: "uint8" or "float32".
        quality: See `encode`.
        look: Changes of the automatic framing of each photo; it may be set between photos.
        rig: Of all photos, as of pictures of a film. None: each is framed by itself.
        detail: See SplatterNet.predict.
        budget: See SplatterNet.predict.
        device: See `encode`; the network works on the CPU then.

    Raises:
        InputError: An argument is invalid.
    """

    def __init__(
        self,
        net: SplatterNet,
        panel: Panel,
        *,
        views: Views = "integer",
        background: Colour = (1.0, 1.0, 1.0),
        output: Output = "uint8",
        quality: QualityName | Quality = "exact",
        look: Look | None = None,
        rig: Rig | None = None,
        detail: Detail | None = None,
        budget: int = DEFAULT_BUDGET,
        device: str | None = None,
    ):
        self.quality = Quality.of(quality)
        check_options("direct", views, output)
        expect("net", net, SplatterNet)
        expect("panel", panel, Panel)
        expect("look", look, Look, type(None))
        expect("rig", rig, Rig, type(None))
        if rig is not None and look is not None:
            raise InputError("a look changes the framing of each photo, and rig= has none; apply it to the rig first")
        background_tensor(background, torch.empty(0))
        if output == "float64":
            raise InputError("a PhotoEncoder puts out uint8 or float32, got 'float64'")
        if device is not None:
            check_webgpu(device, output)
            if net.device.type != "cpu":
                raise InputError(f"device={device!r} takes a network on the CPU, got {net.device}: use net.to('cpu')")
        self.device = device
        self.panel, self.views, self.background, self.output = panel, views, background, output
        self.net = quick_copy(net)
        self.look, self.detail, self.budget = look, detail, budget
        self._level(1)  # raises the errors that any photo would raise
        self.gaussians: Gaussians | None = None
        self.rig = rig
        self._captured: PhotoGraphs | None = None
        self._frames: DirectFrames | None = None
        how: dict[str, Any] = dict(views=views, background=background, output=output, quality=self.quality)
        self._fixed = None if rig is None else Encoder(panel, rig, device=device, **how)

    @torch.no_grad()
    def __call__(self, rgba: np.ndarray | Tensor, stats: dict[str, Any] | None = None) -> Tensor:
        """Return the image [H, W, 3] of a photo, on the network's device.

        Afterwards `gaussians` and `rig` belong to the image. On CUDA the next call overwrites the Gaussians, and they
        include invisible Gaussians.

        Args:
            rgba: A photo as SplatterNet.predict takes it.
            stats: A dict to fill with stages_ms, of crop, network, framing and encode (on CUDA they wait for each other
                then).

        Raises:
            InputError: The photo is invalid, or has no object.
        """
        expect("stats", stats, dict, type(None))
        photo = checked_photo(rgba)
        counters = Stats(device=self.net.device if stats is not None else None)
        draw = self._draw_on_cuda if self.net.device.type == "cuda" else self._draw_on_cpu
        image = draw(photo, counters)
        if stats is not None:
            stats.update(stages_ms=dict(counters.stages_ms))
        return image

    def _level(self, photo_px: int) -> DetailLevel | None:
        return detail_level(self.detail, self.net.config, photo_px, self.panel, self.budget)

    def _draw_on_cpu(self, photo: Tensor, stats: Stats) -> Tensor:
        with stats.stage("crop"):
            level = self._level(max(photo.shape[:2]))
            cropped, fine = self.net.crops(photo, level)
        with stats.stage("network"):
            self.gaussians = self.net.visible_gaussians(cropped, fine, level)
        with stats.stage("framing"):
            if self._fixed is None:
                self.rig = self._looked(frame_photo(self.gaussians, self.panel), self.gaussians)
        with stats.stage("encode"):
            if self._fixed is not None:
                return self._fixed(self.gaussians)
            how: dict[str, Any] = dict(views=self.views, background=self.background, output=self.output)
            return encode(self.gaussians, self.panel, self.rig, quality=self.quality, device=self.device, **how)

    def _draw_on_cuda(self, photo: Tensor, stats: Stats) -> Tensor:
        with torch.cuda.device(self.net.device):
            graphs, kind = self._captured, (photo.shape, photo.dtype)
            if graphs is None or kind != (graphs.photo.shape, graphs.photo.dtype):
                self._captured = graphs = PhotoGraphs(self.net, photo, self._level(max(photo.shape[:2])))
            with stats.stage("crop"):
                graphs.crop(photo)
            with stats.stage("network"):
                graphs.network.replay()
            with stats.stage("framing"):
                self.gaussians = graphs.gaussians
                if self._fixed is None:
                    self.rig = self._looked(graphs.rig(self.panel), self.gaussians)
            with stats.stage("encode"):
                if self._fixed is None:
                    return self._draw_frame(self.gaussians, cast(Rig, self.rig))
                image = self._fixed(self.gaussians)
            graphs.check()
            return image

    def _looked(self, rig: Rig, gaussians: Gaussians) -> Rig:
        return rig if self.look is None else self.look.applied(rig, self.panel, gaussians)

    def _draw_frame(self, gaussians: Gaussians, rig: Rig) -> Tensor:
        """Launch the frame's kernels one by one: the rig, another for each photo, is part of their arguments."""
        background = background_tensor(self.background, gaussians.means).reshape(-1)
        view = lenticular_camera(self.panel, rig, self.views == "continuous")
        job = DirectRender(gaussians.fields().values(), background, view)
        if self._frames is None:
            self._frames = DirectFrames(job, self.quality)
        return self._frames.draw(job, self.output == "uint8")


def quick_copy(net: SplatterNet) -> SplatterNet:
    """Return a copy of a network for photo after photo: on CUDA its U-Net is in bfloat16."""
    net = copy.deepcopy(net).eval()
    if net.device.type == "cuda":
        # torch takes memory_format of a module too, which its stub does not know
        net.unet.to(torch.bfloat16, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return net


class PhotoGraphs:
    """Crop, network and framing of photos of one size and type as CUDA graphs.

    Attributes:
        network: The graph from the crop to the Gaussians.
        gaussians: Of the last photo, with invisible ones; the next replay of `network` writes over them.
    """

    def __init__(self, net: SplatterNet, photo: Tensor, level: DetailLevel | None):
        self.net, self.intrinsics, self.level = net, net.photo_intrinsics(), level
        self.host = torch.empty(photo.shape, dtype=photo.dtype, pin_memory=True)
        self.photo = torch.empty(photo.shape, dtype=photo.dtype, device=net.device)
        self.photo.copy_(photo)
        self._crop, (self.cropped, self.fine, self.checks) = capture_graph(self._cropped, warm_up=True)
        self.network, self.gaussians = capture_graph(
            lambda: net.all_gaussians(self.cropped, self.intrinsics, self.fine, level), warm_up=True
        )
        self._framing, self.numbers = capture_graph(
            lambda: torch.cat([self.checks, photo_extent(self.gaussians)]), warm_up=True
        )
        self._host_checks = torch.empty_like(self.checks, device="cpu", pin_memory=True)
        self._checked = torch.cuda.Event()

    def crop(self, photo: Tensor) -> None:
        """Cut the object out of a photo; one on the host goes through pinned memory, which the last photo has left."""
        if not photo.is_cuda:
            photo = self.host.copy_(photo)
        self.photo.copy_(photo, non_blocking=True)
        self._crop.replay()
        self._host_checks.copy_(self.checks, non_blocking=True)
        self._checked.record()

    def check(self) -> None:
        """Wait for the crop, and raise InputError for an invalid photo."""
        self._checked.synchronize()
        values_in_range, has_object = self._host_checks.tolist()
        check_values(values_in_range)
        crop.check_object(has_object)

    def rig(self, panel: Panel) -> Rig:
        """Return the rig of these Gaussians, after waiting for the device; raise InputError for an invalid photo."""
        self._framing.replay()
        values_in_range, has_object, *extent = self.numbers.tolist()
        check_values(values_in_range)
        crop.check_object(has_object)
        return frame_extent(extent, panel)

    def _cropped(self) -> tuple[Tensor, Tensor | None, Tensor]:
        size = self.net.config.image_size_px
        factors = [1] if self.level is None else [1, self.level.factor]
        checks, (cropped, *fine) = crop_on_device(self.photo, [size * factor for factor in factors])
        return cropped, fine[0] if fine else None, checks
