"""The stages of a live picture, each in a thread of its own, with one place between two of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn, Out
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.slot import Slot
from lightfield_gs.live.sources import Frame
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.video.rendering import FrameRenderer


@dataclass(frozen=True)
class Drawing:
    """A kind of picture that is drawn of each scene.

    Attributes:
        draw: Draws it, into memory that is the picture's own.
        rig: By which it is drawn.
        outs: Where it goes.
    """

    draw: FrameRenderer
    rig: Rig
    outs: Sequence[Out]


class Pipeline:
    """Turns the pictures of a source into those that are shown, until the source ends or `stop` is called.

    Args:
        reader: Reads the source; it has begun.
        scenes: Makes the scenes; it is settled.
        drawings: What is drawn.
        health: Counts.
        ended: Called once, from one of the threads, when the last picture is out.
    """

    def __init__(
        self, reader: Reader, scenes: LiveScenes, drawings: Sequence[Drawing], health: Health, ended: Callable[[], None]
    ):
        self._reader, self._scenes, self._drawings = reader, scenes, drawings
        self._health = health
        self._drawable: Slot[tuple[Frame, Gaussians]] = Slot()
        self._drawn: Slot[tuple[Frame, list[Drawn]]] = Slot()
        self._failed: BaseException | None = None
        self._threads = [
            threading.Thread(target=self._run, args=(name, work, after), name=name, daemon=True)
            for name, work, after in (
                ("scenes", self._make_scenes, self._drawable.close),
                ("encode", self._encode, self._drawn.close),
                ("out", self._put_out, ended),
            )
        ]

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End when the pictures on their way are out, and wait for that. Raises the error of a stage that failed."""
        self._reader.stop()
        self._reader.newest.close()
        for thread in self._threads:
            if thread.ident is not None:  # it was started
                thread.join()
        if (error := self._failed or self._reader.failed) is not None:
            raise error

    def _run(self, name: str, work: Callable[[], None], after: Callable[[], None]) -> None:
        try:
            with torch.inference_mode():
                work()
        except BaseException as error:  # a thread would swallow it
            self._failed = self._failed or error
            self._reader.stop()
            for slot in (self._reader.newest, self._drawable, self._drawn):
                slot.close()
        finally:
            after()

    def _make_scenes(self) -> None:
        for item in self._scenes(iter(self._reader.newest)):
            self._drawable.put(item)

    def _encode(self) -> None:
        for frame, gaussians in self._drawable:
            with self._health.busy("encode"):
                drawn = [Drawn(_finished(one.draw(gaussians, one.rig, frame.number))) for one in self._drawings]
            self._health.has_drawn()
            self._drawn.put((frame, drawn))

    def _put_out(self) -> None:
        for frame, drawn in self._drawn:
            for drawing, picture in zip(self._drawings, drawn):
                for out in drawing.outs:
                    out.put(frame, picture)


def _finished(image: Tensor) -> Tensor:
    """Return an image once its device has drawn it."""
    if image.is_cuda:
        torch.cuda.current_stream(image.device).synchronize()
    return image
