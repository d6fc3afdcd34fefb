"""The rasterizer as torch operators: torch.ops.lightfield_gs.render_dense and render_lens, with their reverses.

The only file that hands addresses to the native core. Every buffer is a torch tensor made here; every argument is
checked here. Both operators run project -> order -> bin -> composite (DESIGN of the sensors: `Dense` is an ordinary image,
`Lens` gives every sub-pixel of a panel its own camera offset), and are deterministic: the same bits whatever the
number of threads.
"""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Iterator

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.errors import InputError

COLOUR_ORDERS = (8, 16)  # polynomial orders tried for colours that vary over a rig
COLOUR_TOLERANCE = 5e-5  # largest error of a colour polynomial, of 1


@dataclass
class Stats:
    """What a render did: milliseconds per stage, counts, bytes of work memory."""

    stages_ms: dict[str, float] = field(default_factory=dict)
    pairs: int = 0
    evaluations: int = 0
    work_bytes: int = 0
    gaussians_drawn: int = 0
    colour_error: float = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.stages_ms[name] = self.stages_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - start)

    def count(self, counters: Any) -> None:
        self.pairs += counters.pairs
        self.evaluations += counters.evaluations
        self.work_bytes += counters.scratch_bytes


def _core_of(tensor: Tensor) -> Any:
    """The core's functions for the tensor's precision."""
    if tensor.dtype == torch.float32:
        return _core.float32
    if tensor.dtype == torch.float64:
        return _core.float64
    raise InputError(f"the rasterizer takes float32 or float64 tensors, got {tensor.dtype}")


def check(name: str, tensor: Tensor, shape: tuple[int | None, ...], like: Tensor) -> Tensor:
    """`tensor` contiguous, after checking its shape (None: any), and dtype and device against `like`."""
    if len(shape) != tensor.dim() or any(s is not None and s != t for s, t in zip(shape, tensor.shape)):
        raise InputError(f"{name} must be {['any' if s is None else s for s in shape]}, got {list(tensor.shape)}")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise InputError(f"{name} must be {like.dtype} on {like.device} like the means, got {tensor.dtype} on "
                         f"{tensor.device}")
    return tensor.contiguous()


class _Scene:
    """Checked, contiguous Gaussians [B, N, ...] and the core's view of them."""

    def __init__(self, means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor):
        if means.dim() != 3 or means.shape[-1] != 3:
            raise InputError(f"means must be [scenes, N, 3], got {list(means.shape)}")
        if means.device.type != "cpu":
            raise InputError(f"this build renders on the CPU; got means on {means.device}: use .cpu()")
        batch, count = means.shape[:2]
        if count >= 2**31:
            raise InputError(f"at most 2^31 - 1 Gaussians, got {count}")
        if sh.dim() != 4 or sh.shape[2] not in (1, 4, 9, 16):
            raise InputError(f"sh must be [scenes, N, 1 | 4 | 9 | 16, 3], got {list(sh.shape)}")
        self.core, self.batch, self.count = _core_of(means), batch, count
        self.degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[2]]
        self.tensors = [check("means", means, (batch, count, 3), means),
                        check("quaternions", quaternions, (batch, count, 4), means),
                        check("scales", scales, (batch, count, 3), means),
                        check("opacities", opacities, (batch, count), means),
                        check("sh", sh, (batch, count, sh.shape[2], 3), means)]

    def native(self) -> Any:
        return self.core.Gaussians(self.count, self.degree, *(t.data_ptr() for t in self.tensors))

    def new(self, *shape: int, dtype: torch.dtype | None = None, zero: bool = False) -> Tensor:
        make = torch.zeros if zero else torch.empty
        return make(shape, dtype=dtype or self.tensors[0].dtype)

    def gradients(self) -> tuple[list[Tensor], Any]:
        grads = [torch.zeros_like(t) for t in self.tensors]
        return grads, self.core.Gaussians(self.count, self.degree, *(g.data_ptr() for g in grads))


