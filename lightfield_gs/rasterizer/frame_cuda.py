"""Light-field images on CUDA without gradients: frames of fixed size, which never wait for the device.

Only the device knows the number of intersections of tiles and splats. The first frame of a kind reads it back; later
frames allocate the capacity that frames so far needed, and a little more. A frame that needs more is still drawn right:
each tile looks through all splats. The next frame allocates more.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.device import device_guard, free_memory
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import float_and_byte_addresses

if TYPE_CHECKING:
    from lightfield_gs.rasterizer.direct import DirectRender

# Capacity beyond the intersections of the last frame, as a fraction of them: for one rig, and for rigs that change
_SLACK, _MOVING_SLACK = 1 / 16, 1.0
# Polynomial orders tried for colours that vary over a rig; the order that was good enough is remembered. Colours for
# which the highest order is not good enough are exact
COLOUR_ORDERS = (2, 4, 8)
_LEAST_CAPACITY = 1 << 12
_VISIBLE = 1 / 255  # errors above this are told
_MOST_INTERSECTIONS, _INTERSECTION_BYTES = 2**32 - 1, 4  # they are numbered with 32 bits
_MOST_KNOWN = 64  # kinds of frames that are remembered
# An environment variable for tests and measurements: the kernels of frames draw as on a device of less shared memory
SHARED_MEMORY_LIMIT = "LFGS_SHARED_MEMORY_LIMIT"
# Errors of the polynomials of colours in exact frames, whose other errors are larger than on the CPU. The first bounds
# the error of the frame's order, the second the error of each splat's shortened polynomial. The second adds up over all
# splats of a sample. At the highest order a colour whose bound exceeds the third is exact; the bound is some ten times
# the real error of few splats.
_COLOUR_TOLERANCE, _COLOUR_LEFT_OUT, _COLOUR_MOST = 2e-5, 5e-6, 1e-4


def _colour_tolerances(quality: Quality) -> tuple[float, float, float]:
    """Return the tolerances of colours: of the frame's order, of each splat's powers left out, of the highest order.

    Kernels that draw colours as lines or parabolas err by the same amount again, so the second is half of the
    tolerance.
    """
    exact = quality.colour_error == EXACT.colour_error
    if exact:
        return _COLOUR_TOLERANCE, _COLOUR_LEFT_OUT, _COLOUR_MOST
    return quality.colour_error, quality.colour_error / 2, quality.colour_error


class DirectFrame:
    """One light-field image: its work buffer, of torch's allocator, and its stages, on torch's stream."""

    def __init__(
        self, job: DirectRender, quality: Quality, colour_order: int, capacity: int, kernel: str | None = None
    ):
        """Allocate the work buffer.

        Args:
            job: the render.
            quality: how much error is allowed.
            colour_order: of the polynomials of colours.
            capacity: for how many intersections memory is made.
            kernel: one of _core.cuda.FRAME_KERNELS; None: chosen by cost.
        """
        self.scene = scene = job.scene
        _, left_out, most = _colour_tolerances(quality)
        self.native = _core.cuda.DirectFrame(
            gaussians=scene.count,
            sh_degree=scene.degree,
            colour_order=colour_order,
            rig=job.native.rig,
            lens=job.native.lens,
            capacity=capacity,
            quality=quality.native,
            colour_error=most,
            left_out=left_out,
            shared_memory=shared_memory_limit(),
        )
        if kernel is not None:
            self.native.force(_core.cuda.FRAME_KERNELS.index(kernel))
        self.work = scene.new(self.native.bytes(), dtype=torch.uint8)
        self.native.place(self.work.data_ptr())
        self.capacity, self.colour_order = capacity, colour_order

    @property
    def stream(self) -> int:
        return torch.cuda.current_stream(self.work.device).cuda_stream

    def project(self, keep_lists: bool = False) -> None:
        """Run the stage project.

        Args:
            keep_lists: Keep the lists of order and bin, since only colours have changed.
        """
        _core.cuda.frame_project(self.native, self.scene.native(), keep_lists, self.stream)

    def bin(self) -> None:
        _core.cuda.frame_bin(self.native, self.stream)

    def order(self) -> None:
        _core.cuda.frame_order(self.native, self.stream)

    def composite(self, background: Tensor, out: Tensor) -> None:
        _core.cuda.frame_composite(self.native, background.data_ptr(), *float_and_byte_addresses(out), self.stream)

    def draw(self, background: Tensor, out: Tensor, stats: Stats | None = None, keep_lists: bool = False) -> None:
        """Run all stages in order; with keep_lists (see project) neither bin nor order."""
        stats = stats or Stats()
        with stats.stage("project"):
            self.project(keep_lists)
        if not keep_lists:
            with stats.stage("bin"):
                self.bin()
            with stats.stage("order"):
                self.order()
        with stats.stage("composite"):
            self.composite(background, out)

    def state(self) -> dict[str, Any]:
        """Return the device's statistics; wait for the device.

        Keys: pairs, drawn, colour_error, kernel, exact, bent_colours, curved, pruned, lattice_tiles, refused_tiles,
        tried_tiles.
        """
        return _read_state(self.state_bytes().cpu())

    def state_bytes(self) -> Tensor:
        """Return the state on the device, uint8: a part of the work buffer."""
        offset = self.native.state_address() - self.work.data_ptr()
        return self.work[offset : offset + _core.cuda.FRAME_STATE_BYTES]


def shared_memory_limit() -> int:
    """Return the most bytes of shared memory for a block of a frame's kernels; 0: the device's limit.

    The environment variable LFGS_SHARED_MEMORY_LIMIT sets it, from 1 on. Raises InputError for another value.
    """
    text = os.environ.get(SHARED_MEMORY_LIMIT, "")
    if text and not (text.isascii() and text.isdigit() and len(text) <= 10 and 0 < int(text) < 2**31):
        raise InputError(
            f"{SHARED_MEMORY_LIMIT}: expected a number of bytes from 1 on in this environment variable, such as "
            f"101376, got {text!r}; unset it for what the device has"
        )
    return int(text or 0)


def _read_state(host: Tensor) -> dict[str, Any]:
    state = _core.cuda.frame_state(host.data_ptr())
    return {**state, "kernel": _core.cuda.FRAME_KERNELS[state["kernel"]]}


class DirectFrames:
    """Draw frames of scenes of one kind and quality by any rigs, and remember the capacity and colour order they need.

    Polynomials of colours have the highest order that a frame so far needed. Where rigs change, colours may therefore
    differ from `known_frames` by the errors of both. Each is at most twice the tolerance: once for the order, once for
    the powers left out. A frame that needs a higher order is still drawn with the earlier order; the next frame has the
    new order. The next tells if the error was more than 1/255. Where frames are counted, the frame is drawn again.
    """

    def __init__(self, job: DirectRender, quality: Quality, slack: float = _MOVING_SLACK):
        """Prepare for renders like `job`.

        Scenes with a compensation are drawn without lattices and half precision, whatever the quality.

        Args:
            job: any of the renders.
            quality: how much error is allowed.
            slack: capacity beyond the intersections of the last frame, as a fraction of their number.
        """
        if job.compensated:
            quality = replace(quality, lattice_error=0.0, evaluation_error=0.0)
        self.device, self.quality, self.slack = job.scene.device, quality, slack
        self.orders = (0,) if job.scene.degree == 0 else COLOUR_ORDERS
        self.capacity: int | None = None
        self.colour_order = self.orders[0]
        self.kernel = forced_kernel
        with torch.inference_mode(False):  # it is kept for frames that are drawn outside of it
            self.host = torch.empty(_core.cuda.FRAME_STATE_BYTES, dtype=torch.uint8, pin_memory=True)
        self.noted: torch.cuda.Event | None = None  # once it is reached, `host` holds the state of a frame

    def takes(self, job: DirectRender) -> bool:
        """Return whether the scene of a job is of this kind; its number of Gaussians does not matter."""
        return job.scene.device == self.device and (job.scene.degree == 0) == (self.orders == (0,))

    def draw(
        self, job: DirectRender, as_bytes: bool = False, stats: Stats | None = None, out: Tensor | None = None
    ) -> Tensor:
        """Draw the image [H, W, 3], into `out` if given. Fills `stats`."""
        stats = stats or Stats()
        with device_guard(job.scene.device):
            with stats.stage("plan"):
                frame, out = self.frame(job), job.new_image(as_bytes) if out is None else out
            frame.draw(job.background, out, stats)
            while stats.device is not None and self._needs_order(state := frame.state()):
                frame = self._frame(job, cast(int, self.capacity))
                frame.draw(job.background, out, stats)
            if not torch.cuda.is_current_stream_capturing():  # a user's graph may outlive `host`, and still write there
                self.note(frame)
            if stats.device is not None:
                stats.count_frame(state, frame.work)
        return out

    def frame(self, job: DirectRender) -> DirectFrame:
        """Return a frame of the capacity that frames so far needed. The first waits for the device."""
        if self.capacity is None:
            self._learn(job)
        elif not torch.cuda.is_current_stream_capturing():
            self.adapt()
        return self._frame(job, cast(int, self.capacity))

    def note(self, frame: DirectFrame) -> None:
        """Begin to copy the frame's state to the host, where `adapt` reads it."""
        self.host.copy_(frame.state_bytes(), non_blocking=True)
        if not torch.cuda.is_current_stream_capturing():
            self.mark()

    def mark(self) -> None:
        """Note that a copy of a frame's state is under way on the current stream."""
        self.noted = torch.cuda.Event()
        self.noted.record()

    def adapt(self) -> bool:
        """Raise capacity or order if the last noted state has arrived and shows a lack; return whether it did."""
        if self.noted is None or not self.noted.query():
            return False
        self.noted = None
        state = _read_state(self.host)
        error, allowed = state["colour_error"], sum(_colour_tolerances(self.quality)[:2])
        if error > max(_VISIBLE, allowed) and self.colour_order < self.orders[-1]:
            assume(
                f"colours of the frame before are off by up to {255 * error:.1f}/255: its Gaussians are nearer to the "
                "cameras than those of the frames before it. Frames from now on are right; draw that one again"
            )
        return self._needs(state)

    def _learn(self, job: DirectRender) -> None:
        """Learn the capacity and colour order of a first frame, without drawing it."""
        if torch.cuda.is_current_stream_capturing():
            raise InputError(
                "the first frame of a kind waits for the device, which a stream that captures a graph "
                "must not: encode once before the capture"
            )
        while True:
            frame = self._frame(job, 0)
            frame.project()
            frame.bin()  # without capacity it only counts the intersections
            order = self.colour_order
            self._needs(frame.state())
            if order == self.colour_order:
                return

    def _needs(self, state: dict[str, Any]) -> bool:
        """Raise capacity and order of colours to the needs of a frame of this state; return whether either changed."""
        before = self.capacity, self.colour_order
        if self.capacity is None or state["intersections"] > self.capacity:
            affordable = free_memory(self.device) // (2 * _INTERSECTION_BYTES)
            enough = min(
                int(state["intersections"] * (1 + self.slack)) + _LEAST_CAPACITY, _MOST_INTERSECTIONS, affordable
            )
            self.capacity = max(self.capacity or 0, enough)
        self._needs_order(state)
        return before != (self.capacity, self.colour_order)

    def _needs_order(self, state: dict[str, Any]) -> bool:
        """Raise the order of colours if a frame of this state lacked one; return whether it did."""
        before = self.colour_order
        if state["colour_error"] > sum(_colour_tolerances(self.quality)[:2]):
            self.colour_order = next((o for o in self.orders if o > before), before)
        return self.colour_order > before

    def _frame(self, job: DirectRender, capacity: int) -> DirectFrame:
        return DirectFrame(job, self.quality, self.colour_order, capacity, self.kernel)


_known: OrderedDict[tuple, DirectFrames] = OrderedDict()
# For tests and measurements: the kernel of _core.cuda.FRAME_KERNELS for all frames; None: chosen by cost
forced_kernel: str | None = None


def known_frames(job: DirectRender, quality: Quality) -> DirectFrames:
    """Return the frames of one camera, number of Gaussians and quality; the last 64 are remembered."""
    scene = job.scene
    key = (
        scene.device,
        scene.count,
        scene.degree,
        job.camera,
        job.antialiased,
        quality,
        forced_kernel,
        shared_memory_limit(),
    )
    if key not in _known:
        _known[key] = DirectFrames(job, quality, _SLACK)
        while len(_known) > _MOST_KNOWN:
            _known.popitem(last=False)
    _known.move_to_end(key)
    return _known[key]
