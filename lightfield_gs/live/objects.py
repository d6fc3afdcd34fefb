"""The Gaussians of the object in each picture: cut out, and through the network."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.app.photo import load_network, network_detail
from lightfield_gs.io.images import Picture
from lightfield_gs.models.detail import DetailLevel
from lightfield_gs.panels.panel import Panel
from lightfield_gs.photo.detail_level import detail_level
from lightfield_gs.photo.encoder import PhotoGraphs, quick_copy
from lightfield_gs.photo.load import cut_out_photo
from lightfield_gs.photo.quick_cut import Outline, cut_along, find_outline
from lightfield_gs.scene.gaussians import Gaussians, from_tensors


class LiveObjects:
    """Makes the Gaussians of the object in picture after picture.

    On CUDA the cut-out's edges, the crop and the network work where the Gaussians are, the latter two as graphs.

    Args:
        name: Of the source, for messages.
        photo: How its pictures are taken.
        panel: Decides how finely they are.
        device: "cpu" or "cuda".
    """

    def __init__(self, name: Path, photo: PhotoOptions, panel: Panel, device: str):
        self._name, self._photo, self._panel = name, photo, panel
        self._device = torch.device(device)
        self._net = load_network(photo.checkpoint, device).net
        if self._device.type == "cuda":
            with torch.inference_mode(False):
                self._net = quick_copy(self._net)
        self._graphs: PhotoGraphs | None = None

    def read(self, picture: Picture) -> Found:
        """Find the object in a picture, on the host. Raises InputError where there is none."""
        pixels, photo = picture.pixels, self._photo
        is_plain = pixels.dtype == np.uint8 and pixels.shape[2] == 3 and photo.clean_edges is not False
        if is_plain and not photo.remove_background:
            return Found(pixels, find_outline(pixels, str(self._name)))
        clean = photo.clean_edges is not False
        cut = cut_out_photo(self._name, picture, remove_background=photo.remove_background, clean_edges=clean)
        return Found(cut.pixels, None)

    def __call__(self, found: Found) -> Gaussians:
        """Return the Gaussians; on CUDA their number is always the same."""
        rgba = self._cut(found)
        level = self._level(max(found.pixels.shape[:2]))
        if self._device.type == "cpu":
            return self._net.predict(rgba, level)
        graphs = self._graphs
        if graphs is None or graphs.photo.shape != rgba.shape or graphs.photo.dtype != rgba.dtype:
            self._graphs = graphs = PhotoGraphs(self._net, rgba, level)
        graphs.crop(rgba)
        graphs.network.replay()
        return from_tensors(field.clone() for field in graphs.gaussians.fields().values())

    def _level(self, photo_px: int) -> DetailLevel | None:
        detail, budget = network_detail(self._photo)
        return detail_level(detail, self._net.config, photo_px, self._panel, budget)

    def _cut(self, found: Found) -> Tensor:
        """Return the picture as RGBA, where the network is; on the CPU the part with the object alone."""
        outline, pixels = found.outline, to_device(found.pixels, self._device)
        if outline is None:
            return pixels
        box = outline.box(pixels.shape[0], pixels.shape[1]) if self._device.type == "cpu" else None
        return cut_along(pixels, outline.to(self._device), box)


class Found(NamedTuple):
    """An object in a picture.

    Attributes:
        pixels: [H, W, 3], or [H, W, 4] where it is cut out.
        outline: Where it is not: by what.
    """

    pixels: np.ndarray
    outline: Outline | None


def to_device(pixels: np.ndarray, device: torch.device) -> Tensor:
    """Return pixels on a device; to CUDA they go through page-locked memory, and nothing waits."""
    values = torch.from_numpy(pixels)
    return values if device.type == "cpu" else values.pin_memory().to(device, non_blocking=True)
