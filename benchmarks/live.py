"""How many pictures a second `live` makes of a 1080p clip, how old they are, and which stage bounds them.

The clip is made: a thing that passes before a wall. Its frames are decoded already, and lie in memory as a decoder
leaves them (YUV 4:2:0). All stages after that are those of `lightfield-gs live`.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import threading
import time
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any
from unittest import mock

import numpy as np
import torch

from benchmarks.depth_stand_in import DepthStandIn
from lightfield_gs.app.options import AUTO, FLAT, LookOptions, PhotoOptions, RenderOptions
from lightfield_gs.base.cli_messages import capturable_streams, capture
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import QUALITY_NAMES, QualityName
from lightfield_gs.bench import options
from lightfield_gs.commands.options.parser import whole, within
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.drawing import LiveRenderer
from lightfield_gs.live.health import Health, Span
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.pipeline import Pipeline
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.sources import Frame, decoded_picture
from lightfield_gs.panels.panel import Panel
from lightfield_gs.photo import depth_network
from lightfield_gs.video.decoding import PixelKind, av_library
from lightfield_gs.video.rendering import FrameOptions
from lightfield_gs.webgpu.devices import choose_drawing_device

WAYS = ("object", "depth", "flat")
USUAL_WAYS = "object,depth"
SECONDS, WARM_UP_S = 10.0, 3.0
_HEIGHT, _WIDTH, _FRAMES = 1080, 1920, 24
_PLAIN = 1, 1  # numbers of ITU-T H.273 of BT.709


class MadeClip:
    """A thing that passes before a plain wall, or a textured one, again and again, at a rate."""

    def __init__(self, way: str, rate: float):
        self.name, self.ends = "made clip", False
        self.pair: PairLayout | None = None
        self._rate, self._kind = rate, PixelKind(Fraction(1), *_PLAIN)
        av = av_library("the made clip")
        frames = (av.VideoFrame.from_ndarray(picture, format="rgb24") for picture in clip_pictures(way))
        self._frames = [frame.reformat(format="yuv420p") for frame in frames]

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        """See Source."""
        began, number = time.monotonic(), 0
        while not stop.wait(max(0.0, began + number / self._rate - time.monotonic())):
            back = number % (2 * _FRAMES - 2)
            frame = self._frames[min(back, 2 * _FRAMES - 2 - back)]
            yield Frame(number, time.monotonic(), partial(decoded_picture, frame, self._kind, None))
            number += 1


def clip_pictures(way: str) -> Iterator[np.ndarray]:
    """Yield the pictures of the clip, uint8 [1080, 1920, 3]: for "object" the wall is plain."""
    random = np.random.default_rng(0)
    rows, columns = np.mgrid[:_HEIGHT, :_WIDTH].astype(np.float32)
    texture = (np.sin(columns / 37), np.cos(rows / 29) * np.sin(columns / 61), np.sin((rows + columns) / 53))
    wall = np.stack([60 + 40 * texture[0], 100 + 50 * texture[1], 170 + 40 * texture[2]], 2)
    if way == "object":
        wall = np.full_like(wall, 235)
    thing = np.stack([150 + 80 * np.sin(columns / 15), 60 + 40 * np.cos(rows / 13), 40 + 0 * rows], 2)
    for number in range(_FRAMES):
        inside = ((columns - 700 - 20 * number) / 260) ** 2 + ((rows - 560) / 380) ** 2 < 1
        picture = np.where(inside[..., None], thing, wall)
        noise = random.integers(-2, 3, picture.shape, np.int8)
        yield (picture + noise).clip(0, 255).astype(np.uint8)


class Sink:
    """Takes the pictures as the page and the recording do, in the host's memory; or as a window does, on the device."""

    def __init__(self, health: Health, on_device: bool):
        self._health, self._on_device = health, on_device

    def put(self, frame: Frame, drawn: Drawn) -> None:
        """See Out."""
        if not self._on_device:
            _ = drawn.pixels  # copied when it is asked for
        self._health.has_sent(frame)


@contextmanager
def stand_in(device: str) -> Iterator[DepthStandIn]:
    """Estimate depths by the stand-in within the block, in place of a network with weights."""
    network = DepthStandIn(device)
    with (
        mock.patch.object(depth_network, "open_model", lambda folder, device: network),
        mock.patch.object(depth_network, "model_folder", lambda name, say: Path(name)),
    ):
        yield network


