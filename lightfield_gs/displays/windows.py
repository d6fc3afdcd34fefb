"""Screens on Windows, by its own functions: EnumDisplayDevices, EnumDisplaySettings, and the EDIDs in the registry."""

from __future__ import annotations

import ctypes
import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from lightfield_gs.displays.edid import parse_edid
from lightfield_gs.displays.screens import Screen

_ACTIVE = 1  # DISPLAY_DEVICE_ACTIVE, DISPLAY_DEVICE_ATTACHED_TO_DESKTOP
_INTERFACE_NAME = 1  # EDD_GET_DEVICE_INTERFACE_NAME
_CURRENT = 0xFFFFFFFF  # ENUM_CURRENT_SETTINGS
_NEAREST = 2  # MONITOR_DEFAULTTONEAREST
_USUAL_DPI = 96
_PER_MONITOR_AWARE = -4  # DPI_AWARENESS_CONTEXT_PER_MONITOR_AWARE_V2


class DisplayDevice(ctypes.Structure):
    """DISPLAY_DEVICEW of wingdi.h."""

    _fields_ = (
        ("cb", ctypes.c_uint32),
        ("DeviceName", ctypes.c_wchar * 32),
        ("DeviceString", ctypes.c_wchar * 128),
        ("StateFlags", ctypes.c_uint32),
        ("DeviceID", ctypes.c_wchar * 128),
        ("DeviceKey", ctypes.c_wchar * 128),
    )


class Point(ctypes.Structure):
    """POINT of windef.h."""

    _fields_ = (("x", ctypes.c_int32), ("y", ctypes.c_int32))


class DeviceMode(ctypes.Structure):
    """DEVMODEW of wingdi.h, with the members of a display."""

    _fields_ = (
        ("dmDeviceName", ctypes.c_wchar * 32),
        ("dmSpecVersion", ctypes.c_uint16),
        ("dmDriverVersion", ctypes.c_uint16),
        ("dmSize", ctypes.c_uint16),
        ("dmDriverExtra", ctypes.c_uint16),
        ("dmFields", ctypes.c_uint32),
        ("dmPosition", Point),
        ("dmDisplayOrientation", ctypes.c_uint32),
        ("dmDisplayFixedOutput", ctypes.c_uint32),
        ("unused", ctypes.c_uint16 * 5),
        ("dmFormName", ctypes.c_wchar * 32),
        ("dmLogPixels", ctypes.c_uint16),
        ("dmBitsPerPel", ctypes.c_uint32),
        ("dmPelsWidth", ctypes.c_uint32),
        ("dmPelsHeight", ctypes.c_uint32),
        ("rest", ctypes.c_uint32 * 10),
    )


def read_screens() -> list[Screen]:
    """Return the connected screens."""
    libraries: Any = ctypes
    return enumerate_screens(libraries.windll.user32, libraries.windll.shcore, _registry_edid)


def enumerate_screens(user32: Any, shcore: Any, read_edid: Callable[[str], bytes]) -> list[Screen]:
    """Return the screens of the desktop.

    Args:
        user32: The library of that name.
        shcore: The library of that name.
        read_edid: Returns the EDID of a monitor's interface name; empty where there is none.
    """
    found = []
    with _in_own_pixels(user32):
        for adapter in _devices(user32, None, 0):
            mode = DeviceMode(dmSize=ctypes.sizeof(DeviceMode))
            if not user32.EnumDisplaySettingsW(
                ctypes.c_wchar_p(adapter.DeviceName), ctypes.c_uint32(_CURRENT), ctypes.byref(mode)
            ):
                continue
            scale = _scale(user32, shcore, mode.dmPosition)
            for monitor in _devices(user32, adapter.DeviceName, _INTERFACE_NAME):
                edid = parse_edid(read_edid(monitor.DeviceID))
                found.append(
                    Screen(
                        adapter.DeviceName.removeprefix("\\\\.\\"),
                        (edid and edid.name) or monitor.DeviceString,
                        edid.serial if edid else "",
                        mode.dmPelsWidth,
                        mode.dmPelsHeight,
                        (mode.dmPosition.x, mode.dmPosition.y),
                        scale,
                        edid.size_mm if edid else None,
                    )
                )
    return found


@contextmanager
def _in_own_pixels(user32: Any) -> Iterator[None]:
    """Let this thread see each monitor's true scale inside the block, where the system can."""
    set_context = getattr(user32, "SetThreadDpiAwarenessContext", None)
    if set_context is None:
        yield
        return
    set_context.restype = ctypes.c_void_p
    before = set_context(ctypes.c_void_p(_PER_MONITOR_AWARE))
    try:
        yield
    finally:
        set_context(ctypes.c_void_p(before))


def _devices(user32: Any, adapter: str | None, flags: int) -> Iterator[DisplayDevice]:
    """Yield the active adapters; or the active monitors of one."""
    for number in range(64):
        device = DisplayDevice(cb=ctypes.sizeof(DisplayDevice))
        name = ctypes.c_wchar_p(adapter)
        if not user32.EnumDisplayDevicesW(name, ctypes.c_uint32(number), ctypes.byref(device), ctypes.c_uint32(flags)):
            return
        if device.StateFlags & _ACTIVE:
            yield device


def _scale(user32: Any, shcore: Any, corner: Point) -> float | None:
    """Return the scale of the monitor at a point of the desktop; None where the system does not tell."""
    across, down = ctypes.c_uint32(), ctypes.c_uint32()
    user32.MonitorFromPoint.restype = ctypes.c_void_p
    monitor = ctypes.c_void_p(user32.MonitorFromPoint(corner, ctypes.c_uint32(_NEAREST)))
    if shcore.GetDpiForMonitor(monitor, ctypes.c_int(0), ctypes.byref(across), ctypes.byref(down)) != 0:
        return None
    return across.value / _USUAL_DPI or None


def registry_key(interface: str) -> str:
    r"""Return the registry's key of a monitor: for \\?\DISPLAY#LKG01#5&1a&0&UID0#{...} its folder of Enum\DISPLAY."""
    parts = interface.removeprefix("\\\\?\\").split("#")
    if len(parts) < 3:
        return ""
    return f"SYSTEM\\CurrentControlSet\\Enum\\{parts[0]}\\{parts[1]}\\{parts[2]}\\Device Parameters"


def _registry_edid(interface: str) -> bytes:
    registry: Any = importlib.import_module("winreg")
    try:
        with registry.OpenKey(registry.HKEY_LOCAL_MACHINE, registry_key(interface)) as key:
            return bytes(registry.QueryValueEx(key, "EDID")[0])
    except OSError:
        return b""
