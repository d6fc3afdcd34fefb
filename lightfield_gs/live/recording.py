"""The way out to a file."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

from lightfield_gs.base.options import CodecName, StereoLayout
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.sources import Frame
from lightfield_gs.video.video_file import VideoFile


class Recording:
    """A video, each frame shown from when it was taken until the next.

    Args:
        path: The file.
        size_px: Width and height of a picture.
        fps: Steps of time a second: of frames that are nearer to each other, the first is kept.
        codec: See VideoFile.
        stereo: See VideoFile.
        health: Counts the frames.
    """

    def __init__(
        self,
        path: Path,
        size_px: tuple[int, int],
        fps: Fraction,
        codec: CodecName,
        stereo: StereoLayout | None,
        health: Health,
    ):
        self._video = VideoFile(path, 0, size_px, fps, codec, stereo=stereo)
        self._fps, self._health = fps, health
        self._start: float | None = None
        self._last = -1

    def begin(self) -> None:
        """Begin the file."""
        self._video.__enter__()

    def put(self, frame: Frame, drawn: Drawn) -> None:
        """See Out. Waits while the file's encoder is behind."""
        if self._start is None:
            self._start = frame.taken
        number = round((frame.taken - self._start) * self._fps)
        if number <= self._last:
            return
        with self._health.busy("recording", frame):
            self._video.put(number, drawn.pixels)
        self._last = number
        self._health.has_sent(frame)

    def end(self) -> None:
        """Finish the file; nothing is kept where there was no frame. Raises InputError where it cannot be written."""
        kind = None if self._last >= 0 else KeyboardInterrupt
        self._video.__exit__(kind, None, None)
