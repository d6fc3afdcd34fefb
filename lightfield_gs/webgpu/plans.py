"""What frames of a kind have needed so far: boxes and room for lists; and bands that take no GPU long."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from lightfield_gs.rasterizer.lenticular_camera import Lens
from lightfield_gs.webgpu.parameters import ORDINALS, tilings

HEAD, HEAD_BYTES = 16, 64  # counters before the costs
CHUNK = 1024  # elements of a long list that are sorted together, as in csrc/webgpu/sort.wgsl
MOST_PAIRS = (1 << 25) - (1 << 20)  # of a pass, so that the chunks of long lists fit into one dispatch
_SLACK, _LEAST_PAIRS = 1.25, 1 << 12  # room beyond the lists of the last frame
# A composite is dispatched in bands: Windows resets a GPU after two seconds in one dispatch, and screens wait for it.
# The first band has so many instructions, which the slowest GPUs that still matter run in 30 ms. Each later one has at
# most four times those of the band before, and takes so many seconds by the slowest rate of the first frame.
_FIRST_BAND, _BAND_GROWTH, _BAND_SECONDS = 4e9, 4, 0.05


class Counters(NamedTuple):
    """What the stages count: the first counters of csrc/webgpu/frame.wgsl, and the costs of the tilings."""

    pairs: int
    longest: int
    colours: int
    chunks: int
    large: int
    drawn: int
    error: float
    pruned: int
    costs: tuple[float, ...]

    @staticmethod
    def of(data: memoryview) -> Counters:
        """Read the buffer of counters."""
        words = np.frombuffer(data, np.uint32, HEAD)
        costs = np.frombuffer(data, np.float32, offset=HEAD_BYTES).reshape(-1, len(ORDINALS)).sum(0, dtype=np.float64)
        error = float(words[6:7].view(np.float32)[0])
        pairs, longest, colours, chunks, large, drawn, _, pruned = words[:8].tolist()
        return Counters(pairs, longest, colours, chunks, large, drawn, error, pruned, tuple(costs.tolist()))


class Pass(NamedTuple):
    """Rows of boxes that are drawn together: first, and one behind the last."""

    first: int
    end: int


@dataclass
class Room:
    """Room for the lists of a pass.

    Attributes:
        passes: Of a frame.
        pairs: Intersections of splats and boxes; None before the first frame.
        chunks: Of long lists.
        merges: How often the chunks of the longest list are merged, an even number.
    """

    passes: list[Pass]
    pairs: int | None = None
    chunks: int = 0
    merges: int = 0

    def holds(self, found: Counters) -> bool:
        """Return whether the lists were complete, and in order."""
        if self.pairs is None:
            return False
        return found.pairs <= self.pairs and found.chunks <= self.chunks and found.longest <= CHUNK << self.merges

    def grow(self, found: Counters, most: int) -> None:
        """Make room for such lists, within the most pairs of a pass."""
        self.pairs = max(self.pairs or 0, min(int(_SLACK * found.pairs) + _LEAST_PAIRS, most))
        if found.chunks:
            # A long list has a chunk more than its pairs fill at most; those of too many pairs were counted too
            self.chunks = max(self.chunks, min(int(_SLACK * found.chunks) + 1, 2 * most // CHUNK))
            passes = max(found.longest - 1, 0) // CHUNK
            self.merges = max(self.merges, passes.bit_length() + passes.bit_length() % 2)

    def split(self, rows: Pass) -> list[Pass]:
        """Draw a pass in halves from now on, and return them."""
        middle = (rows.first + rows.end) // 2
        halves = [Pass(rows.first, middle), Pass(middle, rows.end)]
        at = self.passes.index(rows)
        self.passes[at : at + 1] = halves
        return halves


@dataclass
class Plan:
    """What the next frame of a kind takes.

    Attributes:
        ordinals: Of its boxes; None before the first frame.
        colours: Vectors in the pool of colours.
        rooms: For lists, by ordinals.
        costs: Of the last frame, by tilings, in instructions of its composite.
    """

    ordinals: int | None = None
    colours: int = 0
    rooms: dict[int, Room] = field(default_factory=dict)
    costs: dict[int, float] = field(default_factory=dict)

    def choose(self, lens: Lens, costs: tuple[float, ...], forced: int | None) -> int:
        """Choose the cheapest boxes of a frame by its costs, or the forced ones."""
        self.costs = dict(zip(ORDINALS, costs))
        best = min(tilings(lens), key=lambda k: self.costs[k])
        self.ordinals = best if forced is None else forced
        return self.ordinals


class Bands:
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

    def seconds(self, rows: int) -> float:
        """Return how long rows take; 0 where no rate is known."""
        return 0.0 if self.rate is None else rows * self._row_cost / self.rate

    def took(self, rows: int, seconds: float) -> None:
        """Learn from the time of a band."""
        own = rows * self._row_cost / seconds
        self.rate = own if self.rate is None else min(self.rate, own)
        self._budget = min(_BAND_GROWTH * self._budget, self.rate * _BAND_SECONDS)
