"""What a render is made from, checked, and what it leaves to its reverse."""

from __future__ import annotations

import copy
from contextlib import AbstractContextManager
from types import ModuleType
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.cuda import device_guard
from lightfield_gs.base.errors import InputError


class Place(Protocol):
    """Where values are, and of which type: a tensor, or a Scene."""

    @property
    def dtype(self) -> torch.dtype: ...
    @property
    def device(self) -> torch.device: ...


def _devices() -> str:
    """Where this build can render, in words for messages."""
    return "CPU or CUDA" if hasattr(_core, "cuda") else "CPU"


def _core_of(tensor: Tensor) -> ModuleType:
    """The core's functions for the tensor's precision."""
    if tensor.dtype == torch.float32:
        return _core.float32
    if tensor.dtype == torch.float64:
        return _core.float64
    raise InputError(f"the rasterizer takes float32 or float64 tensors, got {tensor.dtype}")


def check(name: str, tensor: Tensor, shape: tuple[int, ...], like: Place) -> Tensor:
    """`tensor` contiguous, after checking its shape, and dtype and device against `like`."""
    if tensor.shape != shape:
        raise InputError(f"{name} must be {list(shape)}, got {list(tensor.shape)}")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise InputError(
            f"{name} must be {like.dtype} on {like.device} like the means, got {tensor.dtype} on {tensor.device}"
        )
    return tensor.contiguous()


def floats_or_bytes(out: Tensor) -> tuple[int, int]:
    """Two addresses, of which one is `out` and the other 0: where a composite writes floats, and where bytes."""
    return (0, out.data_ptr()) if out.dtype == torch.uint8 else (out.data_ptr(), 0)


class Scene:
    """Checked, contiguous Gaussians [B, N, ...], and the core's view of them."""

    def __init__(self, means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor):
        if means.dim() != 3 or means.shape[-1] != 3:
            raise InputError(f"means must be [scenes, N, 3], got {list(means.shape)}")
        if means.device.type not in ("cpu", "cuda") or means.is_cuda and not hasattr(_core, "cuda"):
            raise InputError(f"this build renders on the {_devices()}; got means on {means.device}: use .cpu()")
        if means.is_cuda and means.dtype != torch.float32:
            raise InputError(f"on CUDA the rasterizer takes float32 tensors, got {means.dtype}")
        batch, count = means.shape[:2]
        if count >= 2**31:
            raise InputError(f"at most 2^31 - 1 Gaussians, got {count}")
        if sh.dim() != 4 or sh.shape[2] not in (1, 4, 9, 16):
            raise InputError(f"sh must be [scenes, N, 1 | 4 | 9 | 16, 3], got {list(sh.shape)}")
        self.core, self.batch, self.count = _core_of(means), batch, count
        self.dtype, self.device = means.dtype, means.device
        self.degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[2]]
        self.tensors = [
            check("means", means, (batch, count, 3), means),
            check("quaternions", quaternions, (batch, count, 4), means),
            check("scales", scales, (batch, count, 3), means),
            check("opacities", opacities, (batch, count), means),
            check("sh", sh, (batch, count, sh.shape[2], 3), means),
        ]

    def without_values(self) -> Scene:
        """The same, but it keeps no tensors alive: enough for a composite and its reverse, which read splats."""
        other = copy.copy(self)
        other.tensors = []
        return other

    @property
    def guard(self) -> AbstractContextManager:
        """Selects the device of the Gaussians; another one each time, for torch's is not made to be entered twice."""
        return device_guard(self.device)

    def native(self) -> _core.float32.Gaussians:
        """Their addresses for the core, which hold as long as this scene does."""
        return self.core.Gaussians(self.count, self.degree, *(t.data_ptr() for t in self.tensors))

    def new(self, *shape: int, dtype: torch.dtype | None = None, zero: bool = False) -> Tensor:
        """A tensor on the scene's device, of its dtype unless one is given; without values, or all zero."""
        make = torch.zeros if zero else torch.empty
        return make(shape, dtype=dtype or self.dtype, device=self.device)

    def gradients(self, zero: bool) -> tuple[list[Tensor], _core.float32.Gaussians]:
        """Tensors for the gradients of the five fields, all zero or without values, and the core's view of them."""
        grads = [torch.zeros_like(t) if zero else torch.empty_like(t) for t in self.tensors]
        return grads, self.core.Gaussians(self.count, self.degree, *(g.data_ptr() for g in grads))


class State(NamedTuple):
    """What a render leaves to its reverse: splats [I, N, SPLAT_FIELDS], colours [I, N, order + 1, COLOUR_STRIDE] and,
    as bytes, what lies in which tile (a layout of the backend's own)."""

    splats: Tensor
    colours: Tensor
    lists: Tensor

    @classmethod
    def shapes(cls, images: int, count: int, colour_order: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Of splats and colours."""
        return (images, count, _core.SPLAT_FIELDS), (images, count, colour_order + 1, _core.COLOUR_STRIDE)

    def check(self, images: int, scene: Scene, colour_order: int, least_bytes: int) -> State:
        """Itself; raises InputError if it is not of such a render."""
        splats, colours = (
            check(f"state: {name}", t, shape, scene)
            for name, t, shape in zip(self._fields, self, self.shapes(images, scene.count, colour_order))
        )
        size = self.lists.numel()
        if self.lists.dtype != torch.uint8 or self.lists.dim() != 1 or size < least_bytes:
            raise InputError(
                f"state: lists must be {least_bytes} bytes or more, got {list(self.lists.shape)} of {self.lists.dtype}"
            )
        return State(splats, colours, self.lists.contiguous())
