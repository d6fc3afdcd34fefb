"""Write frames as a video, encoded in a thread while others are drawn."""

from __future__ import annotations

import contextlib
import queue
import threading
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from lightfield_gs.base.device import to_numpy
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CodecName, StereoLayout, VideoKind
from lightfield_gs.io.atomic import atomic_path, check_output_path
from lightfield_gs.video.decoding import av_library

VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov")
_WAITING = 4  # frames between the drawing and the encoder
_BT709 = 1  # the number of ITU-T H.273 for primaries, transfer and matrix


class _Codec(NamedTuple):
    """A codec.

    Attributes:
        encoder: FFmpeg's name.
        pixels: its pixel format.
        is_lossless: whether every sub-pixel is preserved.
        suffixes: of the files that can hold it.
    """

    encoder: str
    pixels: str
    is_lossless: bool
    suffixes: tuple[str, ...] = VIDEO_SUFFIXES


_CODECS: dict[CodecName, _Codec] = {
    "ffv1": _Codec("ffv1", "bgr0", True, (".mkv",)),
    "h264-rgb": _Codec("libx264rgb", "rgb24", True),
    "h264": _Codec("libx264", "yuv420p", False),
    "hevc": _Codec("libx265", "yuv420p", False),
}


class _Packing(NamedTuple):
    """How players are told of two eyes' pictures in a frame.

    Attributes:
        number: frame_packing_arrangement_type of H.264 (ITU-T H.264, D.2.26).
        mode: name of Matroska's StereoMode in FFmpeg.
    """

    number: int
    mode: str


_PACKINGS: dict[StereoLayout, _Packing] = {
    "sbs": _Packing(3, "left_right"),
    "half-sbs": _Packing(3, "left_right"),
    "tab": _Packing(4, "top_bottom"),
}


def choose_codec(path: Path, kind: VideoKind, name: CodecName | None) -> CodecName:
    """Return the codec of a video: the requested one, or the default of its kind and file.

    Args:
        path: the file.
        kind: of the frames.
        name: the requested codec, or None.

    Raises:
        InputError: where the file cannot hold it, and for native images with a codec that mixes sub-pixels.
    """
    suffix = path.suffix.lower()
    if suffix not in VIDEO_SUFFIXES:
        raise InputError(
            f"cannot write {path}: expected {', '.join(VIDEO_SUFFIXES)}, or a folder for PNG files, got '{suffix}'"
        )
    if name is None:
        name = "h264" if kind != "native" else "ffv1" if suffix == ".mkv" else "h264-rgb"
    if kind == "native" and not _CODECS[name].is_lossless:
        raise InputError(
            f"{path}: {name} keeps one colour for 2 x 2 pixels (4:2:0), which mixes sub-pixels of different views, and "
            "loses the fine detail that the lenses need; take codec=h264-rgb or ffv1, which lose nothing, a folder "
            "of PNG files, or kind=quilt"
        )
    if suffix not in _CODECS[name].suffixes:
        raise InputError(f"{path}: {name} goes into {' or '.join(_CODECS[name].suffixes)}; change the name or codec=")
    return name


