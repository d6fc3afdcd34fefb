"""Buffers of one render: checked inputs, splats, bins."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightfield_gs import _core, skips
from lightfield_gs.errors import InputError
from lightfield_gs.quality import Quality


@dataclass
class Stats:
    """What a render did: milliseconds per stage, counts, bytes of work memory.

    device: waits for a CUDA device at both ends of a stage, or its work would be timed elsewhere; None: does not wait.
    """

    device: torch.device | None = None
    stages_ms: dict[str, float] = field(default_factory=dict)
    pairs: int = 0
    evaluations: int = 0
    work_bytes: int = 0
    memory_bytes: dict[str, int] = field(default_factory=dict)  # of method sorted, see sorted.encode_sorted
    memory_bytes_unchunked: dict[str, int] = field(default_factory=dict)
    images: int = 0
    gaussians_drawn: int = 0  # in all images
    pruned: int = 0  # of a light field, see Quality
    colour_error: float = 0.0
    kernel: str | None = None  # that drew a light field on CUDA
    skipped: dict[str, Any] = field(default_factory=dict)  # of a light field, see skips.lines

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._wait()
        start = time.perf_counter()
        yield
        self._wait()
        self.stages_ms[name] = self.stages_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - start)

    def _wait(self) -> None:
        if self.device is not None and self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def add_render(self, other: Stats) -> None:
        """One of several renders that follow each other: their work adds up, their memory is used again."""
        for name, ms in other.stages_ms.items():
            self.stages_ms[name] = self.stages_ms.get(name, 0.0) + ms
        self.pairs += other.pairs
        self.evaluations += other.evaluations
        self.images += other.images
        self.gaussians_drawn += other.gaussians_drawn
        self.work_bytes = max(self.work_bytes, other.work_bytes)

    def add_buffers(self, *buffers: Tensor) -> None:
        self.work_bytes += sum(t.numel() * t.element_size() for t in buffers)

    def count_frame(self, state: dict[str, Any], work: Tensor) -> None:
        """A light-field frame on CUDA and its work buffer."""
        self.pairs += state["pairs"]
        self.images += 1
        self.gaussians_drawn += state["drawn"]
        self.colour_error, self.kernel, self.pruned = state["colour_error"], state["kernel"], state["pruned"]
        self.skipped = skips.of_frame(state)
        self.add_buffers(work)

    def count(self, counters: Any) -> None:
        self.pairs += counters.pairs
        self.evaluations += counters.evaluations
        self.work_bytes += counters.scratch_bytes


def _devices() -> str:
    return "CPU or CUDA" if hasattr(_core, "cuda") else "CPU"


def _core_of(tensor: Tensor) -> Any:
    """The core's functions for the tensor's precision."""
    if tensor.dtype == torch.float32:
        return _core.float32
    if tensor.dtype == torch.float64:
        return _core.float64
    raise InputError(f"the rasterizer takes float32 or float64 tensors, got {tensor.dtype}")


def check(name: str, tensor: Tensor, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """`tensor` contiguous, after checking its shape, and dtype and device against `like`."""
    if tensor.shape != shape:
        raise InputError(f"{name} must be {list(shape)}, got {list(tensor.shape)}")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise InputError(
            f"{name} must be {like.dtype} on {like.device} like the means, got {tensor.dtype} on {tensor.device}"
        )
    return tensor.contiguous()


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
        self.degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[2]]
        self.tensors = [
            check("means", means, (batch, count, 3), means),
            check("quaternions", quaternions, (batch, count, 4), means),
            check("scales", scales, (batch, count, 3), means),
            check("opacities", opacities, (batch, count), means),
            check("sh", sh, (batch, count, sh.shape[2], 3), means),
        ]

    @property
    def guard(self) -> AbstractContextManager:
        """Selects the device of the Gaussians; another one each time, for torch's is not made to be entered twice."""
        device = self.tensors[0].device
        return torch.cuda.device(device) if device.type == "cuda" else nullcontext()

    def native(self) -> Any:
        return self.core.Gaussians(self.count, self.degree, *(t.data_ptr() for t in self.tensors))

    def new(self, *shape: int, dtype: torch.dtype | None = None, zero: bool = False) -> Tensor:
        make = torch.zeros if zero else torch.empty
        return make(shape, dtype=dtype or self.tensors[0].dtype, device=self.tensors[0].device)

    def gradients(self) -> tuple[list[Tensor], Any]:
        grads = [torch.zeros_like(t) for t in self.tensors]
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
            check(f"state: {name}", t, shape, scene.tensors[0])
            for name, t, shape in zip(self._fields, self, self.shapes(images, scene.count, colour_order))
        )
        size = self.lists.numel()
        if self.lists.dtype != torch.uint8 or self.lists.dim() != 1 or size < least_bytes:
            raise InputError(
                f"state: lists must be {least_bytes} bytes or more, got {list(self.lists.shape)} of {self.lists.dtype}"
            )
        return State(splats, colours, self.lists.contiguous())


