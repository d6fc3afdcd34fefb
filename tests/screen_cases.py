"""Screens for tests of the displays: EDIDs, folders of the kernel, and calibrations, as real ones have them."""

import json
from pathlib import Path


def edid(name="", serial="", size_px=(1536, 2048), size_mm=(120, 160), maker="LKG") -> bytes:
    """A first block by VESA E-EDID 1.4, section 3."""
    block = bytearray(128)
    block[:8] = b"\x00\xff\xff\xff\xff\xff\xff\x00"
    letters = 0
    for letter in maker:
        letters = letters << 5 | ord(letter) - 64
    block[8:10] = letters.to_bytes(2, "big")
    block[18:20] = 1, 4
    (w, h), (a, b) = size_px, size_mm
    timing = bytearray(18)
    timing[:2] = 1, 1  # pixel clock
    timing[2], timing[4], timing[5], timing[7] = w & 255, w >> 8 << 4, h & 255, h >> 8 << 4
    timing[12], timing[13], timing[14] = a & 255, b & 255, a >> 8 << 4 | b >> 8
    block[54:72] = timing
    for start, tag, text in ((72, 0xFC, name), (90, 0xFF, serial)):
        block[start : start + 18] = bytes((0, 0, 0, tag if text else 0x10, 0)) + f"{text}\n".encode().ljust(13)[:13]
    block[127] = -sum(block) % 256
    return bytes(block)


def connector(root: Path, name: str, data: bytes, *modes: str, status="connected") -> None:
    """A folder of /sys/class/drm."""
    folder = root / f"card0-{name}"
    folder.mkdir(parents=True)
    (folder / "status").write_text(f"{status}\n")
    (folder / "edid").write_bytes(data)
    (folder / "modes").write_text("".join(f"{mode}\n" for mode in modes))


def calibration(serial="LKG-P00671", size=(1536, 2048), **others) -> dict:
    """A visual.json; a value may be plain or {"value": v}."""
    values = {"pitch": 52.5, "slope": -7.2, "center": 0.4, "DPI": 324, "viewCone": 40, "invView": 1, **others}
    return {
        "configVersion": "3.0",
        "serial": serial,
        **{key: {"value": value} for key, value in values.items()},
        "screenW": {"value": size[0]},
        "screenH": {"value": size[1]},
    }


def bridge_answer(*calibrations: dict, hardware="portrait") -> dict:
    """What Bridge tells of its displays: by Bridge.js, calibrations are JSON within strings."""
    return {
        str(number): {
            "type": "VARIANT_MAP",
            "value": {
                "calibration": {"name": "calibration", "value": json.dumps(one)},
                "hardwareVersion": {"value": hardware},
                "hwid": {"value": one["serial"]},
                "windowCoords": {"value": {"x": 1920, "y": 0}},
            },
        }
        for number, one in enumerate(calibrations)
    }