class VideoFile:
    """A video; use it in a `with`, at whose end the file appears, complete or not at all.

    Args:
        path: the file.
        count: number of frames; 0 where it is not known before.
        size_px: (width, height); even for h264 and hevc (4:2:0).
        fps: frames a second.
        codec: "ffv1" and "h264-rgb" are lossless.
        crf: quality of the others, 0..51; less is better and larger.
        stereo: "sbs", "half-sbs" or "tab" for frames with the pictures of two eyes, which players are told. None: one.

    Attributes:
        missing: all frames, since a video cannot be resumed.

    Raises:
        InputError: also in `put`, for an earlier frame.
    """

    def __init__(
        self,
        path: str | Path,
        count: int,
        size_px: tuple[int, int],
        fps: Fraction,
        codec: CodecName,
        crf: int = 18,
        stereo: StereoLayout | None = None,
    ):
        self.path = check_output_path(path)
        self._av = av_library(f"{self.path}: a video")
        self._codec, self._size_px, self._fps, self._crf = _CODECS[codec], size_px, fps, crf
        self._packing = _PACKINGS.get(stereo) if stereo else None
        if self._codec.pixels == "yuv420p" and (size_px[0] % 2 or size_px[1] % 2):
            raise InputError(f"{path}: {codec} takes even sizes, got {size_px[0]} x {size_px[1]}")
        if self._codec.encoder not in self._av.codecs_available:
            raise InputError(f"{path}: this build of PyAV has no {self._codec.encoder}; choose another codec=")
        self.missing = list(range(count))

    def __enter__(self) -> VideoFile:
        self._frames: queue.Queue[tuple[int, np.ndarray] | None] = queue.Queue(_WAITING)
        self._failed: BaseException | None = None
        self._is_abandoned = self._is_ended = False
        self._thread = threading.Thread(target=self._run, name="video", daemon=True)
        self._thread.start()
        return self

    def fetch(self, image: Tensor) -> np.ndarray:
        """Copy a frame, uint8 [H, W, 3], to the host."""
        return to_numpy(image)

    def put(self, number: int, image: np.ndarray) -> None:
        """Queue the next frame, which must not change any more; block while four are waiting.

        Args:
            number: When it is shown, in frames from the first, more than the last one's.
            image: uint8 [H, W, 3].
        """
        if self._failed is not None:
            raise self._failed
        self._frames.put((number, image))

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._is_abandoned = kind is not None
        self._frames.put(None)
        self._thread.join()
        if kind is None and self._failed is not None:
            raise self._failed

    def _run(self) -> None:
        try:
            # An unfinished file is removed on exit
            with contextlib.suppress(_AbandonedError), atomic_path(self.path) as temporary:
                self._encode(temporary)
        except InputError as error:
            self._fail(error)
        except Exception as error:  # a thread would swallow it
            self._fail(InputError(f"cannot write {self.path}: {type(error).__name__}: {error}"))

    def _fail(self, error: InputError) -> None:
        """Keep the error for `put`, and discard further frames, so that nobody waits for the queue."""
        self._failed = error
        while not self._is_ended:
            self._next()

    def _next(self) -> tuple[int, np.ndarray] | None:
        """Return the next frame; None at the end, after which it must not be called."""
        numbered = self._frames.get()
        self._is_ended = numbered is None
        return numbered

    def _encode(self, path: Path) -> None:
        options = {"movflags": "faststart"} if path.suffix.lower() in (".mp4", ".mov") else {}
        with self._av.open(str(path), "w", options=options) as container:
            stream = self._stream(container)
            while (numbered := self._next()) is not None:
                frame = self._frame(numbered[1])
                frame.pts, frame.time_base = numbered[0], 1 / self._fps
                container.mux(stream.encode(frame))
            if self._is_abandoned:
                raise _AbandonedError
            container.mux(stream.encode(None))

    def _stream(self, container: Any) -> Any:
        options = {
            "ffv1": {"level": "3", "slices": "16", "slicecrc": "1"},
            "libx264rgb": {"qp": "0", "preset": "ultrafast"},
            "libx264": {"crf": str(self._crf), "preset": "medium"},
            "libx265": {"crf": str(self._crf), "preset": "medium", "x265-params": "log-level=error"},
        }[self._codec.encoder]
        if self._packing is not None and self._codec.encoder == "libx264":
            options["x264-params"] = f"frame-packing={self._packing.number}"
        stream = container.add_stream(self._codec.encoder, rate=self._fps, options=options)
        stream.width, stream.height = self._size_px
        stream.pix_fmt = self._codec.pixels
        if self._packing is not None:
            stream.metadata["stereo_mode"] = self._packing.mode  # of Matroska
        context = stream.codec_context
        context.thread_type = "AUTO"
        if self._codec.encoder == "libx265":
            context.codec_tag = "hvc1"  # the name by which Apple's players know it
        if self._codec.pixels == "yuv420p":
            context.colorspace = context.color_primaries = context.color_trc = _BT709
            context.color_range = 1  # limited, as players take it
        return stream

    def _frame(self, image: np.ndarray) -> Any:
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        if self._codec.pixels != "yuv420p":
            return frame.reformat(format=self._codec.pixels)
        return frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")


class _AbandonedError(Exception):
    """Not all frames will come."""
