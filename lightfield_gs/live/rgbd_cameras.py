"""Cameras that measure depths, through their makers' own packages: RealSense, Orbbec, and iPhones by Record3D."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import Picture
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.live.sources import Frame, reduced
from lightfield_gs.video.decoding import Scaling

_WAIT_S = 0.5  # for a picture, after which the end is heeded
_LOST_S = 5.0  # without a picture, after which the camera counts as pulled out
# Sizes that a RealSense is asked for, in turn: colour, and depth
_REALSENSE_SIZES = (((1280, 720), (1280, 720)), ((1280, 720), (848, 480)), ((640, 480), (640, 480)))
_RATE = 30
_MILLIMETRE = 1e-3
_PIXEL_MIDDLE = 0.5  # all of them number the middles of pixels; here the first pixel's corner is nought
_TRUE_DEPTH = 0  # Record3D's number of the front camera, whose pictures are mirrored


@dataclass(frozen=True)
class RgbdPicture(Picture):
    """A picture with measured depths.

    Attributes:
        z: float32 [h, w], metres, of the same view in any size; NaN where nothing was measured.
        focal_px: fx and fy of the pixels [H, W].
        centre_px: cx and cy, from the outer corner of the first pixel.
    """

    z: np.ndarray | None = None
    focal_px: tuple[float, float] = (1.0, 1.0)
    centre_px: tuple[float, float] = (0.0, 0.0)

    def reduced(self, scaling: Scaling) -> RgbdPicture:
        """Return it with no more pixels than these; its depths stay."""
        pixels = reduced(self.pixels, scaling)
        down, across = (small / size for small, size in zip(pixels.shape[:2], self.pixels.shape))
        focal, centre = ((across * x, down * y) for x, y in (self.focal_px, self.centre_px))
        return RgbdPicture(pixels, z=self.z, focal_px=focal, centre_px=centre)


# Waits for the next picture for a while; None: there is none yet
_Take = Callable[[], RgbdPicture | None]


class RgbdSource:
    """A camera that measures depths.

    Args:
        words: As the command line names it.
        opened: Opens it for the block, and yields what takes its pictures. Raises InputError.
    """

    def __init__(self, words: str, opened: Callable[[], AbstractContextManager[_Take]]):
        self.name, self.ends, self._opened, self._count = words, False, opened, 0
        self.pair: PairLayout | None = None

    def frames(self, stop: threading.Event) -> Iterator[Frame]:
        """See Source."""
        with self._opened() as take:
            last = time.monotonic()
            while not stop.is_set():
                picture = take()
                now = time.monotonic()
                if picture is None:
                    if now - last > _LOST_S:
                        raise InputError(f"{self.name}: no picture came for {_LOST_S:g} s; is it plugged in?")
                    continue
                last = now
                yield Frame(self._count, now, picture.reduced)
                self._count += 1


def open_rgbd(kind: str, which: str) -> RgbdSource:
    """Return the source of a kind of camera, which is in RGBD_KINDS; nothing is opened yet.

    Args:
        kind: The kind.
        which: A serial number. Empty: the first one.
    """
    words = f"{kind}:{which}"
    return RgbdSource(words, partial(RGBD_KINDS[kind], words, which))


def _package(name: str, install: str, camera: str) -> ModuleType:
    """Import a maker's package. Raises InputError where it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"{camera} needs the package {name}, which could not be imported ({error}): {install}"
        ) from None


