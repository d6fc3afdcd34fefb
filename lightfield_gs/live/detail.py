"""How large the pictures of a source are taken, and what the network for depths sees, so that the rate holds."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from statistics import mean

from lightfield_gs.base.options import QualityName
from lightfield_gs.live.health import Span
from lightfield_gs.video.decoding import Scaling

MOST_PIXELS = 1_500_000  # as of a photo: a view of a panel has fewer
_CPU_PIXELS = 400_000  # as many as a view of a panel of 4K has
_WHOLE_PIXELS = 1920 * 1088  # of pictures of which an object on a GPU is cut out
LEAST_PIXELS = 320 * 180  # less is a blur on any panel
LEAST_NETWORK_PX = 126  # nine patches of the usual networks for depths: with fewer, things are blobs
_PATCH_PX = 14
_HELPS = 0.9  # of the time before, above which smaller pictures were of no use
_FEWER = 0.6  # of the pixels before, below which that can be told
_LONGEST_START_S = 1.5  # of a first picture, which takes longer than those after it; beyond it counts, also unfinished
_EASY = 6  # times as long may a fast drawing take from which on an exact one is tried: the CPU's takes up to 4 times
_NETWORK_PART, _NETWORK_POWER = 0.5, 2.2  # its part of the time; its time grows by that power of the side it sees
_AIM, _STEP = 0.9, 0.25  # of the time that is aimed at, and the most that one step leaves of the pixels
_FINER = 1.4  # pixels to a side for one that a view has: each is a little blurred
STAGES = ("network", "depth", "encode")  # which take less time for fewer pixels


class Detail:
    """Quality and size of the pictures, which become less where a stage is too slow for the rate; sizes never more.

    Args:
        fps: The frames a second to hold.
        pixels: Of a picture. None: as many as hold the rate.
        quality: Of the drawing. None: exact, or fast where that does not hold the rate.
        network_px: Shorter side of what the network for depths sees, at most. None: as much as holds the rate.
        is_slow: Whether a CPU draws. Then an automatic quality begins with fast, and becomes exact where there is much
            time; and pictures are smaller from the first one on, which else takes several seconds.

    Attributes:
        quality: Of the drawing, now.
        scaling: How the pictures are reduced, now.
        size_px: Height and width of the last picture.
        most_network_px: Shorter side of what the network for depths may see, now. None: its own.
    """

    def __init__(
        self,
        fps: float,
        pixels: int | None,
        quality: QualityName | None = "exact",
        network_px: int | None = None,
        is_slow: bool = False,
    ):
        self.quality: QualityName = quality or ("fast" if is_slow else "exact")
        self._may_draw_exactly = quality is None and is_slow
        self._may_draw_fast = quality is None and not is_slow
        self._least = LEAST_PIXELS
        self._fps, self._is_fixed, self._is_said = fps, pixels is not None, False
        self._changed, self._warm = -math.inf, set[str]()  # the moment of the last change, and the stages seen since
        self.scaling = Scaling(pixels or (_CPU_PIXELS if is_slow else MOST_PIXELS))
        self.most_network_px, self._is_network_fixed = network_px, network_px is not None
        self._network = (0, 0.0)  # what it saw last, and its seconds
        self._slow_network: tuple[int, float, int | None] | None = None  # the same before it saw less, and the limit
        self._slow: tuple[str, float, int] | None = None  # what was too slow before, its seconds, and the pixels then
        self.size_px: tuple[int, int] = (0, 0)

    def take_halves(self, is_nearest: bool) -> None:
        """Note that a picture holds two side by side; is_nearest: that one has depths, see Scaling."""
        self._least = 2 * LEAST_PIXELS
        self.scaling = replace(self.scaling, is_nearest=is_nearest)

    def take_whole(self) -> None:
        """Take more pixels, unless a number was given: a decoder gives pictures as they are in a tenth of the time."""
        if not self._is_fixed:
            self.scaling = replace(self.scaling, most_pixels=_WHOLE_PIXELS)

    def limit(self, resolved: float) -> None:
        """Take no more pixels than the panel shows, unless a number was given.

        Args:
            resolved: Pixels to a side that a view of the panel has for one of the last picture.
        """
        scale = _FINER * resolved
        if not self._is_fixed and scale < 1:
            most = max(self._least, round(scale * scale * self.size_px[0] * self.size_px[1]))
            self.scaling = replace(self.scaling, most_pixels=min(self.scaling.most_pixels, most))

    def count_after(self, taken: float) -> None:
        """Let only pictures count that are taken later: the first one has another size. taken: of time.monotonic."""
        self._changed = taken

    def foresee_network(self, own_px: int, small_px: int, seconds: float) -> list[str]:
        """Let the network for depths see less from the beginning where its own size would take too long.

        Args:
            own_px: Shorter side of what it was made for.
            small_px: Shorter side of what it saw in a trial.
            seconds: How long that took.

        Returns:
            A line, where it sees less.
        """
        fits = small_px * (_NETWORK_PART / self._fps / seconds) ** (1 / _NETWORK_POWER)
        if fits >= own_px:
            return []
        self.most_network_px = max(LEAST_NETWORK_PX, int(fits))
        why = f"it takes {1000 * seconds:.0f} ms for {small_px}"
        return [
            f"depth: its network sees {self.most_network_px} pixels to the shorter side, not {own_px}: {why} "
            "(--network-px keeps them)"
        ]

    def network_took(self, side_px: int, seconds: float) -> None:
        """Note how long the network for depths took for the last picture; side_px: the shorter side that it saw."""
        self._network = side_px, seconds

    def adapt(self, span: Span) -> list[str]:
        """Take smaller pictures, or let the network see smaller ones, where a stage was too slow; return lines on it.

        The rate of the source bounds too: no picture becomes smaller for a rate that the source does not have. Only
        pictures count that came after the last change.
        """
        if span.seconds <= 0:
            return []
        wanted = 1 / min(self._fps, max(1.0, span.taken / span.seconds))
        times = self._times(span)
        slow = {stage: seconds for stage, seconds in times.items() if seconds > wanted}
        wish = f"for a frame, and {1 / wanted:.3g} a second are wanted"
        words = {stage: f"the {stage} takes {1000 * seconds:.0f} ms {wish}" for stage, seconds in slow.items()}
        lines = []
        if self._may_draw_exactly and "encode" in times:
            self._may_draw_exactly = False
            if _EASY * times["encode"] < wanted:
                self.quality, self._may_draw_fast = "exact", True
                lines.append(f"the encode takes {1000 * times['encode']:.0f} ms: it draws with --quality exact")
        if "encode" in slow and self._may_draw_fast:
            self.quality, self._may_draw_fast = "fast", False
            lines.append(f"{words.pop('encode')}: it draws with --quality fast (--quality exact keeps it)")
        if "depth" in slow and (change := self._less_for_network(slow["depth"], wanted)) is not None:
            del words["depth"]
            lines.append(f"the network for depths takes {1000 * self._network[1]:.0f} ms {wish}: {change}")
        if words and not (self._is_fixed or self._is_said):
            stage = max(words, key=lambda name: slow[name])
            lines.append(f"{words[stage]}: {self._less_pixels(stage, slow[stage], wanted)}")
        if lines:
            self._changed, self._warm = time.monotonic(), set()
        return lines

    def _times(self, span: Span) -> dict[str, float]:
        """Return the mean seconds of each stage for pictures since the last change, but for the first one."""
        times = {}
        for stage in STAGES:
            fresh = [part.seconds for part in span.took.get(stage, ()) if part.taken > self._changed]
            if fresh and stage not in self._warm:
                self._warm.add(stage)
                if len(fresh) > 1 or fresh[0] < _LONGEST_START_S:
                    del fresh[0]
            if (now := span.works.get(stage)) is not None and now.taken > self._changed:
                fresh += [now.seconds] if now.seconds > _LONGEST_START_S else []
            if fresh:
                times[stage] = mean(fresh)
        return times

    def _less_for_network(self, depth_s: float, wanted: float) -> str | None:
        """Let the network for depths see less where it takes most of the time, unless that is of no use; return words.

        On a GPU that draws meanwhile, most of its time may be waiting.
        """
        (seen, took), before = self._network, self._slow_network
        if self._is_network_fixed:
            return None
        if before is not None and took > _HELPS * before[1]:
            self._is_network_fixed, self.most_network_px = True, before[2]
            return f"{seen} pixels to the shorter side do not help, and it sees {before[0]} again"
        if 2 * took < depth_s or seen <= LEAST_NETWORK_PX:
            return None
        self._slow_network = seen, took, self.most_network_px
        part = (_AIM * wanted - (depth_s - took)) / took
        fewer = int(seen * math.sqrt(max(0.0, part)))
        self.most_network_px = max(LEAST_NETWORK_PX, min(fewer, seen - _PATCH_PX))
        return f"it sees {self.most_network_px} pixels to the shorter side, not {seen} (--network-px keeps them)"

    def _less_pixels(self, stage: str, seconds: float, wanted: float) -> str:
        """Take smaller pictures for a stage, unless that is of no use; return words on it."""
        before, self._slow = self._slow, (stage, seconds, self.scaling.most_pixels)
        has_fewer = before is not None and self.scaling.most_pixels < _FEWER * before[2]
        if before is not None and has_fewer and stage == before[0] and seconds > _HELPS * before[1]:
            self._is_said, self.scaling = True, replace(self.scaling, most_pixels=before[2])
            less = "--quality fast and --device draw faster" if stage == "encode" else "--device is another"
            return f"smaller pictures do not help, and are taken as large as before; {less}"
        height, width = self.size_px
        now = min(self.scaling.most_pixels, height * width)
        if now <= self._least:
            self._is_said = True
            return f"the pictures are as small as they get ({width} x {height}); give --fps {1 / seconds:.2g}"
        fewer = max(self._least, int(now * max(_STEP, _AIM * wanted / seconds)))
        self.scaling = replace(self.scaling, most_pixels=fewer)
        after = self.scaling.size(height, width)
        return f"pictures are taken at {after[1]} x {after[0]}, not {width} x {height} (--pixels keeps a size)"
