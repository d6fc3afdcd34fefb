"""All views of a run in the memory of one device, so that a step copies no image."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from training.data.cache import CachedSet


class ResidentViews:
    """The O objects of all sets and their M views, or none: pixels on a device, everything else on the host.

    Attributes:
        first_view: [O], number of each object's view 0.
        widths_px, rectangles, squares, camera_to_world, intrinsics: as in CachedObject, with shapes [M], [M,5], [M,3],
            [M,4,4] and [M,4]. Rectangles begin with offsets into the pixels of all sets.
    """

    def __init__(self, sets: list[CachedSet], device: torch.device | str = "cpu") -> None:
        objects = [views for cached in sets for views in cached.objects]
        counts = [len(views.rectangles) for views in objects]
        self.first_view = np.cumsum([0, *counts[:-1]])
        self.widths_px = np.repeat([views.width_px for views in objects], counts)
        self.squares, self.camera_to_world, self.intrinsics = (
            np.concatenate([getattr(views, name) for views in objects]) if objects else np.zeros((0, *shape))
            for name, *shape in (("squares", 3), ("camera_to_world", 4, 4), ("intrinsics", 4))
        )
        starts = np.cumsum([0, *(len(cached.pixels) for cached in sets[:-1])])
        placed = [
            views.rectangles + [start, 0, 0, 0, 0] for start, cached in zip(starts, sets) for views in cached.objects
        ]
        self.rectangles = np.concatenate(placed) if placed else np.zeros((0, 5), np.int64)
        pixels = [torch.from_numpy(cached.pixels) for cached in sets]
        self._pixels = (torch.cat(pixels) if pixels else torch.zeros(0, dtype=torch.int32)).to(device)

    @property
    def device(self) -> torch.device:
        """Where the pixels are."""
        return self._pixels.device

    def windows(self, rectangles: Tensor, height_px: int, width_px: int) -> Tensor:
        """Return the stored parts of N views at the top left of equal windows, zero beyond them: uint8 [N,H,W,4].

        Args:
            rectangles: int64 [N,5], rows of self.rectangles on the device; none is larger than the windows.
        """
        offset, _, _, width, height = rectangles[:, :, None, None].unbind(1)
        rows = torch.arange(height_px, device=self.device)[:, None]
        columns = torch.arange(width_px, device=self.device)
        stored = (rows < height) & (columns < width)
        values = self._pixels[torch.where(stored, offset + rows * width + columns, 0)]
        # The bytes of a pixel by shifts: not every version of torch.compile takes a view as bytes
        shifts = torch.arange(0, 32, 8, dtype=torch.int32, device=self.device)
        return (torch.where(stored, values, 0)[..., None] >> shifts).bitwise_and_(255).to(torch.uint8)
