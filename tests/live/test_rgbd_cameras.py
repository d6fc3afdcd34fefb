"""Cameras that measure depths: stand-ins for their makers' packages, with the same functions, give recorded frames."""

import sys
import threading
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from lightfield_gs.app.options import LookOptions, PhotoOptions, RenderOptions
from lightfield_gs.base.cli_messages import capturable_streams
from lightfield_gs.base.errors import InputError
from lightfield_gs.live import rgbd_cameras
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.health import Health
from lightfield_gs.live.opening import open_source
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.panels.panel import Panel
from lightfield_gs.video.decoding import Scaling

pytest.importorskip("av", reason="live sources need the extra `video`")
HEIGHT, WIDTH = 96, 128
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
NEAR = (ROWS - 40) ** 2 + (COLUMNS - 70) ** 2 < 20**2
METRES = np.where(NEAR, 0.8, 1.5).astype(np.float32)
METRES[:, :9] = 0  # not measured
RGB = np.stack([COLUMNS, 2 * ROWS, np.where(NEAR, 250, 60)], 2).astype(np.uint8)
FOCAL, MIDDLE = (110.0, 112.0), (63.5, 47.5)


def module(name: str, **members) -> ModuleType:
    made = ModuleType(name)
    vars(made).update(members)
    return made


def pyrealsense2(calls: list[str]) -> ModuleType:
    lens = SimpleNamespace(fx=FOCAL[0], fy=FOCAL[1], ppx=MIDDLE[0], ppy=MIDDLE[1])
    profile = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: lens))
    depth = SimpleNamespace(get_data=lambda: np.round(METRES / 0.00025).astype(np.uint16), get_units=lambda: 0.00025)
    frames = SimpleNamespace(
        get_depth_frame=lambda: depth,
        get_color_frame=lambda: SimpleNamespace(get_data=lambda: RGB, get_profile=lambda: profile),
    )

    class Config:
        def __init__(self):
            self.sizes = []

        def enable_device(self, serial: str) -> None:
            calls.append(serial)

        def enable_stream(self, stream, width, height, form, rate) -> None:
            self.sizes.append((width, height))

    class Pipeline:
        def start(self, config: Config) -> None:
            if config.sizes != [(640, 480)] * 2:
                raise RuntimeError("Couldn't resolve requests")

        def try_wait_for_frames(self, timeout_ms: int):
            return True, frames

        def stop(self) -> None:
            calls.append("stop")

    return module(
        "pyrealsense2",
        pipeline=Pipeline,
        config=Config,
        align=lambda stream: SimpleNamespace(process=lambda given: given),
        stream=SimpleNamespace(color=1, depth=2),
        format=SimpleNamespace(rgb8=1, z16=2),
    )


def pyorbbecsdk(calls: list[str]) -> ModuleType:
    lens = SimpleNamespace(fx=FOCAL[0], fy=FOCAL[1], cx=MIDDLE[0], cy=MIDDLE[1])
    profile = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsic=lambda: lens))
    size = {"get_width": lambda: WIDTH, "get_height": lambda: HEIGHT}
    values = np.round(METRES * 1000).astype(np.uint16)
    depth = SimpleNamespace(get_data=lambda: values.view(np.uint8).ravel(), get_depth_scale=lambda: 1.0, **size)
    colour = SimpleNamespace(get_data=RGB.ravel, get_stream_profile=lambda: profile, **size)
    frames = SimpleNamespace(get_depth_frame=lambda: depth, get_color_frame=lambda: colour)
    frames.as_frame_set = lambda: frames
    profiles = SimpleNamespace(get_video_stream_profile=lambda *a: "rgb", get_default_video_stream_profile=lambda: "z")

    class Pipeline:
        def __init__(self, device=None):
            calls.append(device)

        def get_stream_profile_list(self, sensor):
            return profiles

        def enable_frame_sync(self) -> None: ...

        def start(self, config) -> None: ...

        def wait_for_frames(self, timeout_ms: int):
            return frames

        def stop(self) -> None:
            calls.append("stop")

    ignore = SimpleNamespace(enable_stream=lambda profile: None, set_frame_aggregate_output_mode=lambda mode: None)
    devices = SimpleNamespace(get_device_by_serial_number=lambda serial: serial)
    return module(
        "pyorbbecsdk",
        Pipeline=Pipeline,
        Config=lambda: ignore,
        Context=lambda: SimpleNamespace(query_devices=lambda: devices),
        AlignFilter=lambda align_to_stream: SimpleNamespace(process=lambda given: given),
        OBError=type("OBError", (Exception,), {}),
        OBSensorType=SimpleNamespace(COLOR_SENSOR=1, DEPTH_SENSOR=2),
        OBStreamType=SimpleNamespace(COLOR_STREAM=1),
        OBFormat=SimpleNamespace(RGB=1),
        OBFrameAggregateOutputMode=SimpleNamespace(FULL_FRAME_REQUIRE=1),
    )