def memory(device: str) -> dict[str, float]:
    """Return what the process holds now: MiB, threads and open files; MiB of the device."""
    found: dict[str, float] = {"threads": threading.active_count()}
    if Path("/proc/self/statm").exists():
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        found |= {"rss_mib": pages * os.sysconf("SC_PAGE_SIZE") / 2**20, "files": len(os.listdir("/proc/self/fd"))}
    else:
        found["most_rss"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if device == "cuda":
        found["cuda_mib"] = torch.cuda.memory_reserved() / 2**20
    return found


def _detail(given: Options) -> Detail:
    is_slow = given.device == "cpu" and not given.webgpu
    return Detail(given.fps, given.pixels, given.quality, given.network_px, is_slow)


def row(way: str, panel: Panel, given: Options) -> dict[str, Any]:
    """Run the loop, and return what came of it. Raises InputError."""
    rate = given.rate or (120 if given.device == "cuda" else 30)
    health, detail = Health(), _detail(given)
    sums, words = Sums(), list[str]()
    with ExitStack() as stack:
        stack.enter_context(capturable_streams())
        parameters = 0
        photo = PhotoOptions(depth=FLAT if way == "flat" else None)
        if way == "depth":
            photo = PhotoOptions(depth=AUTO, depth_model=given.depth_model or "stand-in")
            if given.depth_model is None:
                parameters = stack.enter_context(stand_in(given.device)).parameters
        source = MadeClip(way, rate)
        reader = Reader(source, health.has_taken, options.progress)
        scenes = LiveScenes(source, photo, RenderOptions(), LookOptions(), panel, given.device, detail, health)
        reader.start()
        stack.callback(reader.stop)
        with torch.inference_mode(), capture(words):
            scenes.settle(iter(reader.newest))
        how = scenes.drawn_as
        webgpu = choose_drawing_device("webgpu", panel.width_px * panel.height_px).webgpu if given.webgpu else None
        drawing = FrameOptions("integer", how.background, detail.quality, how.antialiased, how.view_filter, webgpu)
        ended = threading.Event()
        draw, sink = LiveRenderer(panel, drawing, detail), Sink(health, given.on_device)
        pipeline = Pipeline(reader, scenes, draw, [sink], health, ended.set)
        pipeline.start()
        try:
            _pass(given.warm_up, health, detail, ended, words, Sums())
            health.take()
            before, cpu, began = memory(given.device), time.process_time(), time.monotonic()
            _pass(given.seconds, health, detail, ended, words, sums)
            seconds, used = time.monotonic() - began, time.process_time() - cpu
            after = memory(given.device)
        finally:
            pipeline.stop()
    latencies = sorted(1000 * latency for latency in sums.latencies_s)
    busy = {name: sums.busy_s[name] / seconds for name in sums.took_s}
    return {
        "way": way,
        "panel": panel.name,
        "width_px": panel.width_px,
        "height_px": panel.height_px,
        "views": panel.views,
        "device": given.device,
        "drawn_by": webgpu or given.device,
        "seconds": seconds,
        "source_fps": rate,
        "frames_per_second": len(latencies) / seconds,
        "latency_ms_median": median(latencies) if latencies else None,
        "latency_ms_95": latencies[int(0.95 * (len(latencies) - 1))] if latencies else None,
        "stages_ms": {name: 1000 * sums.took_s[name] / sums.pictures[name] for name in sums.took_s},
        "busy": busy,
        "bound": max(busy, key=lambda name: busy[name], default="source"),
        "cpu_seconds_per_frame": used / max(1, len(latencies)),
        "picture_px": list(detail.size_px[::-1]),
        "most_network_px": detail.most_network_px,
        "quality": detail.quality,
        "network_parameters": parameters,
        "unused": dict(sums.unused),
        "memory_before": before,
        "memory_after": after,
        "said": words,
    }


class Sums:
    """What happened in many seconds, in little memory: the measurement must not look like something that grows.

    Attributes:
        latencies_s: From taken to sent, of each picture.
        busy_s: Of each stage.
        took_s: Seconds of each stage for all pictures that it finished.
        pictures: Their number.
        unused: Reasons why pictures could not be used, and of how many.
    """

    def __init__(self) -> None:
        self.latencies_s = array("f")
        self.busy_s, self.took_s = defaultdict[str, float](float), defaultdict[str, float](float)
        self.pictures, self.unused = Counter[str](), Counter[str]()

    def add(self, span: Span) -> None:
        """Add a second."""
        self.latencies_s.extend(span.latencies_s)
        for stage, seconds in span.busy_s.items():
            self.busy_s[stage] += seconds
        self.unused.update(span.unused)
        for stage, parts in span.took.items():
            self.took_s[stage] += sum(part.seconds for part in parts)
            self.pictures[stage] += len(parts)


def _pass(seconds: float, health: Health, detail: Detail, ended: threading.Event, words: list[str], sums: Sums) -> None:
    """Let time pass; each second the detail is adapted, as by `live`."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0 and not ended.wait(min(1.0, left)):
        span = health.take()
        sums.add(span)
        words += detail.adapt(span)


@dataclass(frozen=True, kw_only=True)
class Options(options.PanelOptions):
    """The options of the benchmark.

    Attributes:
        way: Ways, with commas, of WAYS.
        seconds: That are measured.
        warm_up: Seconds before, in which sizes and graphs settle.
        rate: Pictures a second of the clip. None: 120 on CUDA, else 30.
        fps: To hold: pictures become smaller for it.
        pixels: Of a picture. None: as `live` has it.
        quality: Of the drawing. None: as `live` has it.
        depth_model: A network for depths, as `live` takes it. None: the stand-in.
        network_px: Shorter side of what it sees. None: as `live` has it.
        on_device: Whether the panel's pictures stay on the device, as for a window.
        webgpu: Whether WebGPU draws the scenes, which the CPU makes.
    """

    way: str = USUAL_WAYS
    seconds: float = SECONDS
    warm_up: float = WARM_UP_S
    rate: float | None = None
    fps: float = 30.0
    pixels: int | None = None
    quality: QualityName | None = None
    depth_model: str | None = None
    network_px: int | None = None
    on_device: bool = False
    webgpu: bool = False


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument(
        "--way", default=USUAL_WAYS, help="object, depth, flat, several with commas (default: %(default)s)"
    )
    seconds = within(0.5, 1e6, "seconds")
    parser.add_argument("--seconds", type=seconds, default=SECONDS, help="that are measured (default: %(default)g)")
    parser.add_argument("--warm-up", type=seconds, default=WARM_UP_S, help="seconds before (default: %(default)g)")
    rate = within(1, 1000, "pictures a second")
    parser.add_argument("--rate", type=rate, help="pictures a second of the clip (default: 120 on CUDA, else 30)")
    parser.add_argument("--fps", type=rate, default=30.0, help="frames a second to hold (default: %(default)g)")
    parser.add_argument("--pixels", type=whole(10_000, 1_500_000), metavar="N", help="as of `live`")
    parser.add_argument("--quality", choices=QUALITY_NAMES, help="as of `live`")
    parser.add_argument(
        "--depth-model",
        metavar="NAME",
        help="a network for depths, its name or folder (default: one of random weights, of the size of Depth Anything "
        "V2 Small)",
    )
    parser.add_argument("--network-px", type=whole(14, 2000), metavar="N", help="as of `live`")
    parser.add_argument("--on-device", action="store_true", help="do not copy the panel's pictures to the host")
    parser.add_argument("--webgpu", action="store_true", help="draw by WebGPU what the CPU makes")
    options.add_panel(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the row of each way, and them as JSON. Raises InputError."""
    ways = given.way.split(",")
    if not set(ways) <= set(WAYS):
        raise InputError(f"way=: expected some of {', '.join(WAYS)}, with commas, got {given.way!r}")
    if given.webgpu and given.device != "cpu":
        raise InputError(f"webgpu=: it draws scenes of the CPU; leave out --device {given.device}")
    torch.set_num_threads(given.thread_count or torch.get_num_threads())
    rows = [row(way, given.load_panel(), given) for way in ways]
    return {"rows": rows}, json.dumps(rows, indent=1)
