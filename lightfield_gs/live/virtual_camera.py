"""The way out to a virtual camera, which programs of calls and of recordings read as any other: v4l2loopback on Linux.

Source: Linux Media Subsystem, Video for Linux API: "Querying Capabilities", "Data Format Negotiation" and
"Read/Write" of "Video Output Interface"; linux/videodev2.h.
"""

from __future__ import annotations

import os
import re
import struct
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.sources import Frame
from lightfield_gs.video.decoding import av_library

_DEVICES, _NAMES = Path("/dev"), Path("/sys/class/video4linux")
_QUERYCAP, _S_FMT = 0x80685600, 0xC0D05605  # of struct v4l2_capability and v4l2_format, 104 and 208 bytes
_CAPABILITIES = struct.Struct("=84x2I12x")  # capabilities of the hardware, and of the device if the first say so
_OF_THE_DEVICE, _IS_OUTPUT = 0x80000000, 0x00000002
# Type; width, height, format, field, bytes of a row and of a picture, colours, magic, flags, matrix, range, transfer
_FORMAT = struct.Struct("=I4x2I4s9I152x")
_OUTPUT, _PROGRESSIVE, _MAGIC = 2, 1, 0xFEEDCAFE  # the last one: the fields behind it count
_YUYV = b"YUYV"
_SRGB, _MATRIX_601, _LIMITED_RANGE, _TRANSFER_SRGB = 8, 1, 2, 2  # as webcams have them
_INSTALL = (
    "sudo apt install v4l2loopback-dkms, then sudo modprobe v4l2loopback exclusive_caps=1 card_label=lightfield-gs "
    "makes one"
)


def find_virtual_camera(which: str) -> Path:
    """Return the device of a path or of a part of its name. Raises InputError, with those that are there.

    Args:
        which: /dev/videoN, or a part of the name that other programs list.
    """
    if not sys.platform.startswith("linux"):
        raise InputError(
            "--virtual-camera: it is written on Linux alone; here let OBS Studio show the page of --stereo half-sbs as "
            "a browser source, and start the virtual camera of OBS Studio"
        )
    there = {path: name for path, name in _devices().items() if _takes_pictures(path)}
    if which.startswith("/"):
        path = Path(which)
        if path in there:
            return path
        reason = "there is no such device" if not path.exists() else "it takes no pictures, or may not be opened"
    else:
        found = [path for path, name in there.items() if which.casefold() in name.casefold()]
        if found:
            return found[0]
        reason = "there is no virtual camera of this name"
    known = ", ".join(f"{path} ({name})" for path, name in there.items())
    raise InputError(f"--virtual-camera {which}: {reason}; {f'expected one of {known}' if known else _INSTALL}")


def _devices() -> dict[Path, str]:
    """Return the names of the video devices, by their numbers."""
    paths = [path for path in _DEVICES.glob("video*") if re.fullmatch(r"video\d+", path.name)]
    names = {}
    for path in sorted(paths, key=lambda one: int(one.name[5:])):
        try:
            names[path] = (_NAMES / path.name / "name").read_text().strip()
        except OSError:
            names[path] = path.name
    return names


def _takes_pictures(path: Path) -> bool:
    """Return whether a device says that it is an output."""
    try:
        number = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        answer = bytearray(_CAPABILITIES.size)
        _fcntl().ioctl(number, _QUERYCAP, answer)
        of_all, of_it = _CAPABILITIES.unpack(answer)
        return bool((of_it if of_all & _OF_THE_DEVICE else of_all) & _IS_OUTPUT)
    except OSError:
        return False
    finally:
        os.close(number)


def _fcntl() -> ModuleType:
    import fcntl  # Windows has none

    return fcntl


class VirtualCamera:
    """A device that takes pictures in YUYV, with the colours of webcams: sRGB, BT.601, limited range.

    Args:
        path: See find_virtual_camera.
        size_px: Width and height of the pictures; the width is even.
        health: Counts.

    Raises:
        InputError: The device does not take such pictures.
    """

    def __init__(self, path: Path, size_px: tuple[int, int], health: Health):
        self._path, self._health, self._av = path, health, av_library("a virtual camera")
        try:
            self._number = os.open(path, os.O_RDWR)
        except OSError as error:
            raise InputError(f"--virtual-camera {path}: {error.strerror}; is another program writing to it?") from None
        try:
            self._agree(size_px)
        except BaseException:
            self.close()
            raise

    def _agree(self, size_px: tuple[int, int]) -> None:
        width, height = size_px
        sizes = 2 * width, 2 * width * height
        colours = _SRGB, _MAGIC, 0, _MATRIX_601, _LIMITED_RANGE, _TRANSFER_SRGB
        wanted = bytearray(_FORMAT.pack(_OUTPUT, width, height, _YUYV, _PROGRESSIVE, *sizes, *colours))
        way = "close the programs that read it, and start again"
        try:
            _fcntl().ioctl(self._number, _S_FMT, wanted)
        except OSError as error:
            raise InputError(
                f"--virtual-camera {self._path}: it does not take {width} x {height} ({error.strerror}); {way}"
            ) from None
        _, got_width, got_height, kind, _, *got_sizes = _FORMAT.unpack(wanted)[:7]
        if (got_width, got_height, kind, *got_sizes) != (width, height, _YUYV, *sizes):
            words = f"{got_width} x {got_height} of {kind.decode(errors='replace')}"
            raise InputError(
                f"--virtual-camera {self._path}: it keeps to {words}, and the pictures are {width} x {height} of YUYV; "
                f"{way}"
            )

    def put(self, frame: Frame, drawn: Drawn) -> None:
        """See Out."""
        with self._health.busy("virtual camera", frame):
            try:
                os.write(self._number, self._packed(drawn.pixels).data)  # each call is a picture
            except OSError as error:
                raise InputError(f"--virtual-camera {self._path}: it takes no picture ({error.strerror})") from None
        self._health.has_sent(frame)

    def close(self) -> None:
        """Give the device back."""
        os.close(self._number)

    def _packed(self, pixels: np.ndarray) -> np.ndarray:
        """Return a picture in YUYV, uint8 [H, W, 2]."""
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
        # FFmpeg's scaler converts by BT.601 to the limited range where nothing else is said
        return np.ascontiguousarray(frame.reformat(format="yuyv422").to_ndarray())
