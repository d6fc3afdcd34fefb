"""Light-field frames by WebGPU: project, lists, order, composite and pack, pass by pass over the panel's rows."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.webgpu.buffers import Buffers, Limits
from lightfield_gs.webgpu.parameters import BOX_ROWS, ORDINALS, Boxes, pack_params, tilings
from lightfield_gs.webgpu.pipelines import WORKGROUPS_ACROSS, Clock, Pipelines, Work
from lightfield_gs.webgpu.shaders import Variant

if TYPE_CHECKING:
    import wgpu

_THREADS = 256  # of a workgroup of most stages
_CHUNK = 1024  # elements of a long list that are sorted together, as in csrc/webgpu/sort.wgsl
_MOST_PAIRS = (1 << 25) - (1 << 20)  # of a pass, so that the chunks of long lists fit into one dispatch
_LARGE_GROUPS = 256  # workgroups that share the splats with many boxes
_GAUSSIAN_BYTES, _VECTOR_BYTES = 48, 16
_COLOURS_EACH = 4  # vectors of a colour that varies, at first: pools grow
_HEAD, _HEAD_BYTES = 16, 64  # counters before the costs
# A composite is dispatched in bands: Windows resets a GPU after two seconds in one dispatch, and screens wait for it.
# The first band has so many instructions, which the slowest GPUs that still matter run in 30 ms. Each later one has at
# most four times those of the band before, and takes so many seconds by the slowest rate of the first frame.
_FIRST_BAND, _BAND_GROWTH, _BAND_SECONDS = 4e9, 4, 0.05


class _Counters(NamedTuple):
    """The first counters of csrc/webgpu/frame.wgsl."""

    pairs: int
    longest: int
    colours: int
    chunks: int
    large: int
    drawn: int
    error: float


class _Pass(NamedTuple):
    """Rows of boxes that are drawn together: first, and one behind the last."""

    first: int
    end: int


class _Bands:
    """The bands of a composite: how many rows of boxes are drawn at once.

    Args:
        rate: Instructions a second, of frames before; None: bands are timed.
        row_cost: Instructions of a row of boxes, on average.
    """

    def __init__(self, rate: float | None, row_cost: float) -> None:
        self.rate, self.are_timed = rate, rate is None
        self._row_cost = max(row_cost, 1.0)
        self._budget = _FIRST_BAND if rate is None else rate * _BAND_SECONDS

    def rows(self) -> int:
        """Return the rows of the next band."""
        return max(int(self._budget / self._row_cost), 1)

    def took(self, rows: int, seconds: float) -> None:
        """Learn from the time of a band."""
        own = rows * self._row_cost / seconds
        self.rate = own if self.rate is None else min(self.rate, own)
        self._budget = min(_BAND_GROWTH * self._budget, self.rate * _BAND_SECONDS)


class Frames:
    """Draws frames on one device.

    Attributes:
        tiling: For tests and measurements: the ordinals of boxes; None: the cheapest.
        most_rows: Likewise, rows of boxes that a composite draws at once; None: by cost.
        clock: Likewise; None: no stage is timed.
    """

    def __init__(self, device: wgpu.GPUDevice, limits: Limits) -> None:
        self.device, self.limits = device, limits
        self.pipelines, self.buffers = Pipelines(device), Buffers(device, limits)
        self.tiling: int | None = None
        self.most_rows: int | None = None
        self.clock: Clock | None = None
        self.rate: float | None = None  # instructions a second
        self.harmonics: object | None = None  # those that the device holds, see draw

    def draw(
        self,
        job: DirectRender,
        as_bytes: bool,
        quality: Quality,
        stats: Stats,
        out: Tensor | None,
        harmonics: object | None = None,
    ) -> Tensor:
        """Return the image [H, W, 3] on the CPU, uint8 or float32.

        Args:
            job: The render, on the CPU, in float32.
            as_bytes: Whether the image is uint8.
            quality: Its colour_error alone is given up.
            stats: Filled with times and counts.
            out: An image of that size and type to write to.
            harmonics: Stays the same object as long as the harmonics have the same values: they are not copied to the
                device again then. None: they are.

        Raises:
            InputError: The scene is too large for the adapter.
        """
        image = job.new_image(as_bytes) if out is None else out
        with stats.stage("project"):
            frame = _Frame(self, job, as_bytes, quality, harmonics)
            counters, costs = frame.project()
            boxes, cost = frame.choose_boxes(costs)
        with stats.stage("composite"):
            for rows in frame.passes(boxes):
                stats.intersections += frame.draw_rows(boxes, rows, cost, image)
        stats.images, stats.gaussians_drawn = 1, counters.drawn
        stats.colour_error = counters.error
        stats.kernel = f"webgpu-{'pixel' if not boxes.ordinals else f'lens-{boxes.ordinals}'}"
        stats.work_bytes += self.buffers.bytes()
        return image


class _Frame:
    """One frame on its way."""

    def __init__(
        self, frames: Frames, job: DirectRender, as_bytes: bool, quality: Quality, harmonics: object | None
    ) -> None:
        self.frames, self.job, self.as_bytes, self.harmonics = frames, job, as_bytes, harmonics
        self.buffers, self.limits = frames.buffers, frames.limits
        self.lens = job.camera.lens
        self.degree, self.count = job.scene.degree, job.scene.count
        self.tolerance = quality.colour_error
        self.background = job.background.detach().cpu().numpy()
        self.pixel_bytes = 4 if as_bytes else 12
        each = max(_GAUSSIAN_BYTES, 12 * (self.degree + 1) ** 2)
        # Gaussians that are projected in one dispatch
        self.part = max(min(self.limits.most_bytes // each, WORKGROUPS_ACROSS * _THREADS) // _THREADS, 1) * _THREADS
        self.variant = Variant(
            0, bool(self.lens.cell_phases), self.lens.bgr, self.degree > 0, job.compensated, not as_bytes
        )
        self.room = {"pairs": 0, "colours": 0, "chunks": _CHUNK}
        self._parts = 0  # numbers the structs Part

    def _write_params(self, boxes: Boxes, rows: _Pass) -> None:
        room = self.room["pairs"], self.room["colours"], self.count, self.room["chunks"]
        job = self.job
        data = pack_params(
            job.camera, job.antialiased, self.degree, self.count, self.background, self.tolerance, boxes, rows, room
        )
        self.buffers.write("P", data, uniform=True)

    def _write_part(self, first: int, count: int = 0, first_row: int = 0, group: int = 0) -> str:
        """Write a struct Part of its own for one dispatch of this frame; return the name of its buffer."""
        name, self._parts = f"part {self._parts}", self._parts + 1
        self.buffers.write(name, np.array([first, count, first_row, group], np.uint32).tobytes(), uniform=True)
        return name

    def project(self) -> tuple[_Counters, np.ndarray]:
        """Project all Gaussians; return the counters, and the costs of the tilings [4]."""
        groups = -(-self.count // _THREADS)
        if groups > WORKGROUPS_ACROSS:
            raise InputError(
                f"webgpu: expected at most {WORKGROUPS_ACROSS * _THREADS} Gaussians, got {self.count}: use device cpu, "
                "or leave out Gaussians (lightfield-gs prune)"
            )
        extra = int(self.variant.compensated)
        colours = (1 + extra if not self.degree else _COLOURS_EACH + extra) * max(self.count, 1)
        for name in ("splat_a", "splat_b", "splat_c"):
            self.buffers.storage(name, _VECTOR_BYTES * self.count, f"a scene of {self.count} Gaussians")
        self.buffers.storage("depths", 4 * self.count, "a depth each")
        self.buffers.storage("large", 4 * self.count, "a number each")
        self.buffers.storage("counters", _HEAD_BYTES + _VECTOR_BYTES * groups, "a sum for 256 Gaussians each")
        while True:
            what = f"the colours of {self.count} Gaussians with harmonics of degree {self.degree}"
            colours = min(colours, max(self.limits.most_bytes // _VECTOR_BYTES, 1))
            self.room["colours"] = self.buffers.storage("colours", _VECTOR_BYTES * colours, what) // _VECTOR_BYTES
            self._project_parts()
            head = self.buffers.read("counters", _HEAD_BYTES + _VECTOR_BYTES * groups)
            counters = self._counters(head)
            if counters.colours <= self.room["colours"]:
                costs = np.frombuffer(head, np.float32, 4 * groups, _HEAD_BYTES).reshape(groups, 4)
                return counters, costs.sum(0, dtype=np.float64)
            colours = counters.colours
            self.buffers.storage("colours", _VECTOR_BYTES * colours, what)

    def _project_parts(self) -> None:
        self._write_params(Boxes.of(self.lens, 0), _Pass(0, 1))
        work = Work(self.frames.pipelines, self.buffers, self.variant, self.frames.clock)
        work.clear("counters")
        work.submit()
        means, quaternions, scales, opacities, sh = (t[0] for t in self.job.scene.tensors)
        pose = torch.tensor(self.job.camera.world_to_camera, dtype=torch.float64).reshape(4, 4)
        for first in range(0, self.count, self.part):
            end = min(first + self.part, self.count)
            packed = torch.zeros(end - first, 12)
            # In double, so that near Gaussians keep the order of depths that the CPU finds
            packed[:, :3] = means[first:end].double() @ pose[:3, :3].T + pose[:3, 3]
            packed[:, 3] = opacities[first:end]
            packed[:, 4:8], packed[:, 8:11] = quaternions[first:end], scales[first:end]
            self._upload("gaussians", packed)
            if self.harmonics is None or self.harmonics is not self.frames.harmonics:
                self._upload("harmonics", sh[first:end].contiguous())
            part = self._write_part(first, end - first, 0, first // _THREADS)
            work = Work(self.frames.pipelines, self.buffers, self.variant, self.frames.clock)
            work.run("project", (-(-(end - first) // _THREADS),), {"part": part})
            work.submit()
        self.frames.harmonics = self.harmonics if self.count <= self.part else None

    def _upload(self, name: str, values: Tensor) -> None:
        data = values.numpy().reshape(-1).view(np.uint8).data
        self.buffers.storage(name, len(data), "a part of the scene")
        self.buffers.write(name, data)

    @staticmethod
    def _counters(head: memoryview) -> _Counters:
        words = np.frombuffer(head, np.uint32, _HEAD)
        pairs, longest, colours, chunks, large, drawn = (int(word) for word in words[:6])
        return _Counters(pairs, longest, colours, chunks, large, drawn, float(words[6:7].view(np.float32)[0]))

    def choose_boxes(self, costs: np.ndarray) -> tuple[Boxes, float]:
        """Return the cheapest boxes, and the instructions of their composite."""
        allowed = tilings(self.lens)
        by_tiling = dict(zip(ORDINALS, costs.tolist()))
        ordinals = min(allowed, key=lambda k: by_tiling[k]) if self.frames.tiling is None else self.frames.tiling
        return Boxes.of(self.lens, ordinals), by_tiling[ordinals]

    def passes(self, boxes: Boxes) -> list[_Pass]:
        """Return the rows of boxes of each pass, as many as image and lists allow."""
        most = self.limits.most_bytes
        image_rows = most // (self.lens.width_px * self.pixel_bytes * BOX_ROWS)
        list_rows = most // (12 * boxes.across * boxes.groups)
        scan_rows = WORKGROUPS_ACROSS * _THREADS // (boxes.across * boxes.groups)
        rows = max(min(image_rows, list_rows, scan_rows, WORKGROUPS_ACROSS, boxes.down), 1)
        return [_Pass(first, min(first + rows, boxes.down)) for first in range(0, boxes.down, rows)]

    def draw_rows(self, boxes: Boxes, rows: _Pass, cost: float, image: Tensor) -> int:
        """Draw the rows of a pass into the image; return the number of intersections."""
        counters = self._list(boxes, rows)
        most = min(self.limits.most_bytes // 4, _MOST_PAIRS)
        if counters.pairs > most and rows.end - rows.first > 1:
            middle = (rows.first + rows.end) // 2
            halves = _Pass(rows.first, middle), _Pass(middle, rows.end)
            return sum(self.draw_rows(boxes, half, cost, image) for half in halves)
        self._sort(boxes, rows, counters)
        self._composite(boxes, rows, cost, image)
        return counters.pairs

    def _list(self, boxes: Boxes, rows: _Pass) -> _Counters:
        """Count the lists of a pass and give them their places."""
        buffers, own = self.buffers, boxes.across * boxes.groups * (rows.end - rows.first)
        self.variant = Variant(**{**vars(self.variant), "ordinals": boxes.ordinals})
        buffers.storage("bins", 12 * own, f"a panel of {own} boxes")
        buffers.storage("pairs", 4, "an empty list")
        while True:
            chunk_bytes = buffers.storage("chunks", 8 * self.room["chunks"], "lists of Gaussians this long")
            self.room["chunks"] = chunk_bytes // 8
            self._write_params(boxes, rows)
            work = Work(self.frames.pipelines, buffers, self.variant, self.frames.clock)
            work.clear("counters", "bins")
            groups = -(-self.count // _THREADS)
            work.run("count", (groups,))
            work.run("count_large", (min(_LARGE_GROUPS, self.count),))
            work.run("allocate", (-(-own // _THREADS),))
            work.submit()
            counters = self._counters(buffers.read("counters", _HEAD_BYTES))
            if counters.chunks <= self.room["chunks"]:
                return counters
            self.room["chunks"] = counters.chunks

    def _sort(self, boxes: Boxes, rows: _Pass, counters: _Counters) -> None:
        """Fill the lists and bring each into the order of depths."""
        self.room["pairs"] = self.buffers.storage("pairs", 4 * counters.pairs, "a row of the picture") // 4
        self._write_params(boxes, rows)
        work = Work(self.frames.pipelines, self.buffers, self.variant, self.frames.clock)
        groups = -(-self.count // _THREADS)
        work.run("scatter", (groups,))
        work.run("scatter_large", (min(_LARGE_GROUPS, counters.large),))
        work.run("sort_short", (boxes.across, rows.end - rows.first, boxes.groups))
        if counters.chunks:
            work.run("sort_chunk", (counters.chunks,))
            self._merge(work, counters)
        work.submit()

    def _merge(self, work: Work, counters: _Counters) -> None:
        """Merge the chunks of long lists; as many passes there as back, so that they end where they began."""
        self.buffers.storage("merged", self.buffers["pairs"].size, "lists of Gaussians this long")
        passes = max(math.ceil(math.log2(counters.longest / _CHUNK)), 0)
        for k in range(passes + passes % 2):
            part = self._write_part(0, _CHUNK << k)
            there = {"pairs": "pairs", "merged": "merged"} if k % 2 == 0 else {"pairs": "merged", "merged": "pairs"}
            work.run("merge_runs", (counters.chunks,), {"part": part, **there})

    def _composite(self, boxes: Boxes, rows: _Pass, cost: float, image: Tensor) -> None:
        """Draw the samples of a pass, in dispatches that no GPU is busy with for long, and copy them to the image."""
        first = rows.first * BOX_ROWS
        end = min(rows.end * BOX_ROWS, self.lens.height_px)
        pixels = -(-(end - first) * self.lens.width_px // 4) * 4
        self.buffers.exactly("image", pixels * self.pixel_bytes)
        begin, bands = rows.first, _Bands(self.frames.rate, cost / boxes.down)
        while begin < rows.end:
            at_once = bands.rows() if self.frames.most_rows is None else self.frames.most_rows
            work = Work(self.frames.pipelines, self.buffers, self.variant, self.frames.clock)
            if begin == rows.first and boxes.ordinals and self.as_bytes:
                work.clear("image")
            part = self._write_part(begin, 0, first)
            at_once = min(at_once, rows.end - begin)
            work.run("composite", (boxes.across, at_once, boxes.groups), {"part": part})
            start = time.perf_counter()
            work.submit()
            if bands.are_timed:
                self.buffers.read("counters", 4)  # waits
                bands.took(at_once, time.perf_counter() - start)
            begin += at_once
        self.frames.rate = bands.rate
        image[first:end] = self._read_image(pixels, (end - first, self.lens.width_px, 3))

    def _read_image(self, pixels: int, shape: tuple[int, int, int]) -> Tensor:
        dtype, name = (np.uint8, "packed") if self.as_bytes else (np.float32, "image")
        if self.as_bytes:
            self.buffers.exactly("packed", 3 * pixels)
            work = Work(self.frames.pipelines, self.buffers, self.variant, self.frames.clock)
            groups = -(-pixels // (4 * _THREADS))
            down = -(-groups // WORKGROUPS_ACROSS)
            work.run("pack", (-(-groups // down), down))
            work.submit()
        count = math.prod(shape)
        data = self.buffers.read(name, -(-count * np.dtype(dtype).itemsize // 4) * 4)
        return torch.from_numpy(np.frombuffer(data, dtype, count).reshape(shape).copy())