class _Workspace:
    """Splats and bins of one render."""

    def __init__(self, scene: _Scene, images: int, height: int, colour_order: int, stats: Stats):
        n, self.scene, self.images, self.height, self.stats = scene.count, scene, images, height, stats
        self.colour_order = colour_order
        self.splats = scene.new(images, n, _core.SPLAT_FIELDS)
        self.colours = scene.new(images, n, colour_order + 1, _core.COLOUR_STRIDE)
        self.orders = scene.new(images, n, dtype=torch.int32)
        self.native = scene.core.Splats(images, n, colour_order, self.splats.data_ptr(), self.colours.data_ptr(),
                                        self.orders.data_ptr())

    def order_and_bin(self, threads: int) -> None:
        scene, core = self.scene, self.scene.core
        with self.stats.stage("order"):
            order = scene.new(self.images, scene.count, dtype=torch.int32)
            drawn = scene.new(self.images, dtype=torch.int64)
            core.order(self.native, order.data_ptr(), drawn.data_ptr(), threads)
        with self.stats.stage("bin"):
            self.band_offsets = scene.new(self.images * _core.band_count(self.height) + 1, dtype=torch.int64)
            bins = _core.Bins(self.band_offsets.data_ptr(), 0)
            self.pairs = core.bin_count(self.native, order.data_ptr(), drawn.data_ptr(), self.height, bins, threads)
            self.band_splats = scene.new(self.pairs, dtype=torch.int32)
            self.bins = _core.Bins(self.band_offsets.data_ptr(), self.band_splats.data_ptr())
            core.bin_fill(self.native, order.data_ptr(), drawn.data_ptr(), self.height, self.bins, threads)
        self.stats.gaussians_drawn += int(drawn.sum())
        buffers = (self.splats, self.colours, self.orders, order, drawn, self.band_offsets, self.band_splats)
        self.stats.work_bytes += sum(t.numel() * t.element_size() for t in buffers)

    def gradient_buffers(self, threads: int) -> tuple[Tensor, Tensor, Tensor]:
        """first_pair [I, N], pair gradients [pairs, size], background gradient per band [bands, 3]."""
        first = self.scene.new(self.images, self.scene.count, dtype=torch.int64)
        self.scene.core.first_pairs(self.native, self.height, self.bins, first.data_ptr(), threads)
        pairs = self.scene.new(self.pairs, _core.pair_gradient_size(self.colour_order), zero=True)
        return first, pairs, self.scene.new(self.images * _core.band_count(self.height), 3, zero=True)


# Dense: ordinary images


class _DenseJob:
    """Arguments of render_dense, checked, and the stages up to the composite."""

    def __init__(self, means, quaternions, scales, opacities, sh, background, world_to_camera, intrinsics, limits,
                 width: int, height: int, stats: Stats, threads: int):
        self.scene = scene = _Scene(means, quaternions, scales, opacities, sh)
        if world_to_camera.dim() != 4:
            raise InputError(f"world_to_camera must be [scenes, cameras, 4, 4], got {list(world_to_camera.shape)}")
        if not (1 <= width <= 65536 and 1 <= height <= 65536):
            raise InputError(f"image size must be 1..65536 pixels each way, got {width} x {height}")
        self.lead = lead = (scene.batch, world_to_camera.shape[1])
        self.images, self.width, self.height, self.threads = lead[0] * lead[1], width, height, threads
        self.background = check("background", background, (*lead, 3), means)
        self.cameras_tensors = [check("world_to_camera", world_to_camera, (*lead, 4, 4), means),
                                check("intrinsics", intrinsics, (*lead, 4), means),
                                check("limits", limits, (*lead, 5), means)]
        self.cameras = scene.core.Cameras(*lead, width, height, *(t.data_ptr() for t in self.cameras_tensors))
        self.work = _Workspace(scene, self.images, height, 0, stats)
        with stats.stage("project"):
            scene.core.project_dense(scene.native(), self.cameras, self.work.native, threads)
        self.work.order_and_bin(threads)

    def image_shapes(self) -> list[tuple[int, ...]]:
        size = (*self.lead, self.height, self.width)
        return [(*size, 3), size, size]


