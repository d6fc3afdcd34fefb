"""Connected screens: EDIDs, and the outputs of each system's programs and functions."""

import ctypes
import json
import os
import shutil
import subprocess
import time

import pytest
from screen_cases import connector, edid

from lightfield_gs.displays import linux, macos, windows
from lightfield_gs.displays.edid import parse_edid
from lightfield_gs.displays.screens import Screen

PORTRAIT = edid("LKG-P00671", "P00671")
XRANDR = """Screen 0: minimum 320 x 200, current 3456 x 2048, maximum 16384 x 16384
HDMI-1 connected 1536x2048+1920+0 (0x48) {turn}(normal left inverted right x axis y axis) 120mm x 160mm
\tIdentifier: 0x42
\tTransform:  1.000000 0.000000 0.000000
\tEDID:
{edid}
\tnon-desktop: 0
  {mode} (0x48) 200.000MHz +HSync *current +preferred
        h: width  1536 start 1586 end 1606 total 1646
  1024x768 (0x49) 65.000MHz -HSync -VSync
DP-2 connected primary 1920x1080+0+0 (0x50) normal (normal left inverted right x axis y axis) 527mm x 296mm
  1920x1080 (0x50) 148.500MHz *current
DP-3 disconnected (normal left inverted right x axis y axis)
VGA-1 connected (normal left inverted right x axis y axis)
"""


def xrandr(mode="1536x2048", turn="normal ") -> str:
    rows = [f"\t\t{PORTRAIT[i : i + 16].hex()}" for i in range(0, 128, 16)]
    return XRANDR.format(edid="\n".join(rows), mode=mode, turn=turn)


def test_edid_tells_name_serial_and_size():
    told = parse_edid(PORTRAIT)
    assert (told.maker, told.name, told.serial) == ("LKG", "LKG-P00671", "P00671")
    assert (told.size_px, told.size_mm) == ((1536, 2048), (120, 160))
    damaged = bytes((*PORTRAIT[:60], PORTRAIT[60] ^ 1, *PORTRAIT[61:]))
    assert parse_edid(damaged) is parse_edid(b"") is parse_edid(PORTRAIT[:100]) is None


def test_screens_of_x():
    first, second, off = (one.screen for one in linux.parse_xrandr(xrandr(), "Xft.dpi:\t192\n"))
    assert first == Screen("HDMI-1", "LKG-P00671", "P00671", 1536, 2048, (1920, 0), 2.0, (120, 160))
    assert first.is_looking_glass and first.looking_glass_serial == "LKG-P00671"
    assert (second.name, second.position, second.scale) == ("", (0, 0), 2.0) and not second.is_looking_glass
    assert (off.connector, off.position) == ("VGA-1", None)
    turned = linux.parse_xrandr(xrandr("2048x1536", "left "))[0].screen
    assert (turned.width_px, turned.height_px, turned.scale) == (1536, 2048, 1.0)


def test_the_kernel_and_the_desktop_tell_of_each_screen_once(tmp_path):
    connector(tmp_path, "HDMI-A-2", PORTRAIT, "1536x2048", "800x600")  # another name, the same EDID
    connector(tmp_path, "DP-2", edid("WIDE", "", (3840, 2160), maker="DEL"), "3840x2160")  # XWayland tells no EDID
    connector(tmp_path, "DP-9", edid("LKG 8K", "LKG-L00012", (4095, 2160)), "7680x4320")  # no desktop on it
    connector(tmp_path, "DP-3", b"", status="disconnected")
    kernel = linux.read_connectors(tmp_path)
    screens = {one.connector: one for one in linux.merge_outputs(kernel, linux.parse_xrandr(xrandr()))}
    assert set(screens) == {"HDMI-1", "DP-2", "VGA-1", "DP-9"}
    assert screens["DP-2"].name == "WIDE" and (screens["DP-2"].width_px, screens["DP-2"].scale) == (3840, 2.0)
    assert screens["DP-9"].width_px == 7680 and screens["DP-9"].position is None


