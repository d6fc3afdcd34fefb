"""The virtual camera: what a device of the kernel is told, and the pictures that it gets."""

import ctypes
import os
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from command_line import complaint, run
from live_sources import clock, write_film

from lightfield_gs.base.errors import InputError
from lightfield_gs.live import virtual_camera
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.sources import Frame
from lightfield_gs.live.virtual_camera import VirtualCamera, find_virtual_camera
from lightfield_gs.video.decoding import decode

pytest.importorskip("av", reason="live sources need the extra `video`")


class PixFormat(ctypes.Structure):
    """v4l2_pix_format of linux/videodev2.h."""

    _fields_ = [
        (name, ctypes.c_uint32)
        for name in "width height pixelformat field bytesperline sizeimage colorspace priv flags ycbcr_enc quantization"
        " xfer_func".split()
    ]


class Union(ctypes.Union):
    _fields_ = [("pix", PixFormat), ("raw", ctypes.c_uint8 * 200), ("aligned", ctypes.c_void_p)]


class Format(ctypes.Structure):
    """v4l2_format."""

    _fields_ = [("type", ctypes.c_uint32), ("fmt", Union)]


class Capability(ctypes.Structure):
    """v4l2_capability."""

    _fields_ = [
        ("driver", ctypes.c_char * 16),
        ("card", ctypes.c_char * 32),
        ("bus_info", ctypes.c_char * 32),
        ("version", ctypes.c_uint32),
        ("capabilities", ctypes.c_uint32),
        ("device_caps", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 3),
    ]


def request(read_write: int, number: int, of: type[ctypes.Structure]) -> int:
    """_IOC of asm-generic/ioctl.h for the letter V."""
    return read_write << 30 | ctypes.sizeof(of) << 16 | ord("V") << 8 | number


class Loopback:
    """Stands in for the ioctl of v4l2loopback: devices are files, of which those of these names are outputs.

    Attributes:
        formats: What was asked for.
        keeps: Width that a reader holds it to.
    """

    def __init__(self, *outputs: str):
        self._outputs, self.formats, self.keeps = outputs, list[PixFormat](), 0

    def ioctl(self, number: int, code: int, data: bytearray) -> int:
        name = os.path.basename(os.readlink(f"/proc/self/fd/{number}"))
        if code == request(2, 0, Capability):
            answer = Capability.from_buffer(data)
            answer.capabilities = 0x80000000 | 0x04000003
            answer.device_caps = 0x2 if name in self._outputs else 0x1
        elif code == request(3, 5, Format):
            answer = Format.from_buffer(data)
            assert answer.type == 2 and name in self._outputs
            self.formats.append(PixFormat.from_buffer_copy(answer.fmt.pix))
            answer.fmt.pix.width = self.keeps or answer.fmt.pix.width
        else:
            raise OSError(25, "Inappropriate ioctl for device")
        return 0


@pytest.fixture
def loopback(tmp_path, monkeypatch):
    """A webcam and two virtual cameras."""
    devices, names = tmp_path / "dev", tmp_path / "sys"
    for name, title in (("video0", "Webcam"), ("video3", "OBS Virtual Camera"), ("video10", "lightfield-gs")):
        (names / name).mkdir(parents=True)
        (names / name / "name").write_text(f"{title}\n")
        devices.mkdir(exist_ok=True)
        (devices / name).touch()
    stand_in = Loopback("video3", "video10")
    monkeypatch.setattr(virtual_camera.sys, "platform", "linux")
    monkeypatch.setattr(virtual_camera, "_DEVICES", devices)
    monkeypatch.setattr(virtual_camera, "_NAMES", names)
    monkeypatch.setattr(virtual_camera, "_fcntl", lambda: SimpleNamespace(ioctl=stand_in.ioctl))
    return stand_in, devices


def test_a_device_is_found_by_path_or_name(loopback):
    _, devices = loopback
    assert find_virtual_camera(f"{devices}/video3") == find_virtual_camera("obs") == devices / "video3"
    assert find_virtual_camera("lightfield") == devices / "video10"
    known = rf"expected one of {devices}/video3 \(OBS Virtual Camera\), {devices}/video10 \(lightfield-gs\)"
    for which, words in (("webcam", "of this name"), (f"{devices}/video0", "takes no pictures"), ("/none", "no such")):
        with pytest.raises(InputError, match=f"{words}.*; {known}"):
            find_virtual_camera(which)


