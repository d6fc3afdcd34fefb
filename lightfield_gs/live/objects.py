"""The Gaussians of the object in each picture: cut out, and through the network."""

from __future__ import annotations

from pathlib import Path

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
from lightfield_gs.photo.quick_cut import cut_along, find_outline
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

    def __call__(self, picture: Picture) -> Gaussians:
        """Return the Gaussians; on CUDA their number is always the same. Raises InputError where there is no object."""
        rgba = self._cut(picture)
        level = self._level(max(picture.pixels.shape[:2]))
        if self._device.type == "cpu":
            return self._net.predict(rgba, level)
        graphs = self._graphs
        if graphs is None or graphs.photo.shape != rgba.shape or graphs.photo.dtype != rgba.dtype:
            self._graphs = graphs = PhotoGraphs(self._net, rgba, level)
        graphs.crop(rgba)
        graphs.network.replay()
        graphs.check()
        return from_tensors(field.clone() for field in graphs.gaussians.fields().values())

    def _level(self, photo_px: int) -> DetailLevel | None:
        detail, budget = network_detail(self._photo)
        return detail_level(detail, self._net.config, photo_px, self._panel, budget)

    def _cut(self, picture: Picture) -> Tensor:
        """Return the picture as RGBA, where the network is; on the CPU the part with the object alone."""
        pixels, photo = picture.pixels, self._photo
        is_plain = pixels.dtype == np.uint8 and pixels.shape[2] == 3 and photo.clean_edges is not False
        if not is_plain or photo.remove_background:
            clean = photo.clean_edges is not False
            cut = cut_out_photo(self._name, picture, remove_background=photo.remove_background, clean_edges=clean)
            return torch.from_numpy(cut.pixels)
        outline = find_outline(pixels, str(self._name))
        if self._device.type == "cpu":
            return cut_along(torch.from_numpy(pixels), outline, outline.box(pixels.shape[0], pixels.shape[1]))
        return cut_along(to_device(pixels, self._device), outline.to(self._device))


def to_device(pixels: np.ndarray, device: torch.device) -> Tensor:
    """Return pixels on a device; to CUDA they go through page-locked memory, and nothing waits."""
    values = torch.from_numpy(pixels)
    return values if device.type == "cpu" else values.pin_memory().to(device, non_blocking=True)
