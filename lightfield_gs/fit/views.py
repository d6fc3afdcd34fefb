"""The photographs of a fit and their cameras, in tensors that a step can take any of without waiting."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.assumptions import assume
from lightfield_gs.fit.world import World
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.scene.cameras import Cameras


@dataclass
class Views:
    """C photographs of one size. Smaller ones stand in the upper left of it, and count nowhere else.

    photos [C,H,W,3] uint8; weights [C,H,W] uint8, 255 where a photograph counts, or None where all do; world_to_camera
    [C,4,4], intrinsics [C,4] and limits [C,5] float32 in coordinates of the fit; sizes [C,2], width and height.
    """

    names: list[str]
    photos: Tensor
    weights: Tensor | None
    world_to_camera: Tensor
    intrinsics: Tensor
    limits: Tensor
    sizes: list[tuple[int, int]]

    @classmethod
    def load(cls, capture: Capture, indices: Sequence[int], world: World, device: str, ticks: Iterable[int]) -> Views:
        """Those of a capture, on a device. ticks: `indices` once more, to show how far the reading is."""
        sizes = [(int(w), int(h)) for w, h in capture.sizes_px[list(indices)]]
        width, height = (max(side) for side in zip(*sizes))
        if len(set(sizes)) > 1:
            wasted = 1 - sum(w * h for w, h in sizes) / (len(sizes) * width * height)
            assume(
                f"photographs are of {len(set(sizes))} sizes: all are drawn as {width} x {height}, {wasted:.0%} more"
            )
        photos = np.zeros((len(sizes), height, width, 3), np.uint8)
        weights = np.zeros((len(sizes), height, width), np.uint8)
        for place, (index, (w, h)) in enumerate(zip(ticks, sizes)):
            photos[place, :h, :w] = capture.image(index)
            mask = capture.mask(index)
            weights[place, :h, :w] = 255 if mask is None else mask
        cameras = Cameras(
            torch.from_numpy(world.poses(capture.world_to_camera[list(indices)])),
            *torch.from_numpy(capture.intrinsics[list(indices)]).split(2, -1),
            width,
            height,
        )
        return cls(
            [capture.names[index] for index in indices],
            torch.from_numpy(photos).to(device),
            None if weights.all() else torch.from_numpy(weights).to(device),
            *(t.float().to(device) for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())),
            sizes,
        )

    def chosen(self, indices: Tensor) -> tuple[Tensor, Tensor | None]:
        """The photographs at `indices` [V], and weights 0..1 where there are any."""
        weights = None if self.weights is None else self.weights.index_select(0, indices) / 255
        return self.photos.index_select(0, indices), weights

    def counts(self, place: int) -> Tensor:
        """[H,W] float32: how much each pixel of a photograph counts, 0..1."""
        if self.weights is None:
            return torch.ones(self.height_px, self.width_px, device=self.photos.device)
        return self.weights[place] / 255

    @property
    def count(self) -> int:
        """C."""
        return len(self.names)

    @property
    def height_px(self) -> int:
        return self.photos.shape[1]

    @property
    def width_px(self) -> int:
        return self.photos.shape[2]
