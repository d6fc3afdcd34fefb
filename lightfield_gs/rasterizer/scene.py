"""The tensors of a render: checked Gaussians and background, splats, the state for the backward, and gradients."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import Colour, check_tensor, to_tensor
from lightfield_gs.base.checks import shown
from lightfield_gs.base.device import device_guard
from lightfield_gs.base.errors import InputError


def _devices() -> str:
    """Return the devices of this build in words for messages."""
    return "CPU or CUDA" if hasattr(_core, "cuda") else "CPU"


def _stages(tensor: Tensor) -> ModuleType:
    """Return the core's functions for the tensor's precision."""
    if tensor.dtype == torch.float32:
        return _core.float32
    if tensor.dtype == torch.float64:
        return _core.float64
    raise InputError(f"the rasterizer takes float32 or float64 tensors, got {tensor.dtype}")


def float_and_byte_addresses(out: Tensor) -> tuple[int, int]:
    """Return where a composite writes floats, and where bytes: the address of `out` for its type, and 0."""
    return (0, out.data_ptr()) if out.dtype == torch.uint8 else (out.data_ptr(), 0)


class SceneTensors:
    """Checked, contiguous Gaussians [B, N, ...], and their native view."""

    def __init__(self, means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor):
        """Check the fields; see ImageArguments. Raises InputError."""
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
        self.core, self.batch, self.count = _stages(means), batch, count
        self.dtype, self.device = means.dtype, means.device
        self.degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[2]]
        self.tensors = [
            check_tensor(name, tensor, (batch, count, *shape), self.dtype, self.device)
            for name, tensor, shape in (
                ("means", means, (3,)),
                ("quaternions", quaternions, (4,)),
                ("scales", scales, (3,)),
                ("opacities", opacities, ()),
                ("sh", sh, (sh.shape[2], 3)),
            )
        ]

    def without_values(self) -> SceneTensors:
        """Return a copy that keeps no tensors alive: enough for a composite and its backward, which read splats."""
        other = copy.copy(self)
        other.tensors = []
        return other

    @property
    def guard(self) -> AbstractContextManager:
        """A context that selects the device of the Gaussians; a new one each time, for torch's cannot be reentered."""
        return device_guard(self.device)

    def native(self) -> _core.float32.Gaussians:
        """Return the addresses for the core, which are valid as long as this object."""
        return self.core.Gaussians(self.count, self.degree, *(t.data_ptr() for t in self.tensors))

    def new(self, *shape: int, dtype: torch.dtype | None = None, zero: bool = False) -> Tensor:
        """Allocate a tensor on the device of the Gaussians, of their dtype unless given; without values, or all 0."""
        make = torch.zeros if zero else torch.empty
        return make(shape, dtype=dtype or self.dtype, device=self.device)

    def gradients(self, zero: bool) -> tuple[list[Tensor], _core.float32.Gaussians]:
        """Allocate the gradients of the five fields, all 0 or without values; return them and the core's view."""
        grads = [torch.zeros_like(t) if zero else torch.empty_like(t) for t in self.tensors]
        return grads, self.core.Gaussians(self.count, self.degree, *(g.data_ptr() for g in grads))