@contextmanager
def _failing(camera: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise InputError for errors of these kinds."""
    try:
        yield
    except kinds as error:
        raise InputError(f"{camera}: {' '.join(str(error).split())[:200]}; is it plugged in, and free?") from None


@contextmanager
def _realsense(camera: str, which: str) -> Iterator[_Take]:
    rs = _package("pyrealsense2", "pip install 'lightfield-gs[realsense]'", "a RealSense")
    with _failing(camera, RuntimeError):
        pipeline = rs.pipeline()
        align = rs.align(rs.stream.color)
        _start_realsense(rs, pipeline, which)

    def take() -> RgbdPicture | None:
        with _failing(camera, RuntimeError):
            has_come, frames = pipeline.try_wait_for_frames(round(1000 * _WAIT_S))
            if not has_come:
                return None
            frames = align.process(frames)
            depth, colour = frames.get_depth_frame(), frames.get_color_frame()
            if not depth or not colour:
                return None
            lens = colour.get_profile().as_video_stream_profile().get_intrinsics()
            # The SDK's memory is valid as long as the frame
            z = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(depth.get_units())
            return _measured(np.array(colour.get_data()), z, (lens.fx, lens.fy), (lens.ppx, lens.ppy))

    try:
        yield take
    finally:
        pipeline.stop()


def _start_realsense(rs: Any, pipeline: Any, which: str) -> None:
    """Start with the first sizes that the camera has."""
    for number, (colour, depth) in enumerate(_REALSENSE_SIZES):
        config = rs.config()
        if which:
            config.enable_device(which)
        config.enable_stream(rs.stream.color, *colour, rs.format.rgb8, _RATE)
        config.enable_stream(rs.stream.depth, *depth, rs.format.z16, _RATE)
        try:
            pipeline.start(config)
            return
        except RuntimeError:
            if number == len(_REALSENSE_SIZES) - 1:
                raise


@contextmanager
def _orbbec(camera: str, which: str) -> Iterator[_Take]:
    install = "pip install --no-deps pyorbbecsdk2 (it asks for versions that exclude others' packages)"
    ob = _package("pyorbbecsdk", install, "an Orbbec")
    with _failing(camera, ob.OBError, RuntimeError):
        pipeline = ob.Pipeline(*([_orbbec_device(ob, which)] if which else []))
        config = ob.Config()
        colours = pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR)
        config.enable_stream(colours.get_video_stream_profile(0, 0, ob.OBFormat.RGB, _RATE))
        depths = pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
        config.enable_stream(depths.get_default_video_stream_profile())
        config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        pipeline.enable_frame_sync()
        align = ob.AlignFilter(align_to_stream=ob.OBStreamType.COLOR_STREAM)
        pipeline.start(config)

    def take() -> RgbdPicture | None:
        with _failing(camera, ob.OBError, RuntimeError):
            frames = pipeline.wait_for_frames(round(1000 * _WAIT_S))
            frames = None if frames is None else align.process(frames)
            if frames is None:
                return None
            frames = frames.as_frame_set()
            depth, colour = frames.get_depth_frame(), frames.get_color_frame()
            if depth is None or colour is None:
                return None
            lens = colour.get_stream_profile().as_video_stream_profile().get_intrinsic()
            pixels = np.array(colour.get_data()).reshape(colour.get_height(), colour.get_width(), 3)
            values = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width())
            z = values.astype(np.float32) * np.float32(_MILLIMETRE * depth.get_depth_scale())
            return _measured(pixels, z, (lens.fx, lens.fy), (lens.cx, lens.cy))

    try:
        yield take
    finally:
        pipeline.stop()


def _orbbec_device(ob: Any, which: str) -> Any:
    return ob.Context().query_devices().get_device_by_serial_number(which)


@contextmanager
def _record3d(camera: str, which: str) -> Iterator[_Take]:
    package = _package("record3d", "pip install 'lightfield-gs[record3d]'", "Record3D")
    found = [one for one in package.Record3DStream.get_connected_devices() if not which or one.udid == which]
    if not found:
        raise InputError(
            f"{camera}: there is no such phone; connect it by USB, open Record3D on it, choose USB streaming and press "
            "its red button"
        )
    stream, has_come, is_over = package.Record3DStream(), threading.Event(), threading.Event()
    stream.on_new_frame, stream.on_stream_stopped = has_come.set, is_over.set
    if not stream.connect(found[0]):
        raise InputError(f"{camera}: it does not answer; press the red button of USB streaming in Record3D")

    def take() -> RgbdPicture | None:
        if is_over.is_set():
            raise InputError(f"{camera}: the phone ended the stream")
        if not has_come.wait(_WAIT_S):
            return None
        has_come.clear()
        lens, z, pixels = stream.get_intrinsic_mat(), stream.get_depth_frame(), stream.get_rgb_frame()
        centre_x = lens.tx
        if stream.get_device_type() == _TRUE_DEPTH:
            z, pixels, centre_x = z[:, ::-1], pixels[:, ::-1], pixels.shape[1] - 1 - centre_x
        z = np.array(z, np.float32)
        return _measured(np.array(pixels), z, (lens.fx, lens.fy), (centre_x, lens.ty))

    try:
        yield take
    finally:
        stream.disconnect()


def _measured(
    pixels: np.ndarray, z: np.ndarray, focal_px: tuple[float, float], middle_px: tuple[float, float]
) -> RgbdPicture:
    """Return a picture; middle_px: the principal point from the middle of the first pixel."""
    centre = middle_px[0] + _PIXEL_MIDDLE, middle_px[1] + _PIXEL_MIDDLE
    return RgbdPicture(pixels, z=np.where(z > 0, z, np.nan), focal_px=focal_px, centre_px=centre)


# By what the command line names, and a serial number. "kinect" are the successors of Azure Kinect, which Orbbec makes
# (Femto Bolt, Femto Mega)
RGBD_KINDS: dict[str, Callable[[str, str], AbstractContextManager[_Take]]] = {
    "realsense": _realsense,
    "orbbec": _orbbec,
    "kinect": _orbbec,
    "record3d": _record3d,
}
