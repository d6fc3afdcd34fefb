"""Frames drawn one after the other, while those before them are written."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from torch import Tensor
from tqdm import tqdm

from lightfield_gs.base.cuda import to_numpy
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

# What frames show: of these numbers, which increase, each with its Gaussians and its rig
Shots = Callable[[list[int]], Iterator[tuple[int, Gaussians, Rig]]]


class Draw(Protocol):
    """See video.pictures; size_px: (width, height) of a frame."""

    size_px: tuple[int, int]

    def __call__(self, gaussians: Gaussians, rig: Rig, number: int) -> Tensor: ...


class Sink(AbstractContextManager, Protocol):
    """A FrameFolder or a VideoFile. fetch: a frame on the host as `put` takes it."""

    missing: list[int]

    def fetch(self, image: Tensor) -> Any: ...
    def put(self, number: int, image: Any) -> None: ...


class NoFiles:
    """Frames that go nowhere, for measurements of the drawing alone."""

    def __init__(self, count: int):
        self.missing = list(range(count))

    def __enter__(self) -> NoFiles:
        return self

    def fetch(self, image: Tensor) -> np.ndarray:
        """The frame on the host."""
        return to_numpy(image)

    def put(self, number: int, image: np.ndarray) -> None:
        """Nothing is done with it."""

    def __exit__(self, *_: object) -> None:
        return None


@dataclass
class Made:
    """How many frames were drawn, and the seconds that went into the scene of each, into drawing and copying it to the
    host, into waiting for what writes, at the end into what was not written yet, and in all."""

    frames: int = 0
    scene_s: float = 0.0
    draw_s: float = 0.0
    wait_s: float = 0.0
    finish_s: float = 0.0
    total_s: float = 0.0

    def words(self) -> str:
        """For example "8.0 frames/s: scene 0.10 s, draw 2.00 s, wait for the writers 1.50 s, finish 0.10 s"."""
        rate = self.frames / max(self.total_s, 1e-9)
        return (
            f"{rate:.3g} frames/s: scene {self.scene_s:.2f} s, draw {self.draw_s:.2f} s, "
            f"wait for the writers {self.wait_s:.2f} s, finish {self.finish_s:.2f} s"
        )


def make_video(shots: Shots, draw: Draw, sink: Sink, count: int, *, shown: bool = False) -> Made:
    """Draws the frames that the sink misses, of `count`, and hands them over; returns what took how long.

    While the sink writes, the next frame is drawn. It is entered here, and left when all is written. shown: with a bar
    that tells frames a second and the time left, where there is a terminal. Raises InputError where the sink does.
    """
    made, began = Made(), time.perf_counter()
    there, hidden = count - len(sink.missing), None if shown else True
    with sink, tqdm(total=count, initial=there, unit="frame", dynamic_ncols=True, disable=hidden) as bar:
        last = began
        for number, gaussians, rig in shots(sink.missing):
            at_scene = time.perf_counter()
            image = sink.fetch(draw(gaussians, rig, number))
            at_image = time.perf_counter()
            sink.put(number, image)
            made.frames += 1
            made.scene_s += at_scene - last
            made.draw_s += at_image - at_scene
            last = time.perf_counter()
            made.wait_s += last - at_image
            bar.update()
    made.total_s = time.perf_counter() - began
    made.finish_s = made.total_s - made.scene_s - made.draw_s - made.wait_s
    return made
