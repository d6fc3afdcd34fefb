"""Light-field frames by WebGPU: one submission each, once it is known what frames of their kind need.

A first frame waits for the device three times: for the costs of the tilings, for the lengths of the lists, and for the
image. The next frames of a run take what it needed: the host waits once, for the image and the counters. If these show
that a frame lacked room, it is drawn again with more.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import TRANSMITTANCE_STOP, Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.webgpu.buffers import Buffers, Limits
from lightfield_gs.webgpu.parameters import BOX_ROWS, Boxes, pack_params
from lightfield_gs.webgpu.pipelines import WORKGROUPS_ACROSS, Clock, Pipelines, Work
from lightfield_gs.webgpu.plans import CHUNK, HEAD_BYTES, MOST_PAIRS, Bands, Counters, Pass, Plan, Room
from lightfield_gs.webgpu.resident import Kept, Part, Resident
from lightfield_gs.webgpu.shaders import Variant

if TYPE_CHECKING:
    import wgpu

_THREADS = 256  # of a workgroup of most stages
_LARGE_GROUPS = 256  # workgroups that share the splats with many boxes
_VECTOR_BYTES = 16
_COLOURS_EACH = 4  # vectors of a colour that varies, at first: pools grow
_MOST_PLANS = 64  # kinds of frames that are remembered
_SUBMISSION_SECONDS = 0.5  # of bands in a submission, by the device's rate: screens wait for submissions too


class Frames:
    """Draws frames on one device.

    Attributes:
        tiling: For tests and measurements: the ordinals of boxes; None: the cheapest.
        most_rows: Likewise, rows of boxes that a composite draws at once; None: by cost.
        clock: Likewise; None: no stage is timed.
        submissions: How often work was handed to the device.
    """

    def __init__(self, device: wgpu.GPUDevice, limits: Limits) -> None:
        self.device, self.limits = device, limits
        self.pipelines, self.buffers = Pipelines(device), Buffers(device, limits)
        self.scene = Resident(self.buffers, WORKGROUPS_ACROSS)
        self.tiling: int | None = None
        self.most_rows: int | None = None
        self.clock: Clock | None = None
        self.rate: float | None = None  # instructions a second
        self.submissions = 0
        self._plans: OrderedDict[tuple[object, ...], Plan] = OrderedDict()

    def draw(
        self,
        job: DirectRender,
        as_bytes: bool,
        quality: Quality,
        stats: Stats,
        out: Tensor | None,
        kept: Kept | None = None,
    ) -> Tensor:
        """Return the image [H, W, 3] on the CPU, uint8 or float32.

        Args:
            job: The render, on the CPU, in float32.
            as_bytes: Whether the image is uint8.
            quality: Its cuts, its stop and its error of colours; the rest stays exact.
            stats: Filled with times and counts.
            out: An image of that size and type to write to.
            kept: What the scene's values are, so that they are copied to the device once; None: they are copied.

        Raises:
            InputError: The scene is too large for the adapter.
        """
        image = job.new_image(as_bytes) if out is None else out
        frame = _Frame(self, job, as_bytes, quality, self._plan(job, as_bytes))
        with stats.stage("upload"):
            frame.upload(kept)
        with stats.stage("frame"):
            frame.draw(image, stats)
        stats.work_bytes += self.buffers.bytes()
        return image

    def work(self, variant: Variant) -> Work:
        """Return a new submission."""
        return Work(self.pipelines, self.buffers, variant, self.clock)

    def submit(self, work: Work) -> None:
        """Hand the work to the device."""
        self.submissions += 1
        work.submit()

    def _plan(self, job: DirectRender, as_bytes: bool) -> Plan:
        kind = job.camera.lens, job.scene.count, job.scene.degree, job.compensated, as_bytes
        plan = self._plans.setdefault(kind, Plan())
        self._plans.move_to_end(kind)
        if len(self._plans) > _MOST_PLANS:
            self._plans.popitem(last=False)
        return plan


class _Frame:
    """One frame on its way."""

    def __init__(self, frames: Frames, job: DirectRender, as_bytes: bool, quality: Quality, plan: Plan) -> None:
        self.frames, self.job, self.as_bytes, self.plan = frames, job, as_bytes, plan
        self.parts: list[Part] = []
        self.is_in_run = False  # of frames; else boxes do not depend on the frame before, nor does rounding
        self.buffers, self.limits = frames.buffers, frames.limits
        self.lens, self.quality = job.camera.lens, quality
        self.degree, self.count = job.scene.degree, job.scene.count
        self.background = job.background.detach().cpu().numpy()
        self.pixel_bytes, self.result_bytes = (4, 3) if as_bytes else (12, 12)
        self.groups = -(-self.count // _THREADS)
        self.head_bytes = HEAD_BYTES + _VECTOR_BYTES * max(self.groups, 1)
        self.most_pairs = min(self.limits.most_bytes // 4, MOST_PAIRS)
        ends_early = quality.transmittance_stop > TRANSMITTANCE_STOP
        self.variant = Variant(
            0, bool(self.lens.cell_phases), self.lens.bgr, self.degree > 0, job.compensated, not as_bytes, ends_early
        )
        self.written = 0  # structs Part of this submission

    def draw(self, image: Tensor, stats: Stats) -> None:
        """Draw the image, pass by pass, each again until it had room; count into `stats`."""
        forced, plan = self.frames.tiling, self.plan
        is_projected = False
        if plan.ordinals is None or not self.is_in_run or forced not in (None, plan.ordinals):
            plan.choose(self.lens, self._projected().costs, forced)
            is_projected = True
        ordinals = plan.ordinals or 0
        found = self._draw_boxes(ordinals, is_projected, image, stats)
        if (cheapest := plan.choose(self.lens, found.costs, forced)) != ordinals:
            # Its own costs decide, not those of the frame before: else rounding would depend on that
            stats.intersections = 0
            ordinals = cheapest
            found = self._draw_boxes(ordinals, True, image, stats)
        stats.images, stats.gaussians_drawn, stats.colour_error = 1, found.drawn, found.error
        stats.pruned = found.pruned
        stats.kernel = f"webgpu-{'pixel' if not ordinals else f'lens-{ordinals}'}"

    def _draw_boxes(self, ordinals: int, is_projected: bool, image: Tensor, stats: Stats) -> Counters:
        """Draw the image by boxes of so many ordinals; return the counters of the last pass."""
        plan, boxes = self.plan, Boxes.of(self.lens, ordinals)
        self.variant = Variant(**{**vars(self.variant), "ordinals": boxes.ordinals})
        room = plan.rooms.setdefault(boxes.ordinals, Room(self._passes(boxes)))
        waiting = room.passes[::-1]
        while waiting:
            rows = waiting.pop()
            found = self._pass(boxes, rows, room, is_projected, image)
            is_projected = found.colours <= plan.colours
            if is_projected and room.holds(found):
                stats.intersections += found.pairs
            elif is_projected and found.pairs > self.most_pairs and rows.end - rows.first > 1:
                waiting += room.split(rows)[::-1]
            else:
                waiting.append(rows)
            self._enlarge(found, room, rows)
        return found

    def upload(self, kept: Kept | None) -> None:
        """Make the buffers of the stage project, and bring the scene to the device. Raises InputError."""
        if self.groups > WORKGROUPS_ACROSS:
            raise InputError(
                f"webgpu: expected at most {WORKGROUPS_ACROSS * _THREADS} Gaussians, got {self.count}: use device cpu, "
                "or leave out Gaussians (lightfield-gs prune)"
            )
        for name in ("splat_a", "splat_b", "splat_c"):
            self.buffers.storage(name, _VECTOR_BYTES * self.count, f"a scene of {self.count} Gaussians")
        self.buffers.storage("depths", 4 * self.count, "a depth each")
        self.buffers.storage("large", 4 * self.count, "a number each")
        self.buffers.storage("counters", self.head_bytes, "a sum for 256 Gaussians each")
        extra = int(self.variant.compensated)
        self._make_colours((1 + extra if not self.degree else _COLOURS_EACH + extra) * max(self.count, 1))
        self.parts, self.is_in_run = self.frames.scene.hold(self.job.scene, kept), kept is not None

    def _make_colours(self, colours: int) -> None:
        """Make room for so many vectors; at first for fewer, where the adapter allows no more."""
        if not self.plan.colours:
            colours = min(colours, max(self.limits.most_bytes // _VECTOR_BYTES, 1))
        colours = max(colours, self.plan.colours)
        what = f"the colours of {self.count} Gaussians with harmonics of degree {self.degree}"
        self.plan.colours = self.buffers.storage("colours", _VECTOR_BYTES * colours, what) // _VECTOR_BYTES

    def _enlarge(self, found: Counters, room: Room, rows: Pass) -> None:
        """Make room for what a pass lacked."""
        if found.colours > self.plan.colours:
            self._make_colours(found.colours)
        elif not room.holds(found):
            if found.pairs > self.most_pairs and rows.end - rows.first == 1:
                self.buffers.storage("pairs", 4 * found.pairs, "a row of the picture")  # raises
            room.grow(found, self.most_pairs)

    def _projected(self) -> Counters:
        """Project alone, and return the counters."""
        self.buffers.results("results", self.head_bytes)
        while True:
            self._write_params(Boxes.of(self.lens, 0), Pass(0, 1), Room([]))
            work = self._begin(False)
            work.copy("counters", 0, "results", 0, self.head_bytes)
            self.frames.submit(work)
            found = self._counters()
            if found.colours <= self.plan.colours:
                return found
            self._make_colours(found.colours)

    def _begin(self, is_projected: bool) -> Work:
        """Return work that clears the counters, and projects."""
        work, self.written = self.frames.work(self.variant), 0
        if is_projected:
            work.clear_words("counters", 0, 2)  # those of lists; colours and splats stay counted
            work.clear_words("counters", 3, 2)
            return work
        work.clear("counters")
        for part in self.parts:
            groups = -(-part.size // _THREADS)
            names = {**part.names, "part": self._part(part.first, part.size, 0, part.first // _THREADS)}
            work.run("project", (groups,), names)
        return work

    def _counters(self) -> Counters:
        with self.buffers.mapped("results", self.head_bytes) as data:
            return Counters.of(data)

    def _passes(self, boxes: Boxes) -> list[Pass]:
        """Return the rows of boxes of each pass, as many as image and lists allow."""
        most, results = self.limits.most_bytes, self.limits.buffer_bytes - self.head_bytes
        each = self.lens.width_px * BOX_ROWS
        image_rows = min(most // (each * self.pixel_bytes), results // (each * self.result_bytes))
        list_rows = most // (12 * boxes.across * boxes.groups)
        scan_rows = WORKGROUPS_ACROSS * _THREADS // (boxes.across * boxes.groups)
        rows = max(min(image_rows, list_rows, scan_rows, WORKGROUPS_ACROSS, boxes.down), 1)
        return [Pass(first, min(first + rows, boxes.down)) for first in range(0, boxes.down, rows)]

    def _pass(self, boxes: Boxes, rows: Pass, room: Room, is_projected: bool, image: Tensor) -> Counters:
        """Draw rows into the image; where nothing is known of the lists, only count them. Return the counters."""
        own, draws = boxes.across * boxes.groups * (rows.end - rows.first), room.pairs is not None
        self.buffers.storage("bins", 12 * own, f"a panel of {own} boxes")
        self.buffers.storage("pairs", 4 * (room.pairs or 1), "the lists of the picture")
        self.buffers.storage("chunks", 8 * max(room.chunks, 1), "lists of Gaussians this long")
        if room.chunks:
            self.buffers.storage("merged", self.buffers["pairs"].size, "lists of Gaussians this long")
        first_row, end_row = rows.first * BOX_ROWS, min(rows.end * BOX_ROWS, self.lens.height_px)
        pixels = -(-(end_row - first_row) * self.lens.width_px // 4) * 4
        size = self.head_bytes + pixels * self.result_bytes * int(draws)
        self.buffers.results("results", size)
        self._write_params(boxes, rows, room)

        work = self._begin(is_projected)
        work.clear("bins")
        work.run("count", (self.groups,))
        work.run("count_large", (min(_LARGE_GROUPS, self.count),))
        work.run("allocate", (-(-own // _THREADS),))
        if draws:
            self._order(work, boxes, rows, room)
            work = self._composite(work, boxes, rows, pixels)
            work.copy("packed" if self.as_bytes else "image", 0, "results", self.head_bytes, size - self.head_bytes)
        work.copy("counters", 0, "results", 0, self.head_bytes)
        self.frames.submit(work)
        with self.buffers.mapped("results", size) as data:
            found = Counters.of(data[: self.head_bytes])
            if draws and room.holds(found) and found.colours <= self.plan.colours:
                values = np.frombuffer(data, np.uint8 if self.as_bytes else np.float32, offset=self.head_bytes)
                shape = end_row - first_row, self.lens.width_px, 3
                np.copyto(image.numpy()[first_row:end_row], values[: np.prod(shape)].reshape(shape))
        return found

    def _order(self, work: Work, boxes: Boxes, rows: Pass, room: Room) -> None:
        """Fill the lists and bring each into the order of depths."""
        work.run("scatter", (self.groups,))
        work.run("scatter_large", (min(_LARGE_GROUPS, self.count),))
        work.run("sort_short", (boxes.across, rows.end - rows.first, boxes.groups))
        if not room.chunks:
            return
        work.run("sort_chunk", (room.chunks,))
        for k in range(room.merges):  # as many there as back, so that the lists end where they began
            there = {"pairs": "pairs", "merged": "merged"} if k % 2 == 0 else {"pairs": "merged", "merged": "pairs"}
            work.run("merge_runs", (room.chunks,), {"part": self._part(0, CHUNK << k), **there})

    def _composite(self, work: Work, boxes: Boxes, rows: Pass, pixels: int) -> Work:
        """Draw the samples of a pass, no dispatch of which takes any GPU long; return the work to go on with."""
        self.buffers.exactly("image", pixels * self.pixel_bytes)
        if boxes.ordinals and self.as_bytes:
            work.clear("image")
        begin, bands = rows.first, Bands(self.frames.rate, self.plan.costs[boxes.ordinals] / boxes.down)
        seconds = 0.0
        while begin < rows.end:
            at_once = bands.rows() if self.frames.most_rows is None else self.frames.most_rows
            at_once = min(at_once, rows.end - begin)
            if bands.are_timed:
                work = self._flushed(work)
            seconds += bands.seconds(at_once)
            if seconds > _SUBMISSION_SECONDS:
                self.frames.submit(work)
                work, seconds = self.frames.work(self.variant), bands.seconds(at_once)
            part = self._part(begin, 0, rows.first * BOX_ROWS)
            work.run("composite", (boxes.across, at_once, boxes.groups), {"part": part})
            if bands.are_timed:
                start = time.perf_counter()
                work = self._flushed(work)
                bands.took(at_once, time.perf_counter() - start)
            begin += at_once
        self.frames.rate = bands.rate
        if self.as_bytes:
            self.buffers.exactly("packed", 3 * pixels)
            groups = -(-pixels // (4 * _THREADS))
            down = -(-groups // WORKGROUPS_ACROSS)
            work.run("pack", (-(-groups // down), down))
        return work

    def _flushed(self, work: Work) -> Work:
        """Submit work, wait for its end, and return new work."""
        self.buffers.results("waited for", 4)
        work.copy("counters", 0, "waited for", 0, 4)
        self.frames.submit(work)
        with self.buffers.mapped("waited for", 4):
            return self.frames.work(self.variant)

    def _write_params(self, boxes: Boxes, rows: Pass, room: Room) -> None:
        sizes = room.pairs or 0, self.plan.colours, self.count, room.chunks
        job = self.job
        data = pack_params(
            job.camera, job.antialiased, self.degree, self.count, self.background, self.quality, boxes, rows, sizes
        )
        self.buffers.parameters("P", data)

    def _part(self, first: int, count: int = 0, first_row: int = 0, group: int = 0) -> str:
        """Write a struct Part of its own for one dispatch of this submission; return the name of its buffer."""
        name, self.written = f"part {self.written}", self.written + 1
        self.buffers.parameters(name, np.array([first, count, first_row, group], np.uint32).tobytes())
        return name