def test_screens_of_macos():
    told = {
        "SPDisplaysDataType": [
            {
                "_name": "Apple M3",
                "spdisplays_ndrvs": [
                    {
                        "_name": "Color LCD",
                        "_spdisplays_pixels": "3024 x 1964",
                        "_spdisplays_resolution": "1512 x 982 @ 120.00Hz",
                        "spdisplays_main": "spdisplays_yes",
                    },
                    {
                        "_name": "LKG-E01234",
                        "_spdisplays_pixels": "1440 x 2560",
                        "_spdisplays_resolution": "1440 x 2560 @ 60.00Hz",
                        "_spdisplays_display-serial-number": "4d2",
                    },
                ],
            },
            {"_name": "a card without screens"},
        ]
    }
    main, go = macos.parse_profile(json.dumps(told))
    assert (main.scale, main.position, main.width_px) == (2.0, (0, 0), 3024)
    assert (go.looking_glass_serial, go.scale, go.height_px) == ("LKG-E01234", 1.0, 2560)
    assert macos.parse_profile("") == macos.parse_profile("[]") == macos.parse_profile("{}") == []


class User32:
    """The functions of Windows, with two monitors of which the second is scaled to 150 %."""

    monitors = (("LKG01", (0, 0, 1536, 2048), 96), ("DEL40", (-2560, 0, 2560, 1440), 144))

    def EnumDisplayDevicesW(self, adapter, number, device, flags):
        device = device._obj
        assert device.cb == ctypes.sizeof(windows.DisplayDevice)
        number = number.value
        if adapter.value is None:
            device.DeviceName, device.StateFlags = f"\\\\.\\DISPLAY{number + 1}", 1 if number < 2 else 0
            return number < 3
        place = int(adapter.value[-1]) - 1
        device.DeviceID = f"\\\\?\\DISPLAY#{self.monitors[place][0]}#5&1a&0&UID{place}#{{e6f0}}"
        device.DeviceString, device.StateFlags = "Generic PnP Monitor", 1
        return number == 0

    def EnumDisplaySettingsW(self, name, which, mode):
        x, y, width, height = self.monitors[int(name.value[-1]) - 1][1]
        mode._obj.dmPosition, mode._obj.dmPelsWidth, mode._obj.dmPelsHeight = windows.Point(x, y), width, height
        return 1

    def __init__(self):
        def monitor_from_point(point, _):
            return 1 if point.x == 0 else 2

        self.MonitorFromPoint = monitor_from_point


class Shcore:
    def GetDpiForMonitor(self, monitor, _, across, down):
        across._obj.value = down._obj.value = User32.monitors[monitor.value - 1][2]
        return 0


def test_screens_of_windows():
    letter = ctypes.sizeof(ctypes.c_wchar)  # 2 bytes on Windows, where wingdi.h has sizes of 840 and 220
    sizes = [ctypes.sizeof(one) - letters * (letter - 2) for one, letters in ((windows.DisplayDevice, 416),)]
    sizes.append(ctypes.sizeof(windows.DeviceMode) - 64 * (letter - 2))
    assert sizes[0] == 840 and 220 <= sizes[1] <= 224  # the compiler may align what follows longer letters
    keys = []

    def read_edid(interface):
        keys.append(windows.registry_key(interface))
        return PORTRAIT if "LKG01" in interface else b""

    looking, other = windows.enumerate_screens(User32(), Shcore(), read_edid)
    assert looking == Screen("DISPLAY1", "LKG-P00671", "P00671", 1536, 2048, (0, 0), 1.0, (120, 160))
    assert (other.name, other.position, other.scale) == ("Generic PnP Monitor", (-2560, 0), 1.5)
    assert keys[0] == r"SYSTEM\CurrentControlSet\Enum\DISPLAY\LKG01\5&1a&0&UID0\Device Parameters"


@pytest.mark.skipif(shutil.which("Xvfb") is None or shutil.which("xrandr") is None, reason="no Xvfb, or no xrandr")
def test_a_virtual_screen_of_x(tmp_path, monkeypatch):
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1536x2048x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=(writing,), stderr=subprocess.DEVNULL) as server:
        try:
            os.close(writing)
            number = os.read(reading, 20).decode().strip()
            monkeypatch.setenv("DISPLAY", f":{number}")
            connector(tmp_path, "screen", PORTRAIT, "1536x2048")
            monkeypatch.setattr(linux, "_DRM", tmp_path)
            until, screens = time.monotonic() + 10, []
            while not screens or screens[0].position is None and time.monotonic() < until:
                screens = linux.read_screens()
        finally:
            server.terminate()
            os.close(reading)
    assert [one.looking_glass_serial for one in screens] == ["LKG-P00671"]
    assert (screens[0].position, screens[0].scale, screens[0].width_px) == ((0, 0), 1.0, 1536)
