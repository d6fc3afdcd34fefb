"""The displays of Looking Glass by name: sizes, typical lenses, quilts and usual viewing distances, in one table.

Sources, late 2026. Sizes and quilts: docs.lookingglassfactory.com, "Quilts"; the 27 inch: vtkLookingGlassInterface of
Kitware. The 16 inch: Bridge reports 8 x 6 at 7680 x 4320 for a real one, where the older page has 7 x 7. Serial numbers
and names of the hardware: Bridge.js and the Toolkit of Looking Glass, and programs that read them. Measured lenses:
calibrations of single displays in public programs; the other lenses are as many sub-pixels wide as that of the 16 inch.
Every display has a lens of its own, up to a whole lens aside: only its visual.json gives right views. Viewing
distances: chosen by hand, about an arm's length on a desk, and further for the largest.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

# Parts of an owner's words that tell no kind from another
_NO_NAME = re.compile(r"looking[ _-]?glass|lkg|landscape|(?<=\d)[ -]?in(?:ch)?\b")
_SAME_DPI = 0.1  # relative difference within which two displays of one size in pixels are alike


class TypicalLens(NamedTuple):
    """The lens of a kind of display: see looking_glass.panel_fields.

    Attributes:
        pitch, slope, center: As in a visual.json.
        cone_deg: Full angle of the views.
        is_measured: Whether it is a lens of this kind; else that of another kind, for want of one.
        has_cells: Whether it has the cells of the third generation.
    """

    pitch: float
    slope: float
    center: float
    cone_deg: float
    is_measured: bool = True
    has_cells: bool = False


@dataclass(frozen=True)
class DisplayKind:
    """A kind of display.

    Attributes:
        title: The maker's name.
        size_px: Width and height of the screen.
        dpi: Pixels an inch.
        lens: Its typical lens.
        viewing_distance_mm: Usual distance of the eyes.
        quilts: Columns, rows, width and height of its quilts by preset, the usual one first.
        serials: Beginnings of its serial numbers, after "LKG-".
        hardware: Names by which Bridge calls it.
    """

    title: str
    size_px: tuple[int, int]
    dpi: float
    lens: TypicalLens
    viewing_distance_mm: float
    quilts: dict[str, tuple[int, int, int, int]]
    serials: tuple[str, ...] = ()
    hardware: tuple[str, ...] = ()

    @property
    def aspect(self) -> float:
        """Width by height of the screen."""
        return self.size_px[0] / self.size_px[1]

    def fields(self, views: int) -> dict[str, Any]:
        """Return the fields of a Panel with the typical lens of this kind."""
        lens = self.lens
        calibration: dict[str, Any] = {
            "pitch": lens.pitch,
            "slope": lens.slope,
            "center": lens.center,
            "DPI": self.dpi,
            "screenW": self.size_px[0],
            "screenH": self.size_px[1],
            "viewCone": lens.cone_deg,
            "invView": 1,
        }
        if lens.has_cells:
            calibration |= {"subpixelCells": _CELLS, "CellPatternMode": 2}
        from lightfield_gs.panels.looking_glass import panel_fields  # slower to import than this table

        return {**panel_fields(calibration, views), "viewing_distance_mm": self.viewing_distance_mm}


_CELLS = [
    {"ROffsetX": -0.31, "ROffsetY": side, "GOffsetX": 0.28, "GOffsetY": side, "BOffsetX": 0, "BOffsetY": -side}
    for side in (0.25, -0.25)
]

DISPLAY_KINDS = {
    "portrait": DisplayKind(
        "Looking Glass Portrait",
        (1536, 2048),
        324,
        TypicalLens(52.5, -7.2, 0.4, 40),
        450,
        {"portrait": (8, 6, 3360, 3360)},
        ("P", "F"),
        ("portrait", "kiosk"),
    ),
    "go": DisplayKind(
        "Looking Glass Go",
        (1440, 2560),
        491,
        TypicalLens(80.745, -6.659, 0.477, 54),
        350,
        {"go": (11, 6, 4092, 4092)},
        ("E",),
        ("go_p",),
    ),
    "16": DisplayKind(
        'Looking Glass 16"',
        (3840, 2160),
        283,
        TypicalLens(44.7506, -6.8746, 0.169, 50, has_cells=True),
        600,
        {"16": (8, 6, 7680, 4320), "16-gen3": (7, 7, 5999, 5999), "16-gen2": (5, 9, 4096, 4096)},
        ("J", "A", "4K"),
        ("16_gen3_l", "4k_gen2"),
    ),
    "16-portrait": DisplayKind(
        'Looking Glass 16" (portrait)',
        (2160, 3840),
        283,
        TypicalLens(44.7506, -6.8746, 0.169, 50, is_measured=False),
        600,
        {"16-portrait": (11, 6, 5995, 6000)},
        ("H",),
        ("16_gen3_p",),
    ),
    "27": DisplayKind(
        'Looking Glass 27"',
        (5120, 2880),
        217.6,
        TypicalLens(34.41, -6.8746, 0.169, 50, is_measured=False, has_cells=True),
        800,
        {"27": (8, 6, 7680, 4320)},
        (),
        ("27_gen3_l",),
    ),
    "27-portrait": DisplayKind(
        'Looking Glass 27" (portrait)',
        (2880, 5120),
        217.6,
        TypicalLens(34.41, -6.8746, 0.169, 50, is_measured=False),
        800,
        {"27-portrait": (12, 4, 7680, 4320)},
        (),
        ("27_gen3_p",),
    ),
    "32": DisplayKind(
        'Looking Glass 32"',
        (7680, 4320),
        280,
        TypicalLens(44.28, -6.8746, 0.169, 50, is_measured=False, has_cells=True),
        900,
        {"32": (7, 7, 8190, 8190)},
        ("L", "B", "8K"),
        ("32_gen3_l", "8k_gen2"),
    ),
    "32-portrait": DisplayKind(
        'Looking Glass 32" (portrait)',
        (4320, 7680),
        280,
        TypicalLens(44.28, -6.8746, 0.169, 50, is_measured=False),
        900,
        {"32-portrait": (11, 6, 8184, 8184)},
        ("K",),
        ("32_gen3_p",),
    ),
    "65": DisplayKind(
        'Looking Glass 65"',
        (7680, 4320),
        136,
        TypicalLens(42, -6, 0.3, 40),
        2000,
        {"65": (8, 9, 8192, 8192)},
        ("D",),
        ("65", "65_gen2"),
    ),
}
# Presets of quilts, of all kinds
QUILT_NAMES = tuple(name for kind in DISPLAY_KINDS.values() for name in kind.quilts)


def kind_by_serial(serial: str) -> DisplayKind | None:
    """Return the kind of display of a serial number, such as LKG-E01234; None where it is not known."""
    rest = serial.strip().upper().removeprefix("LKG").lstrip("-_ ")
    found = [
        (len(start), kind.title, kind)
        for kind in DISPLAY_KINDS.values()
        for start in kind.serials
        if rest.startswith(start)
    ]
    return max(found)[2] if found else None


def kind_name(words: str) -> str | None:
    """Return the name in DISPLAY_KINDS that an owner's words mean, such as Looking Glass Go, 27 inch or LKG-E01234."""
    kind = kind_by_serial(words) if words.strip().upper().startswith("LKG") else None
    if kind is not None:
        return next(name for name, one in DISPLAY_KINDS.items() if one is kind)
    plain = _NO_NAME.sub(" ", words.lower())
    name = "-".join(re.findall(r"[a-z0-9]+", plain))
    return name if name in DISPLAY_KINDS else None


def kind_by_hardware(name: str) -> DisplayKind | None:
    """Return the kind of display that Bridge calls so; None where it is not known."""
    return next((kind for kind in DISPLAY_KINDS.values() if name.strip().lower() in kind.hardware), None)


def kind_by_size(width_px: int, height_px: int, dpi: float | None = None) -> DisplayKind | None:
    """Return the kind of display of a size in pixels.

    Args:
        width_px: Width of the screen.
        height_px: Height of the screen.
        dpi: Pixels an inch, which tell displays of one size apart. None: not known.

    Returns:
        None where no kind, or more than one, is of this size.
    """
    found = [
        kind
        for kind in DISPLAY_KINDS.values()
        if kind.size_px == (width_px, height_px) and (dpi is None or abs(dpi / kind.dpi - 1) < _SAME_DPI)
    ]
    return found[0] if len(found) == 1 else None
