"""How large the pictures of a source are taken, and what the network for depths sees, so that the rate holds."""

from __future__ import annotations

import math
from dataclasses import replace

from lightfield_gs.base.options import QualityName
from lightfield_gs.live.health import Span
from lightfield_gs.video.decoding import Scaling

MOST_PIXELS = 1_500_000  # as of a photo: a view of a panel has fewer
_WHOLE_PIXELS = 1920 * 1088  # of pictures of which an object on a GPU is cut out
LEAST_PIXELS = 320 * 180  # less is a blur on any panel
LEAST_NETWORK_PX = 126  # nine patches of the usual networks for depths: with fewer, things are blobs
_NETWORK_STEP_PX = 14  # a patch of theirs
_SLOW = 1.1  # of the time for a frame, from which on a stage is too slow
_HELPS = 0.9  # of the time before, above which smaller pictures were of no use
_AIM, _STEP = 0.9, 0.25  # of the time that is aimed at, and the most that one step leaves of the pixels
_FINER = 1.4  # pixels to a side for one that a view has: each is a little blurred
STAGES = ("network", "depth", "encode")  # which take less time for fewer pixels


class Detail:
    """Quality and size of the pictures, which become less where a stage is too slow for the rate; never more.

    Args:
        fps: The frames a second to hold.
        pixels: Of a picture. None: as many as hold the rate.
        quality: Of the drawing. None: exact, or fast where that does not hold the rate.
        network_px: Shorter side of what the network for depths sees, at most. None: as much as holds the rate.

    Attributes:
        quality: Of the drawing, now.
        scaling: How the pictures are reduced, now.
        size_px: Height and width of the last picture.
        most_network_px: Shorter side of what the network for depths may see, now. None: its own.
        network_px: Shorter side of what it saw last. None: nothing yet.
    """

    def __init__(
        self, fps: float, pixels: int | None, quality: QualityName | None = "exact", network_px: int | None = None
    ):
        self.quality: QualityName = quality or "exact"
        self._may_draw_fast = quality is None
        self._least = LEAST_PIXELS
        self._fps, self._is_fixed, self._is_said, self._is_new = fps, pixels is not None, False, True
        self.scaling = Scaling(pixels or MOST_PIXELS)
        self.most_network_px, self._is_network_fixed = network_px, network_px is not None
        self.network_px: int | None = None
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

    def adapt(self, span: Span) -> str | None:
        """Take smaller pictures, or let the network see smaller ones, where a stage was too slow; return a line on it.

        The rate of the source bounds too: no picture becomes smaller for a rate that the source does not have.
        """
        times = {name: mean for name in STAGES if (mean := span.mean_s(name)) is not None}
        may_shrink = not (self._is_fixed or self._is_said)
        may_change = may_shrink or self._may_draw_fast or not self._is_network_fixed
        if not may_change or not times or span.seconds <= 0:
            return None
        if self._is_new:  # the first pictures of a kind take longer
            self._is_new = False
            return None
        stage = max(times, key=lambda name: times[name])
        wanted = 1 / min(self._fps, max(1.0, span.taken / span.seconds))
        if times[stage] <= _SLOW * wanted:
            return None
        wish = f"for a frame, and {1 / wanted:.3g} a second are wanted"
        if stage == "depth" and "network" in times and (seen := self._less_for_network(times, wanted)) is not None:
            side = f"{self.most_network_px} pixels to the shorter side, not {seen}"
            return (
                f"its network takes {1000 * times['network']:.0f} ms {wish}: it sees {side} (--network-px keeps them)"
            )
        words = f"the {stage} takes {1000 * times[stage]:.0f} ms {wish}"
        if stage == "encode" and self._may_draw_fast:
            self.quality, self._may_draw_fast, self._is_new = "fast", False, True
            return f"{words}: it draws with --quality fast (--quality exact keeps it)"
        if not may_shrink:
            return None
        slow, self._slow = self._slow, (stage, times[stage], self.scaling.most_pixels)
        if slow is not None and stage == slow[0] and times[stage] > _HELPS * slow[1]:
            self._is_said, self.scaling = True, replace(self.scaling, most_pixels=slow[2])
            less = "--quality fast and --device draw faster" if stage == "encode" else "--device is another"
            return f"{words}: smaller pictures do not help, and are taken as large as before; {less}"
        height, width = self.size_px
        now = min(self.scaling.most_pixels, height * width)
        if now <= self._least:
            self._is_said = True
            slower = f"give --fps {1 / times[stage]:.2g}"
            return f"{words}: the pictures are as small as they get ({width} x {height}); {slower}"
        fewer = max(self._least, int(now * max(_STEP, _AIM * wanted / times[stage])))
        self.scaling, self._is_new = replace(self.scaling, most_pixels=fewer), True
        after = self.scaling.size(height, width)
        return f"{words}: pictures are taken at {after[1]} x {after[0]}, not {width} x {height} (--pixels keeps a size)"

    def _less_for_network(self, times: dict[str, float], wanted: float) -> int | None:
        """Let the network for depths see less where it takes most of the time; return what it saw, or None."""
        seen, limit = self.network_px, self.most_network_px
        if self._is_network_fixed or seen is None or 2 * times["network"] < times["depth"]:
            return None
        if seen <= LEAST_NETWORK_PX or (limit is not None and seen > limit + _NETWORK_STEP_PX):  # it takes one size
            self._is_network_fixed = True
            return None
        part = (_AIM * wanted - (times["depth"] - times["network"])) / times["network"]
        fewer = min(int(seen * math.sqrt(max(_STEP, part))), seen - _NETWORK_STEP_PX)
        self.most_network_px, self._is_new = max(LEAST_NETWORK_PX, fewer), True
        return seen