class Workspace:
    """Splats and bins of one render on the CPU, and the stages over them."""

    def __init__(
        self,
        scene: Scene,
        images: int,
        width: int,
        height: int,
        colour_order: int,
        stats: Stats,
        threads: int,
        state: State | None = None,
        compensated: bool = False,
    ):
        """compensated: of an anti-aliased light field, whose opacities change over the rig."""
        n, self.scene, self.images, self.stats, self.threads = scene.count, scene, images, stats, threads
        self.width, self.height, self.colour_order = width, height, colour_order
        self.offsets = images * _core.band_count(height) + 1  # of bands into their lists
        if state is None:
            self.splats, self.colours = (scene.new(*shape) for shape in State.shapes(images, n, colour_order))
        else:
            self.splats, self.colours, lists = state.check(images, scene, colour_order, 8 * self.offsets)
            self._use_lists(lists)
        self.orders = scene.new(images, n, dtype=torch.int32)
        self.compensations = scene.new(n, _core.COMPENSATION_FIELDS) if compensated else None
        self.native = scene.core.Splats(
            images,
            n,
            colour_order,
            self.splats.data_ptr(),
            self.colours.data_ptr(),
            self.orders.data_ptr(),
            self.compensations.data_ptr() if compensated else 0,
        )

    def _use_lists(self, lists: Tensor) -> None:
        """Bytes: band offsets [I * bands + 1] int64, then the splats of the pairs, int32."""
        self.lists, self.pairs = lists, (lists.numel() - 8 * self.offsets) // 4
        self.bins = _core.Bins(lists.data_ptr(), lists.data_ptr() + 8 * self.offsets)

    def state(self) -> State:
        return State(self.splats, self.colours, self.lists)

    def project_dense(self, cameras: Any) -> None:
        self.scene.core.project_dense(self.scene.native(), cameras, self.native, self.threads)

    def project_lens(self, rig: Any, lens: Any, quality: Quality) -> float:
        """The largest estimated error of a colour polynomial."""
        return self.scene.core.project_lens(
            self.scene.native(), rig, lens, quality.native, quality.colour_error, self.native, self.threads
        )

    def order_and_bin(self, admit: Callable[[], bool] = lambda: True) -> bool:
        """admit: see bin."""
        return self.bin(*self.order(), admit)

    def order(self) -> tuple[Tensor, Tensor]:
        """Splats [I, N] int32, of which the first `drawn` [I] int64 are drawn, nearest first; and drawn."""
        with self.stats.stage("order"):
            order = self.scene.new(self.images, self.scene.count, dtype=torch.int32)
            drawn = self.scene.new(self.images, dtype=torch.int64)
            self.scene.core.order(self.native, order.data_ptr(), drawn.data_ptr(), self.threads)
        return order, drawn

    def bin(self, order: Tensor, drawn: Tensor, admit: Callable[[], bool] = lambda: True) -> bool:
        """admit: asked once `pairs` are counted, whether to go on; returns its answer."""
        scene, core, threads = self.scene, self.scene.core, self.threads
        with self.stats.stage("bin"):
            self.band_offsets = scene.new(self.offsets, dtype=torch.int64)
            bins = _core.Bins(self.band_offsets.data_ptr(), 0)
            self.pairs = core.bin_count(self.native, order.data_ptr(), drawn.data_ptr(), self.height, bins, threads)
            if not admit():
                return False
            self._use_lists(scene.new(8 * self.offsets + 4 * self.pairs, dtype=torch.uint8))
            self.lists[: 8 * self.offsets] = self.band_offsets.view(torch.uint8)
            core.bin_fill(self.native, order.data_ptr(), drawn.data_ptr(), self.height, self.bins, threads)
        self.stats.images += self.images
        self.stats.gaussians_drawn += int(drawn.sum())
        self.stats.add_buffers(self.splats, self.colours, self.orders, order, drawn, self.lists)
        if self.compensations is not None:
            self.stats.add_buffers(self.compensations)
        return True

    def bin_as(self, other: Workspace) -> None:
        """Takes over what `bin` made of the same splats."""
        self._use_lists(other.lists)

    def composite_dense(self, cameras: Any, background: Tensor, out: Any) -> None:
        self.stats.count(
            self.scene.core.composite_dense(self.native, self.bins, cameras, background.data_ptr(), out, self.threads)
        )

    def composite_lens(self, lens: Any, quality: Quality, background: Tensor, out: Tensor) -> None:
        """out: [H, W, 3], of the scene's dtype or uint8."""
        floats, bytes_ = (0, out.data_ptr()) if out.dtype == torch.uint8 else (out.data_ptr(), 0)
        counters = self.scene.core.composite_lens(
            self.native, self.bins, lens, quality.native, background.data_ptr(), floats, bytes_, self.threads
        )
        self.stats.count(counters)
        if self.stats.device is not None:
            self.stats.pruned = int((self.splats[..., _core.SPLAT_REACH_INDEX] == _core.PRUNED).sum())
            self.stats.skipped = skips.of_lens(counters, self.orders, self.splats, self.colour_order)

    def dense_backward(
        self, cameras: Any, background: Tensor, images: Any, gradients: Any
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Gradients of the five fields, of the background in parts [I * parts, 3], and of the cameras [I, 4, 4]."""
        core, (first, pairs, g_background) = self.scene.core, self._gradient_buffers()
        core.composite_dense_backward(
            self.native,
            self.bins,
            cameras,
            background.data_ptr(),
            images,
            gradients,
            first.data_ptr(),
            pairs.data_ptr(),
            g_background.data_ptr(),
            self.threads,
        )
        out, native = self.scene.gradients()
        g_cameras = self.scene.new(self.images, 4, 4, zero=True)
        core.project_dense_backward(
            self.scene.native(),
            cameras,
            self.native,
            first.data_ptr(),
            pairs.data_ptr(),
            native,
            g_cameras.data_ptr(),
            self.threads,
        )
        return out, g_background, g_cameras

    def lens_backward(
        self, rig: Any, lens: Any, background: Tensor, image: Tensor, g_image: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Gradients of the five fields, and of the background in parts [parts, 3]."""
        core, (first, pairs, g_background) = self.scene.core, self._gradient_buffers()
        core.composite_lens_backward(
            self.native,
            self.bins,
            lens,
            background.data_ptr(),
            image.data_ptr(),
            g_image.data_ptr(),
            first.data_ptr(),
            pairs.data_ptr(),
            g_background.data_ptr(),
            self.threads,
        )
        out, native = self.scene.gradients()
        core.project_lens_backward(
            self.scene.native(), rig, lens, self.native, first.data_ptr(), pairs.data_ptr(), native, self.threads
        )
        return out, g_background

    def _gradient_buffers(self) -> tuple[Tensor, Tensor, Tensor]:
        """first_pair [I, N], pair gradients [pairs, size], background gradient per band [bands, 3]."""
        first = self.scene.new(self.images, self.scene.count, dtype=torch.int64)
        self.scene.core.first_pairs(self.native, self.height, self.bins, first.data_ptr(), self.threads)
        size = _core.pair_gradient_size(self.colour_order, self.compensations is not None)
        pairs = self.scene.new(self.pairs, size, zero=True)
        return first, pairs, self.scene.new(self.images * _core.band_count(self.height), 3, zero=True)