def dense_forward(*arguments: Any, stats: Stats | None = None, threads: int | None = None) -> tuple[Tensor, ...]:
    """render_dense without autograd; see there. Also fills `stats`."""
    stats, threads = stats or Stats(), threads or torch.get_num_threads()
    job = _DenseJob(*arguments, stats, threads)
    with stats.stage("composite"):
        out = [job.scene.new(*shape) for shape in job.image_shapes()]
        native = job.scene.core.DenseImages(*(t.data_ptr() for t in out))
        stats.count(job.scene.core.composite_dense(job.work.native, job.work.bins, job.cameras,
                                                   job.background.data_ptr(), native, threads))
    return tuple(out)


@torch.library.custom_op("lightfield_gs::render_dense", mutates_args=(), device_types="cpu")
def render_dense(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
                 background: Tensor, world_to_camera: Tensor, intrinsics: Tensor, limits: Tensor, width: int,
                 height: int) -> tuple[Tensor, Tensor, Tensor]:
    """B scenes of N Gaussians, each seen by V cameras.

    means [B,N,3], quaternions [B,N,4] wxyz, scales [B,N,3] > 0, opacities [B,N] in (0,1], sh [B,N,K,3],
    background [B,V,3], world_to_camera [B,V,4,4], intrinsics [B,V,4] (fx, fy, cx, cy in pixels), limits [B,V,5] (see
    Cameras.limits); all float32 or all float64, on the CPU. Returns image [B,V,H,W,3] over the background, alpha
    [B,V,H,W], depth [B,V,H,W] (sum of weight * z, not normalized). Differentiable in all but intrinsics and limits.
    Source: Kerbl et al. 2023. Raises InputError.
    """
    return dense_forward(means, quaternions, scales, opacities, sh, background, world_to_camera, intrinsics, limits,
                         width, height)


@render_dense.register_fake
def _(means, quaternions, scales, opacities, sh, background, world_to_camera, intrinsics, limits, width, height):
    size = (*world_to_camera.shape[:2], height, width)
    return means.new_empty((*size, 3)), means.new_empty(size), means.new_empty(size)


@torch.library.custom_op("lightfield_gs::render_dense_backward", mutates_args=(), device_types="cpu")
def render_dense_backward(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
                          background: Tensor, world_to_camera: Tensor, intrinsics: Tensor, limits: Tensor, width: int,
                          height: int, image: Tensor, alpha: Tensor, depth: Tensor, g_image: Tensor, g_alpha: Tensor,
                          g_depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of render_dense's first seven arguments from its outputs and their gradients."""
    threads = torch.get_num_threads()
    job = _DenseJob(means, quaternions, scales, opacities, sh, background, world_to_camera, intrinsics, limits, width,
                    height, Stats(), threads)
    core, work = job.scene.core, job.work
    images = [check(n, t, s, means) for n, t, s in zip(("image", "alpha", "depth"), (image, alpha, depth),
                                                       job.image_shapes())]
    grads = [check(n, t, s, means) for n, t, s in zip(("g_image", "g_alpha", "g_depth"), (g_image, g_alpha, g_depth),
                                                      job.image_shapes())]
    first, pairs, g_band_background = work.gradient_buffers(threads)
    core.composite_dense_backward(work.native, work.bins, job.cameras, job.background.data_ptr(),
                                  core.DenseImages(*(t.data_ptr() for t in images)),
                                  core.DenseImages(*(t.data_ptr() for t in grads)), first.data_ptr(),
                                  pairs.data_ptr(), g_band_background.data_ptr(), threads)
    out, native = job.scene.gradients()
    g_cameras = torch.zeros_like(job.cameras_tensors[0])
    core.project_dense_backward(job.scene.native(), job.cameras, work.native, first.data_ptr(), pairs.data_ptr(),
                                native, g_cameras.data_ptr(), threads)
    g_background = g_band_background.view(*job.lead, -1, 3).sum(2)
    return (*out, g_background, g_cameras)


@render_dense_backward.register_fake
def _(means, quaternions, scales, opacities, sh, background, world_to_camera, *rest):
    inputs = (means, quaternions, scales, opacities, sh, background, world_to_camera)
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs)