class RenderState(NamedTuple):
    """The state that a render leaves to its backward.

    Attributes:
        splats: [I, N, SPLAT_FIELDS].
        colours: [I, N, order + 1, COLOUR_STRIDE].
        lists: The splats of each tile as bytes, in a layout of the device's own.
    """

    splats: Tensor
    colours: Tensor
    lists: Tensor

    @classmethod
    def shapes(cls, images: int, count: int, colour_order: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the shapes of splats and colours."""
        return (images, count, _core.SPLAT_FIELDS), (images, count, colour_order + 1, _core.COLOUR_STRIDE)

    def check(self, images: int, scene: SceneTensors, colour_order: int, least_bytes: int) -> RenderState:
        """Return the state contiguous. Raises InputError if it is not of such a render."""
        splats, colours = (
            check_tensor(f"state: {name}", t, shape, scene.dtype, scene.device)
            for name, t, shape in zip(self._fields, self, self.shapes(images, scene.count, colour_order))
        )
        size = self.lists.numel()
        if self.lists.dtype != torch.uint8 or self.lists.dim() != 1 or size < least_bytes:
            raise InputError(
                f"state: lists must be {least_bytes} bytes or more, got {list(self.lists.shape)} of {self.lists.dtype}"
            )
        return RenderState(splats, colours, self.lists.contiguous())


class Splats:
    """The projected Gaussians of `images` images: written by `project`, read by all later stages."""

    def __init__(
        self,
        scene: SceneTensors,
        images: int,
        colour_order: int,
        with_orders: bool,
        compensated: bool,
        state: RenderState | None,
    ):
        """Allocate the splats, or take them from `state`.

        Args:
            scene: the Gaussians.
            images: how many images they are projected to.
            colour_order: highest order of the polynomials for the colours of a light field over the rig; 0: one colour
                each.
            with_orders: whether each Gaussian may have a lower order of its own.
            compensated: whether opacities change over the rig, by the compensation of anti-aliasing or of an aperture.
            state: what a render left.
        """
        n, self.colour_order = scene.count, colour_order
        if state is None:
            self.splats, self.colours = (scene.new(*shape) for shape in RenderState.shapes(images, n, colour_order))
        else:
            self.splats, self.colours = state.splats, state.colours
        self.orders = scene.new(images, n if with_orders else 0, dtype=torch.int32)
        self.compensations = scene.new(n, _core.COMPENSATION_FIELDS) if compensated else None
        self.native = scene.core.Splats(
            images,
            n,
            colour_order,
            self.splats.data_ptr(),
            self.colours.data_ptr(),
            self.orders.data_ptr(),
            0 if self.compensations is None else self.compensations.data_ptr(),
        )

    def buffers(self) -> list[Tensor]:
        """Return all tensors, for counting their memory."""
        extra = [] if self.compensations is None else [self.compensations]
        return [self.splats, self.colours, self.orders, *extra]


class GradientRequest(NamedTuple):
    """The gradients of ordinary images on request, in addition to the five fields and the background.

    Attributes:
        screen_numbers: 0; 2 for the projected means, in 1 / pixels; 4 for these and the sums of absolute values.
        cameras: Whether the gradient of world_to_camera is asked for.
    """

    screen_numbers: int = 0
    cameras: bool = True

    @property
    def absolute(self) -> bool:
        """Whether the sums of absolute values are asked for."""
        return self.screen_numbers == 4


class ImageGradients(NamedTuple):
    """Gradients of ordinary images.

    Attributes:
        fields: Gradients of the five fields.
        background_parts: [I * parts, 3].
        cameras: [I, 4, 4], or [0, 4, 4].
        screen: Gradients of the projected means, [I, N, screen_numbers].
    """

    fields: list[Tensor]
    background_parts: Tensor
    cameras: Tensor
    screen: Tensor


def background_tensor(background: Colour, like: Tensor) -> Tensor:
    """Return a background as a tensor [..., 3] of the dtype and on the device of `like`. Raises InputError."""
    if isinstance(background, (tuple, list)) and all(isinstance(c, (int, float)) for c in background):
        if like.is_cuda and torch.cuda.is_current_stream_capturing():
            return _captured_background(background, like)
        return _constant_background(tuple(background), like.dtype, like.device)
    return _checked_background(background, like.dtype, like.device)


def _captured_background(background: Sequence[float], like: Tensor) -> Tensor:
    """Return a background that a graph under capture makes itself, in its own memory.

    Of a tensor from outside the graph would keep the address alone, where something else may lie at a replay.
    """
    numbers = _checked_background(background, like.dtype, torch.device("cpu")).tolist()
    return torch.stack([like.new_full((), number) for number in numbers])


@lru_cache(maxsize=64)
def _constant_background(background: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a background of plain numbers; cached, for each copy to a device waits for the device."""
    with torch.inference_mode(False):  # it may be part of a graph of gradients later
        return _checked_background(background, dtype, device)


def _checked_background(background: Colour, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a background of any kind as a tensor. A search for NaN on a GPU would wait for it, and is left out.

    Tensors and arrays may hold values beyond 0..1, as optimizers make them; plain numbers beyond 0..1 are mistakes.
    """
    plain = True
    if isinstance(background, (Tensor, np.ndarray)):
        plain, background = False, to_tensor("background", background)
    there = isinstance(background, Tensor) and background.is_cuda
    try:
        colour = torch.as_tensor(background, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(
            f"background must be three finite numbers R, G, B in 0..1, got {type(background).__name__}"
        ) from None
    if colour.dim() == 0 or colour.shape[-1] != 3 or not (there or bool(torch.isfinite(colour).all())):
        raise InputError(f"background must be three finite numbers R, G, B in 0..1, got {shown(background)}")
    if plain and not bool(((colour >= 0) & (colour <= 1)).all()):
        raise InputError(
            f"background must be three numbers R, G, B in 0..1, got {shown(background)}; divide bytes by 255"
        )
    return colour