def test_without_a_device_or_on_another_system_the_way_out_is_said(loopback, monkeypatch):
    _, devices = loopback
    for name in ("video3", "video10"):
        (devices / name).unlink()
    with pytest.raises(InputError, match="modprobe v4l2loopback"):
        find_virtual_camera("obs")
    monkeypatch.setattr(virtual_camera.sys, "platform", "darwin")
    with pytest.raises(InputError, match="browser source"):
        find_virtual_camera("obs")


def test_pictures_are_written_in_the_colours_of_webcams(loopback):
    """Y, U and V of pure colours by ITU-R BT.601 in the limited range."""
    stand_in, devices = loopback
    codes = {
        (255, 0, 0): (81, 90, 240),
        (0, 255, 0): (145, 54, 34),
        (0, 0, 255): (41, 240, 110),
        (255, 255, 255): (235, 128, 128),
        (0, 0, 0): (16, 128, 128),
    }
    pixels = np.repeat(np.array([list(codes)], np.uint8), 2, axis=1).repeat(4, axis=0)
    camera = VirtualCamera(devices / "video3", (10, 4), Health())
    for number in range(2):
        frame = Frame(number, time.monotonic(), lambda scaling: None)
        camera.put(frame, Drawn(torch.from_numpy(pixels[:, ::-1].copy() if number else pixels)))
    camera.close()
    row = [part for y, u, v in codes.values() for part in (y, u, y, v)]
    back = [part for y, u, v in reversed(codes.values()) for part in (y, u, y, v)]
    written = np.frombuffer((devices / "video3").read_bytes(), np.uint8).astype(int)
    assert written.size == 160 and np.abs(written - [*row * 4, *back * 4]).max() <= 1  # FFmpeg rounds up or down
    (told,) = stand_in.formats
    assert (told.width, told.height, told.bytesperline, told.sizeimage) == (10, 4, 20, 80)
    assert told.pixelformat.to_bytes(4, "little") == b"YUYV" and told.field == 1
    assert (told.colorspace, told.ycbcr_enc, told.quantization, told.xfer_func) == (8, 1, 2, 2)
    assert told.priv == 0xFEEDCAFE and told.flags == 0


def test_a_device_that_keeps_another_size_is_refused(loopback):
    stand_in, devices = loopback
    stand_in.keeps = 640
    with pytest.raises(InputError, match="it keeps to 640 x 4 of YUYV, and the pictures are 8 x 4"):
        VirtualCamera(devices / "video3", (8, 4), Health())


def test_live_writes_both_eyes_as_video_draws_them(loopback, tmp_path, capsys):
    """The recording of the run is without loss; the camera gets its brightness by BT.601."""
    _, devices = loopback
    film = write_film(tmp_path / "film.mkv", [clock(341, (40, 80))] * 6)
    two = "--stereo half-sbs --eye-size 96x64 --depth flat"
    run(capsys, f"video {film} -o {tmp_path}/all.mkv --codec ffv1 {two}")
    said = run(capsys, f"live {film} {two} --virtual-camera obs -o {tmp_path}/live.mkv --codec ffv1")
    expected = next(decode(tmp_path / "all_half_2x1.mkv"))
    assert expected.shape == (64, 96, 3) and np.ptp(expected) > 100
    np.testing.assert_array_equal(next(decode(tmp_path / "live_half_2x1.mkv")), expected)
    written = np.frombuffer((devices / "video3").read_bytes(), np.uint8).reshape(-1, 64, 96, 2)
    luma = 16 + expected @ np.array([65.481, 128.553, 24.966]) / 255
    assert len(written) >= 1 and np.abs(written[0, ..., 0] - luma).max() <= 1
    assert "video3, 96 x 64, half-sbs" in said and "a screen of two eyes" in said and "open http" not in said
    assert f"next: lightfield-gs show {tmp_path}/live_half_2x1.mkv" in said


@pytest.mark.parametrize(
    "options, words",
    [
        ("--virtual-camera obs --port 8000", "--virtual-camera takes the place of the page"),
        ("--virtual-camera obs --quality fast", "of two eyes"),
        ("--virtual-camera obs --panel 27", "--panel is one of many views"),
        ("--virtual-camera obs --stereo mpo", "a live picture takes sbs"),
        ("--eye-size 64x64", "--eye-size is for --stereo"),
    ],
)
def test_what_a_virtual_camera_cannot_have_is_refused(loopback, options, words, tmp_path, capsys):
    film = write_film(tmp_path / "film.mkv", [clock(341, (40, 80))])
    assert words in complaint(capsys, f"live {film} --depth flat {options}")