def _dense_setup(ctx, inputs, output):
    *tensors, ctx.width, ctx.height = inputs
    ctx.save_for_backward(*tensors, *output)


def _dense_backward(ctx, *grads):
    saved = ctx.saved_tensors
    grads = [torch.zeros_like(out) if g is None else g for g, out in zip(grads, saved[9:])]
    out = torch.ops.lightfield_gs.render_dense_backward(*saved[:9], ctx.width, ctx.height, *saved[9:], *grads)
    return (*out, None, None, None, None)


render_dense.register_autograd(_dense_backward, setup_context=_dense_setup)


# Lens: the sub-pixels of a panel


class _LensJob:
    """Arguments of render_lens, checked, and the stages up to the composite."""

    def __init__(self, means, quaternions, scales, opacities, sh, background, rig: list[float], lens: list[int],
                 lens_shape: list[float], stats: Stats, threads: int):
        with stats.stage("plan"):
            self.scene = scene = _Scene(*(t.unsqueeze(0) for t in (means, quaternions, scales, opacities, sh)))
            self.background = check("background", background, (3,), means)
            self.lens = native_lens(lens, lens_shape)
            self.width, self.height = lens[0], lens[1]
            if len(rig) != 26:
                raise InputError(f"rig must be 26 numbers (see render_lens), got {len(rig)}")
            self.rig = _core.Rig(world_to_camera=rig[:16], intrinsics=rig[16:20], limits=rig[20:25],
                                 zero_depth=rig[25], lens=self.lens)
        # Colours: raise the order until the polynomials are good enough. float64 is the exact twin: highest order.
        orders = (0,) if scene.degree == 0 else COLOUR_ORDERS[-1:] if means.dtype == torch.float64 else COLOUR_ORDERS
        with stats.stage("project"):
            for order in orders:
                self.work = _Workspace(scene, 1, self.height, order, stats)
                stats.colour_error = scene.core.project_lens(scene.native(), self.rig, self.lens, COLOUR_TOLERANCE,
                                                             self.work.native, threads)
                if stats.colour_error <= COLOUR_TOLERANCE:
                    break
        self.work.order_and_bin(threads)


def native_lens(lens: list[int], lens_shape: list[float]) -> Any:
    """The core's Lens from the two lists of render_lens."""
    if len(lens) != 8 or len(lens_shape) != 5:
        raise InputError(f"lens must be 8 integers and lens_shape 5 numbers, got {len(lens)} and {len(lens_shape)}")
    width, height, views, *phases, bgr, continuous = lens
    line_number, slant_tan, phase, offset_start, offset_step = lens_shape
    if not (1 <= width <= 65536 and 1 <= height <= 65536 and 1 <= views <= 65536 and line_number > 0):
        raise InputError(f"a lens needs sizes and views of 1..65536 and a line number > 0, got {lens[:3]}, {line_number}")
    phase0, phase_x, phase_y = (p % 2**64 for p in phases)
    return _core.Lens(width_px=width, height_px=height, views=views, phase0=phase0, phase_x=phase_x, phase_y=phase_y,
                      line_number=line_number, slant_tan=slant_tan, phase=phase, bgr=bool(bgr),
                      continuous=bool(continuous), offset_start=offset_start, offset_step=offset_step)


