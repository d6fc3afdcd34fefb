"""A screen without hardware: Xvfb, with an EDID that xrandr tells of, and its pixels to look at."""

import ctypes
import ctypes.util
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

_XA_INTEGER, _REPLACE = 19, 0  # of the protocol of X
_HEADER_WORDS = 25  # of a picture of xwd: big-endian, 32 bits each


class VirtualScreen:
    """A screen of X.

    Attributes:
        display: Its name, as DISPLAY has it.
    """

    def __init__(self, display: str, frame_buffer: Path):
        self.display, self._frame_buffer = display, frame_buffer

    def pixels(self) -> np.ndarray:
        """Return what is on the screen, uint8 [h, w, 3]."""
        data = self._frame_buffer.read_bytes()
        words = np.frombuffer(data, ">u4", _HEADER_WORDS)
        header, width, height, line, colours = (int(words[number]) for number in (0, 4, 5, 12, 19))
        rows = np.frombuffer(data, np.uint8, height * line, header + 12 * colours).reshape(height, line // 4, 4)
        return rows[:, :width, 2::-1].copy()  # blue comes first

    def press(self, key: str) -> None:
        """Press and release a key, by X's name of it; skips the test where there is no library for that."""
        x11, xtest = (ctypes.util.find_library(name) for name in ("X11", "Xtst"))
        if xtest is None:
            pytest.skip("no libXtst")
        x11, xtest = ctypes.CDLL(x11), ctypes.CDLL(xtest)
        x11.XOpenDisplay.restype, x11.XStringToKeysym.restype = ctypes.c_void_p, ctypes.c_ulong
        opened = ctypes.c_void_p(x11.XOpenDisplay(self.display.encode()))
        code = x11.XKeysymToKeycode(opened, ctypes.c_ulong(x11.XStringToKeysym(key.encode())))
        for is_down in (1, 0):
            xtest.XTestFakeKeyEvent(opened, code, is_down, ctypes.c_ulong(0))
        x11.XCloseDisplay(opened)


@contextmanager
def virtual_screen(folder: Path, width: int, height: int, edid: bytes) -> Iterator[VirtualScreen]:
    """A screen of this size and name; skips the test where there is no Xvfb."""
    if shutil.which("Xvfb") is None or shutil.which("xrandr") is None:
        pytest.skip("no Xvfb, or no xrandr")
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", f"{width}x{height}x24", "-nolisten", "tcp"]
    command += ["-noreset", "-nocursor", "-fbdir", str(folder)]
    with subprocess.Popen(command, pass_fds=(writing,), stderr=subprocess.DEVNULL) as server:
        try:
            os.close(writing)
            display = f":{os.read(reading, 20).decode().strip()}"
            _set_edid(display, edid)
            yield VirtualScreen(display, folder / "Xvfb_screen0")
        finally:
            server.terminate()
            os.close(reading)


class _Resources(ctypes.Structure):
    """XRRScreenResources, as far as its outputs."""

    _fields_ = [
        ("timestamp", ctypes.c_ulong),
        ("config_timestamp", ctypes.c_ulong),
        ("crtcs", ctypes.c_int),
        ("crtc", ctypes.POINTER(ctypes.c_ulong)),
        ("outputs", ctypes.c_int),
        ("output", ctypes.POINTER(ctypes.c_ulong)),
    ]


def _set_edid(display: str, edid: bytes) -> None:
    """Give the screen's only output an EDID, as drivers of real ones do."""
    x11, xrandr = (ctypes.CDLL(ctypes.util.find_library(name)) for name in ("X11", "Xrandr"))
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XDefaultRootWindow.restype = x11.XInternAtom.restype = ctypes.c_ulong
    xrandr.XRRGetScreenResources.restype = ctypes.POINTER(_Resources)
    opened = ctypes.c_void_p(x11.XOpenDisplay(display.encode()))
    root = ctypes.c_ulong(x11.XDefaultRootWindow(opened))
    found = xrandr.XRRGetScreenResources(opened, root)
    output, name = ctypes.c_ulong(found.contents.output[0]), ctypes.c_ulong(x11.XInternAtom(opened, b"EDID", False))
    xrandr.XRRChangeOutputProperty(opened, output, name, ctypes.c_ulong(_XA_INTEGER), 8, _REPLACE, edid, len(edid))
    x11.XCloseDisplay(opened)
