"""The photographs of a fit and their cameras, in tensors that a step can take any of without waiting."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.assumptions import assume
from lightfield_gs.fitting.settings import Masks
from lightfield_gs.fitting.world import World
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.scene.cameras import Cameras


@dataclass
class Views:
    """C photographs of one size. Smaller ones stand in the upper left of it, and count nowhere else.

    photos [C,H,W,3] uint8; weights [C,H,W] uint8, 255 where a photograph counts, or None where all do; world_to_camera
    [C,4,4], intrinsics [C,4] and limits [C,5] float32 in coordinates of the fit; sizes [C,2], width and height. opacity
    [C,H,W] uint8: how opaque the scene is to be, by masks that are the target of its alpha; None: no mask is.
    """

    names: list[str]
    photos: Tensor
    weights: Tensor | None
    world_to_camera: Tensor
    intrinsics: Tensor
    limits: Tensor
    sizes: list[tuple[int, int]]
    opacity: Tensor | None = None
    _staged: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def load(
        cls,
        capture: Capture,
        indices: Sequence[int],
        world: World,
        device: str,
        ticks: Iterable[int],
        masks: Masks = "ignore",
        on_host: bool = False,
    ) -> Views:
        """Those of a capture, on a device. ticks: `indices` once more, to show how far the reading is.

        masks: what they and the photographs' alpha leave out counts nowhere ("ignore"), or is transparent ("alpha").
        What lies beyond a distorted photograph's frame counts nowhere in either case. on_host: photographs and masks
        stay in the host's memory, see stage.
        """
        where = "cpu" if on_host else device
        sizes = [(int(w), int(h)) for w, h in capture.sizes_px[list(indices)]]
        width, height = (max(side) for side in zip(*sizes))
        if len(set(sizes)) > 1:
            wasted = 1 - sum(w * h for w, h in sizes) / (len(sizes) * width * height)
            assume(
                f"photographs are of {len(set(sizes))} sizes: all are drawn as {width} x {height}, {wasted:.0%} more"
            )
        photos = np.zeros((len(sizes), height, width, 3), np.uint8)
        weights = np.zeros((len(sizes), height, width), np.uint8)
        opacity = np.full_like(weights if masks == "alpha" else weights[:0], 255)
        for place, (index, (w, h)) in enumerate(zip(ticks, sizes)):
            photos[place, :h, :w] = capture.image(index)
            counts = capture.valid_area(index) if masks == "alpha" else capture.mask(index)
            weights[place, :h, :w] = 255 if counts is None else counts
            opaque = capture.opacity(index) if masks == "alpha" else None
            if opaque is not None:
                opacity[place, :h, :w] = opaque
        focal, principal = torch.from_numpy(capture.intrinsics[list(indices)]).split(2, -1)
        poses = torch.from_numpy(world.poses(capture.world_to_camera[list(indices)]))
        cameras = Cameras(poses, focal, principal, width, height)
        return cls(
            [capture.names[index] for index in indices],
            torch.from_numpy(photos).to(where),
            None if weights.min() == 255 else torch.from_numpy(weights).to(where),
            cameras.world_to_camera.float().to(device),
            cameras.intrinsics().float().to(device),
            cameras.limits().float().to(device),
            sizes,
            None if opacity.size == 0 or opacity.min() == 255 else torch.from_numpy(opacity).to(where),
        )

    def targets(self, indices: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the views `indices` [V] over a background `behind` [V,3] are to look like, [V,H,W,3], uint8 or float32;
        and weights [V,H,W] in 0..1 where there are any.

        A photograph whose masks are the target of alpha stands over the background: so an alpha below the mask's shows
        in the loss, whatever the background, and more so with another one at each step.
        """
        photos, weights = self._chosen("photos", indices), self._chosen("weights", indices)
        assert photos is not None
        weights = None if weights is None else weights / 255
        opacity = self._chosen("opacity", indices)
        if opacity is None:
            return photos, weights
        alpha = opacity[..., None] / 255
        return photos / 255 * alpha + (1 - alpha) * behind[:, None, None], weights

    @property
    def on_host(self) -> bool:
        """Whether the photographs are in the host's memory, and the fit on another device."""
        return self.photos.device != self.device

    def stage(self, indices: Tensor) -> None:
        """Has the device copy the photographs at `indices` [V], of the host, to where the next `targets` finds them.

        Does nothing where all are on the device. What is copied has its place in memory once and for all, so that a
        CUDA graph finds it, and the copies wait in the stream until the steps before have read theirs.
        """
        if not self.on_host:
            return
        for name in ("photos", "weights", "opacity"):
            stored = getattr(self, name)
            if stored is None:
                continue
            found = stored.index_select(0, indices).pin_memory()
            if name not in self._staged or self._staged[name].shape != found.shape:
                self._staged[name] = torch.empty_like(found, device=self.device)
            self._staged[name].copy_(found, non_blocking=True)

    def _chosen(self, name: str, indices: Tensor) -> Tensor | None:
        """photos, weights or opacity at `indices`, or what is staged of them."""
        stored = getattr(self, name)
        if stored is None:
            return None
        return self._staged[name] if self.on_host else stored.index_select(0, indices)

    def counts(self, place: int) -> Tensor:
        """[H,W] float32: how much each pixel of a photograph counts, 0..1."""
        if self.weights is None:
            return torch.ones(self.height_px, self.width_px, device=self.device)
        return self.weights[place].to(self.device) / 255

    def masked_out(self) -> list[int]:
        """Places of the photographs of which masks leave less than a pixel: to count, or to be opaque."""
        fields = [stored for stored in (self.weights, self.opacity) if stored is not None]
        return [p for p in range(self.count) if any(int(stored[p].sum(dtype=torch.int64)) < 255 for stored in fields)]

    def some(self, places: Sequence[int]) -> Views:
        """Those at these places."""
        chosen = list(places)
        return replace(
            self,
            names=[self.names[place] for place in chosen],
            photos=self.photos[chosen],
            weights=None if self.weights is None else self.weights[chosen],
            world_to_camera=self.world_to_camera[chosen],
            intrinsics=self.intrinsics[chosen],
            limits=self.limits[chosen],
            sizes=[self.sizes[place] for place in chosen],
            opacity=None if self.opacity is None else self.opacity[chosen],
        )

    @property
    def device(self) -> torch.device:
        """Where the fit is."""
        return self.world_to_camera.device

    def cameras(self, place: int | None = None) -> Cameras:
        """The cameras of all, or of one of them, each as large as all photographs."""
        some = slice(None) if place is None else slice(place, place + 1)
        poses, intrinsics, limits = (t[some] for t in (self.world_to_camera, self.intrinsics, self.limits))
        focal, centre = intrinsics.split(2, -1)
        return Cameras(poses, focal, centre, self.width_px, self.height_px, jacobian_limits=limits)

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
