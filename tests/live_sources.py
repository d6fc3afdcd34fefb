"""Sources of live pictures for tests: numbered pictures at a rate, whose numbers are read back from the panel's."""

import threading
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from lightfield_gs.io.images import Picture
from lightfield_gs.live.sources import Frame, reduced
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import simulate

BITS = 10
SIZE = (120, 240)


def clock(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A picture with its number as a bar over its height: white is 1, black is 0, the greatest bit at the left."""
    bits = [number >> bit & 1 for bit in reversed(range(BITS))]
    columns = np.repeat(bits, size[1] // BITS)
    return np.broadcast_to((255 * columns).astype(np.uint8)[None, :, None], (*size, 3)).copy()


def read_clock(image: np.ndarray, panel: Panel) -> int:
    """The number in the panel's picture, as an eye straight before the panel sees it."""
    seen = simulate(image, panel, (0, 0, panel.viewing_distance_mm)).mean(2)
    row = seen[2 * len(seen) // 5 : 3 * len(seen) // 5].mean(0)
    parts = np.array_split(row, BITS)
    bits = [float(part[len(part) // 4 : -len(part) // 4].mean()) > 0.5 for part in parts]
    return sum(bit << place for place, bit in enumerate(reversed(bits)))


def write_film(path: Path, frames: Iterable[np.ndarray]) -> Path:
    """Write frames uint8 [40, 80, 3], five a second, without loss."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=5)
        stream.height, stream.width, stream.pix_fmt = 40, 80, "bgr0"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))
    return path


class Clock:
    """A camera that takes the pictures of a clock.

    Args:
        rate: Pictures a second.
        count: How many; then it ends.

    Attributes:
        taken: When each was taken.
    """

    name, pair = "clock", None

    def __init__(self, rate: float, count: int, ends: bool = True):
        self._rate, self._count, self.ends = rate, count, ends
        self.taken: list[float] = []

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        for number in range(self._count):
            if stop.wait(1 / self._rate):
                return
            self.taken.append(time.monotonic())
            picture = clock(number)
            yield Frame(number, self.taken[-1], partial(_picture, picture))


def _picture(pixels: np.ndarray, scaling) -> Picture:
    return Picture(reduced(pixels, scaling))
