"""The stages of a live picture, each in a thread of its own, with one place between two of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence

import torch

from lightfield_gs.base.device import finished
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn, Out
from lightfield_gs.live.reader import Reader
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.slot import Slot
from lightfield_gs.live.sources import Frame
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.video.rendering import FrameRenderer

_REDRAW_S = 1 / 60  # between two looks at whether the picture would be another one


class Pipeline:
    """Turns the pictures of a source into those that are shown, until the source ends or `stop` is called.

    Args:
        reader: Reads the source; it has begun.
        scenes: Makes the scenes; it is settled.
        draw: Draws a picture, into memory that is the picture's own.
        outs: Where the pictures go.
        health: Counts.
        ended: Called once, from one of the threads, when the last picture is out.
        state: Returns what a picture depends on beside its scene, as the controls of a page.
    """

    def __init__(
        self,
        reader: Reader,
        scenes: LiveScenes,
        draw: FrameRenderer,
        outs: Sequence[Out],
        health: Health,
        ended: Callable[[], None],
        state: Callable[[], object] = lambda: None,
    ):
        self._reader, self._scenes, self._draw, self._outs = reader, scenes, draw, outs
        self._health, self._state = health, state
        self._drawable: Slot[tuple[Frame, Gaussians]] = Slot()
        self._drawn: Slot[tuple[Frame, Drawn]] = Slot()
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
        """Begin, with the scene by which the others were settled."""
        self._drawable.put(self._scenes.first)
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
            self._drawable.wait_taken()  # a scene that nobody draws would take the time of one that is drawn

    def _encode(self) -> None:
        for frame, gaussians in self._to_draw():
            with self._health.busy("encode", frame):
                drawn = Drawn(finished(self._draw(gaussians, self._scenes.rig, frame.number)))
            self._health.has_drawn(frame)
            self._drawn.put((frame, drawn))

    def _to_draw(self) -> Iterator[tuple[Frame, Gaussians]]:
        """Yield scenes as they come, and the last one again where its picture would be another one by now."""
        last, drawn_by = None, None
        for item in self._drawable.within(_REDRAW_S):
            now = self._state()
            if item is None and (last is None or now == drawn_by):
                continue
            last, drawn_by = item or last, now
            assert last is not None
            yield last

    def _put_out(self) -> None:
        for frame, drawn in self._drawn:
            for out in self._outs:
                out.put(frame, drawn)