def record3d(calls: list[str], is_front: bool = False) -> ModuleType:
    flip = np.s_[:, ::-1] if is_front else np.s_[:]

    class Stream:
        @staticmethod
        def get_connected_devices():
            return [SimpleNamespace(product_id=1, udid="one"), SimpleNamespace(product_id=2, udid="phone")]

        def connect(self, device) -> bool:
            calls.append(device.udid)
            self.on_new_frame()
            return True

        def get_depth_frame(self):
            self.on_new_frame()  # the next is there
            return METRES[::2, ::2][flip]

        def get_rgb_frame(self):
            return RGB[flip]

        def get_intrinsic_mat(self):
            centre = WIDTH - 1 - MIDDLE[0] if is_front else MIDDLE[0]
            return SimpleNamespace(fx=FOCAL[0], fy=FOCAL[1], tx=centre, ty=MIDDLE[1])

        def get_device_type(self) -> int:
            return 0 if is_front else 1

        def disconnect(self) -> None:
            calls.append("stop")

    return module("record3d", Record3DStream=Stream)


PACKAGES = {
    "realsense:phone": pyrealsense2,
    "kinect:phone": pyorbbecsdk,
    "record3d:phone": record3d,
    "record3d:": lambda calls: record3d(calls, is_front=True),
}


@pytest.fixture(params=PACKAGES)
def camera(request, monkeypatch) -> Iterator[tuple[str, list[str]]]:
    calls: list[str] = []
    package = PACKAGES[request.param](calls)
    monkeypatch.setitem(sys.modules, package.__name__, package)
    yield request.param, calls


def test_measured_depths_become_gaussians_where_the_camera_saw_them(camera):
    words, calls = camera
    source, stop = open_source(words, 30), threading.Event()
    frames = source.frames(stop)
    taken = [next(frames), next(frames)]
    how = RenderOptions(), LookOptions(), Panel.load("toy-8v"), "cpu", Detail(30, 1_000_000), Health()
    scenes = LiveScenes(source, PhotoOptions(), *how)
    with capturable_streams(), torch.inference_mode():
        scenes.settle(iter(taken))
        ((_, scene),) = list(scenes(iter(taken[:1])))
    stop.set()
    assert list(frames) == [] and calls[-1] == "stop" and calls[0] in ("phone", "one")
    assert any("by the camera" in line for line in scenes.messages)
    means, opacity = (part[: ROWS.size].reshape(HEIGHT, WIDTH, -1) for part in (scene.means, scene.opacities[:, None]))
    at = np.s_[40, 70], np.s_[80, 20]
    for row, column in at:
        z = float(METRES[row, column])
        there = [(column - MIDDLE[0]) / FOCAL[0] * z, (row - MIDDLE[1]) / FOCAL[1] * z, z]
        np.testing.assert_allclose(means[row, column], there, rtol=2e-3, atol=1e-3)
    assert float(opacity[40, 3]) == 0 and float(opacity[40, 70]) > 0.9


def test_depths_of_smaller_pictures_stay_where_they_are(camera):
    frames = open_source(camera[0], 30).frames(threading.Event())
    picture = next(frames).picture(Scaling(HEIGHT * WIDTH // 4))
    assert picture.pixels.shape == (HEIGHT // 2, WIDTH // 2, 3)
    np.testing.assert_allclose(picture.focal_px, np.divide(FOCAL, 2))
    np.testing.assert_allclose(picture.centre_px, (np.array(MIDDLE) + 0.5) / 2)
    frames.close()


@pytest.mark.parametrize(
    "words, needed",
    [
        ("realsense:", r"lightfield-gs\[realsense\]"),
        ("orbbec:", "pyorbbecsdk2"),
        ("record3d:", r"lightfield-gs\[record3d\]"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(words, needed, monkeypatch):
    for name in ("pyrealsense2", "pyorbbecsdk", "record3d"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=needed):
        next(open_source(words, 30).frames(threading.Event()))


def test_a_camera_that_is_not_there_or_stays_silent_is_an_error(monkeypatch):
    calls: list[str] = []
    package = pyrealsense2(calls)
    monkeypatch.setitem(sys.modules, "pyrealsense2", package)
    monkeypatch.setattr(rgbd_cameras, "_LOST_S", 0.05)
    package.pipeline.try_wait_for_frames = lambda self, timeout_ms: (False, None)
    with pytest.raises(InputError, match="realsense:: no picture came"):
        list(open_source("realsense:", 30).frames(threading.Event()))
    assert calls == ["stop"]

    def absent(self, config):
        raise RuntimeError("No device connected")

    package.pipeline.start = absent
    with pytest.raises(InputError, match="No device connected"):
        next(open_source("realsense:", 30).frames(threading.Event()))
    orbbec = pyorbbecsdk(calls)
    orbbec.Pipeline.start = absent
    monkeypatch.setitem(sys.modules, "pyorbbecsdk", orbbec)
    with pytest.raises(InputError, match="^kinect:: No device connected"):
        next(open_source("kinect:", 30).frames(threading.Event()))
    monkeypatch.setitem(sys.modules, "record3d", record3d(calls))
    with pytest.raises(InputError, match="record3d:another.*USB"):
        next(open_source("record3d:another", 30).frames(threading.Event()))
