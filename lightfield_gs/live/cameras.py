"""The cameras and the screen of this machine: which there are, and how FFmpeg opens one."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass

from lightfield_gs.base.errors import InputError
from lightfield_gs.video.decoding import av_library

_CAMERAS = {"linux": "v4l2", "darwin": "avfoundation", "win32": "dshow"}
_SIZE = {"video_size": "1280x720", "framerate": "30"}
# What a camera is asked for, in turn, until it agrees: compressed pictures first, for USB carries few others a second
_WISHES: dict[str, tuple[dict[str, str], ...]] = {
    "v4l2": ({"input_format": "mjpeg", **_SIZE}, {}),
    "avfoundation": (_SIZE, {"framerate": "30"}, {}),
    "dshow": ({"vcodec": "mjpeg", **_SIZE}, {}),
}


@dataclass(frozen=True)
class Device:
    """A device of this machine.

    Attributes:
        name: For people.
        address: For FFmpeg.
        format: FFmpeg's name of its kind.
        wishes: Options of the format; the first that the device agrees to are taken.
        crop: Left, top, width and height of the part of its pictures that is taken, pixels. None: all.
    """

    name: str
    address: str
    format: str
    wishes: tuple[dict[str, str], ...] = ({},)
    crop: tuple[int, int, int, int] | None = None


def find_camera(which: str) -> Device:
    """Return the camera of a number, or of a part of its name. Raises InputError, with the cameras that are there."""
    kind = _CAMERAS.get(sys.platform)
    if kind is None:
        raise InputError("camera: cameras are read on Linux, macOS and Windows alone; give a film or an address")
    there = _known(kind)
    for number, (address, name) in there.items():
        if which == str(number) or (not which.isdecimal() and which.casefold() in name.casefold()):
            return Device(name, address, kind, _WISHES[kind])
    unlisted = None if there else _unlisted(kind, which)
    if unlisted is not None:
        return Device(f"camera {which}", unlisted, kind, _WISHES[kind])
    names = ", ".join(f"camera:{number} ({name})" for number, (_, name) in there.items())
    hint = f"expected one of {names}" if there else "no camera was found; is it plugged in, and free?"
    raise InputError(f"camera:{which}: there is no such camera; {hint}")


def _known(kind: str) -> dict[int, tuple[str, str]]:
    """Return address and name of the cameras that FFmpeg lists, by their numbers; none where it cannot list them."""
    av = av_library("a camera")
    try:
        found = av.enumerate_input_devices(kind)
    except (AttributeError, ValueError, av.FFmpegError):  # the first of a PyAV before 16
        return {}
    films = [one for one in found if not one.media_types or "video" in one.media_types]
    if kind == "v4l2":
        numbered = {int(part[1]): one for one in films if (part := re.fullmatch(r"/dev/video(\d+)", one.name))}
        return {number: (one.name, one.description) for number, one in sorted(numbered.items())}
    form = "{}:none" if kind == "avfoundation" else "video={}"
    return {number: (form.format(one.name), one.description or one.name) for number, one in enumerate(films)}


def _unlisted(kind: str, which: str) -> str | None:
    """Return the address of a camera that FFmpeg does not list, where it can be there all the same."""
    if kind == "avfoundation":
        return f"{which}:none"
    if kind == "dshow":
        return None if which.isdecimal() else f"video={which}"
    path = f"/dev/video{which}"
    return path if which.isdecimal() and os.path.exists(path) else None


def find_screen(part: str, rate: float) -> Device:
    """Return the screen, or the part X,Y,WxH of it. Raises InputError where it cannot be read.

    Args:
        part: Left, top and size, pixels; empty: all of the screen.
        rate: Pictures a second.
    """
    numbers = re.fullmatch(r"(\d+),(\d+),(\d+)x(\d+)", part)
    if part and (numbers is None or not (int(numbers[3]) and int(numbers[4]))):
        raise InputError(f"screen:{part}: expected screen: alone, or left, top and size as screen:100,50,1280x720")
    left, top, width, height = (int(one) for one in numbers.groups()) if numbers else (0, 0, 0, 0)
    options = {"framerate": f"{rate:g}"}
    sized = {"video_size": f"{width}x{height}"} if numbers else {}
    name = f"screen {part}".strip()
    if sys.platform == "darwin":
        crop = (left, top, width, height) if numbers else None
        return Device(name, "Capture screen 0:none", "avfoundation", (options, {}), crop)
    if sys.platform == "win32":
        offset = {"offset_x": str(left), "offset_y": str(top)} if numbers else {}
        return Device(name, "desktop", "gdigrab", ({**options, **sized, **offset},))
    display = os.environ.get("DISPLAY")
    if os.environ.get("WAYLAND_DISPLAY"):
        raise InputError(
            "screen: this desktop is of Wayland, which shows programs no screen; log in with an X11 (Xorg) session, or "
            "share the window as a camera, as OBS Studio's virtual camera does"
        )
    if not display:
        raise InputError("screen: there is no X11 screen (DISPLAY is not set); start it on the desktop")
    return Device(name, f"{display}+{left},{top}", "x11grab", ({**options, **sized},))
