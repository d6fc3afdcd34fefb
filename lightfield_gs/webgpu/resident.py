"""The scene on a WebGPU device: copied there once for a run of frames, in parts that a binding can take."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.rasterizer.workspace import SceneTensors
from lightfield_gs.webgpu.buffers import Buffers

_THREADS = 256  # of a workgroup that projects
_GAUSSIAN_FLOATS = 12  # of the struct Gaussian in csrc/webgpu/project.wgsl


class Kept(NamedTuple):
    """Objects that stand for values: as long as they are the same objects, the device keeps what it holds.

    Attributes:
        shapes: Of means, quaternions, scales and opacities.
        harmonics: Of the harmonics.
    """

    shapes: object
    harmonics: object

    @staticmethod
    def new() -> Kept:
        """Return objects for values that no device holds yet."""
        return Kept(object(), object())

    def after(self, changed: set[str]) -> Kept:
        """Return the objects after fields of a scene have changed."""
        return Kept(object() if changed - {"sh"} else self.shapes, object() if "sh" in changed else self.harmonics)


class Part(NamedTuple):
    """Gaussians that are projected in one dispatch.

    Attributes:
        first: Number of the first one.
        size: How many.
        names: Buffers of the bindings.
    """

    first: int
    size: int
    names: dict[str, str]


class Resident:
    """The scene that a device holds."""

    def __init__(self, buffers: Buffers, most_workgroups: int) -> None:
        self.buffers, self._most = buffers, most_workgroups * _THREADS
        self._kept: Kept | None = None

    def hold(self, scene: SceneTensors, kept: Kept | None) -> list[Part]:
        """Copy to the device what it does not hold, and return the parts.

        Args:
            scene: On the CPU, in float32.
            kept: What the values were last time; None: they are new.

        Raises:
            InputError: The adapter allows no such buffer.
        """
        means, quaternions, scales, opacities, sh = (t[0] for t in scene.tensors)
        each = 4 * max(_GAUSSIAN_FLOATS, sh[:1].numel())
        size = max(min(self.buffers.limits.most_bytes // each, self._most) // _THREADS, 1) * _THREADS
        before, self._kept = self._kept, None  # so that an error below leaves nothing that counts as held
        new_shapes = kept is None or before is None or kept.shapes is not before.shapes
        new_harmonics = kept is None or before is None or kept.harmonics is not before.harmonics
        parts: list[Part] = []
        for first in range(0, scene.count, size):
            end, number = min(first + size, scene.count), len(parts)
            names = {name: f"{name} {number}" for name in ("gaussians", "harmonics")}
            if new_shapes:
                packed = torch.zeros(end - first, _GAUSSIAN_FLOATS)
                packed[:, :3], packed[:, 3] = means[first:end], opacities[first:end]
                packed[:, 4:8], packed[:, 8:11] = quaternions[first:end], scales[first:end]
                self._upload(names["gaussians"], packed)
            if new_harmonics:
                self._upload(names["harmonics"], sh[first:end].contiguous())
            parts.append(Part(first, end - first, names))
        self._kept = kept
        return parts

    def _upload(self, name: str, values: Tensor) -> None:
        data = values.numpy().reshape(-1).view(np.uint8).data
        self.buffers.storage(name, len(data), "a part of the scene")
        self.buffers.write(name, data)