def lens_forward(*arguments: Any, as_bytes: bool = False, stats: Stats | None = None,
                 threads: int | None = None) -> Tensor:
    """render_lens without autograd; see there. as_bytes: uint8 = round(255 clamp(c, 0, 1)). Fills `stats`."""
    stats, threads = stats or Stats(), threads or torch.get_num_threads()
    job = _LensJob(*arguments, stats, threads)
    with stats.stage("composite"):
        out = job.scene.new(job.height, job.width, 3, dtype=torch.uint8 if as_bytes else None)
        address = out.data_ptr()
        stats.count(job.scene.core.composite_lens(job.work.native, job.work.bins, job.lens, job.background.data_ptr(),
                                                  0 if as_bytes else address, address if as_bytes else 0, threads))
    return out


@torch.library.custom_op("lightfield_gs::render_lens", mutates_args=(), device_types="cpu")
def render_lens(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, background: Tensor,
                rig: list[float], lens: list[int], lens_shape: list[float]) -> Tensor:
    """The image [H, W, 3] that a slanted-lenticular panel shows of N Gaussians.

    means [N,3], quaternions [N,4] wxyz, scales [N,3] > 0, opacities [N] in (0,1], sh [N,K,3], background [3]; all
    float32 or all float64, on the CPU; differentiable in all of these. Every sub-pixel belongs to the camera at offset
    s = offset_start + offset_step * x of its own view coordinate x.
    rig: 26 numbers: world_to_camera (16, row-major), fx, fy, cx, cy, Jacobian limits (5, see Cameras.limits), zero_depth.
    lens: width, height, views, phase0, phase_x, phase_y (64-bit patterns as signed integers, 2^64 = one lens),
    bgr, continuous. lens_shape: line_number, slant_tan, phase (sub-pixels), offset_start, offset_step (scene units).
    lightfield_gs.encode builds them from a Panel and a Rig. Raises InputError.
    """
    return lens_forward(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape)


@render_lens.register_fake
def _(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape):
    return means.new_empty((lens[1], lens[0], 3))


@torch.library.custom_op("lightfield_gs::render_lens_backward", mutates_args=(), device_types="cpu")
def render_lens_backward(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor,
                         background: Tensor, rig: list[float], lens: list[int], lens_shape: list[float],
                         image: Tensor, g_image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of render_lens's first six arguments from its output and the gradient of that."""
    threads = torch.get_num_threads()
    job = _LensJob(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape, Stats(), threads)
    core, work = job.scene.core, job.work
    image, g_image = (check(n, t, (job.height, job.width, 3), means) for n, t in (("image", image),
                                                                                 ("g_image", g_image)))
    first, pairs, g_band_background = work.gradient_buffers(threads)
    core.composite_lens_backward(work.native, work.bins, job.lens, job.background.data_ptr(), image.data_ptr(),
                                 g_image.data_ptr(), first.data_ptr(), pairs.data_ptr(), g_band_background.data_ptr(),
                                 threads)
    out, native = job.scene.gradients()
    core.project_lens_backward(job.scene.native(), job.rig, job.lens, work.native, first.data_ptr(), pairs.data_ptr(),
                               native, threads)
    return (*(g.squeeze(0) for g in out), g_band_background.sum(0))


@render_lens_backward.register_fake
def _(means, quaternions, scales, opacities, sh, background, *rest):
    inputs = (means, quaternions, scales, opacities, sh, background)
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs)


def _lens_setup(ctx, inputs, output):
    *tensors, ctx.rig, ctx.lens, ctx.lens_shape = inputs
    ctx.save_for_backward(*tensors, output)


def _lens_backward(ctx, grad):
    *tensors, image = ctx.saved_tensors
    out = torch.ops.lightfield_gs.render_lens_backward(*tensors, ctx.rig, ctx.lens, ctx.lens_shape, image, grad)
    return (*out, None, None, None)


render_lens.register_autograd(_lens_backward, setup_context=_lens_setup)
