"""Quilts: all views of a light field as the tiles of one picture, as Looking Glass has them.

The name says how it is divided: NAME_qs<columns>x<rows>a<aspect>.png. View 0, of the left-most camera, lies at the
bottom left. Views go on to the right, then up (Looking Glass, "Quilts", docs.lookingglassfactory.com).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import check_fields, checked_field, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import MAX_PIXELS, MAX_SIDE_PX
from lightfield_gs.panels.display_kinds import DISPLAY_KINDS
from lightfield_gs.panels.panel import MAX_VIEWS, Panel
from lightfield_gs.panels.rig import Rig

_SUFFIX = re.compile(r"_qs(\d{1,5})x(\d{1,5})a(\d{1,3}(?:\.\d{1,12})?|\.\d{1,12})$", re.IGNORECASE)
_LIKE_A_SUFFIX = re.compile(r"_qs\d", re.IGNORECASE)


@dataclass(frozen=True)
class QuiltLayout:
    """The tiles of a quilt.

    The pixels left over at the right and at the top belong to no tile.

    Attributes:
        columns: Columns of tiles, 1 or more.
        rows: Rows of tiles, 1 or more.
        aspect: Width by height of a view as it is seen, 0.01..100; the pixels of a tile need not be square.
        width_px: Width of the whole quilt, or None where not known.
        height_px: Height of the whole quilt, or None where not known.

    Raises:
        InputError: A value is out of its range.
    """

    columns: int = checked_field(whole_number, 1, MAX_VIEWS)
    rows: int = checked_field(whole_number, 1, MAX_VIEWS)
    aspect: float = checked_field(real_number, 0.01, 100)
    width_px: int | None = None
    height_px: int | None = None

    def __post_init__(self) -> None:
        check_fields(self, "quilt: ")
        if self.views > MAX_VIEWS:
            raise InputError(f"quilt: expected at most {MAX_VIEWS} views, got {self.columns} x {self.rows}")
        if self.width_px is None or self.height_px is None:
            return
        for key, least in (("width_px", self.columns), ("height_px", self.rows)):
            whole_number(f"quilt: {key}", getattr(self, key), least, MAX_SIDE_PX)
        if self.width_px * self.height_px > MAX_PIXELS:
            raise InputError(
                f"quilt: {self.width_px} x {self.height_px} pixels are more than {MAX_PIXELS}; give a smaller size"
            )

    @property
    def views(self) -> int:
        return self.columns * self.rows

    @property
    def suffix(self) -> str:
        """Return the suffix of a file name, for example "_qs8x6a0.75"."""
        return f"_qs{self.columns}x{self.rows}a{self.aspect:.5g}"

    def tile_px(self) -> tuple[int, int]:
        """Return width and height of a tile in pixels; raise InputError where the quilt's size is unknown."""
        if self.width_px is None or self.height_px is None:
            raise InputError("quilt: its size in pixels is not known; give one")
        return self.width_px // self.columns, self.height_px // self.rows

    def left_over_px(self) -> tuple[int, int]:
        """Return the pixels at the right and at the top that belong to no tile."""
        width, height = self.tile_px()
        return (self.width_px or 0) - width * self.columns, (self.height_px or 0) - height * self.rows

    def tile(self, view: int, top_first: bool = False) -> tuple[slice, slice]:
        """Return rows and columns of the pixels of a view.

        Args:
            view: Counts from the left-most camera.
            top_first: Whether rows of views go downwards from the top edge.
        """
        (width, height), whole = self.tile_px(), self.height_px or 0
        onwards, along = divmod(view, self.columns)
        bottom = (onwards + 1) * height if top_first else whole - onwards * height
        return slice(bottom - height, bottom), slice(along * width, (along + 1) * width)

    def panel(self, cone_deg: float, like: Panel | None = None) -> Panel:
        """Return a panel for framing: it has the quilt's views and their aspect, and is as high as a tile.

        Args:
            cone_deg: Full angle of the fan.
            like: The panel with the size and the viewing distance of the picture.
        """
        _, height = self.tile_px()
        width = max(1, round(height * self.aspect))
        pitch = None
        if like is not None and like.pixel_pitch_mm is not None:
            pitch = like.pixel_pitch_mm * like.height_px / height
        return Panel(
            width_px=width,
            height_px=height,
            views=self.views,
            line_number=3.0 * self.views,
            slant_tan=0.0,
            cone_deg=cone_deg,
            viewing_distance_mm=like.viewing_distance_mm if like is not None else None,
            pixel_pitch_mm=pitch,
            name="quilt",
        )

    def fitted(self, panel: Panel, rig: Rig) -> tuple[Panel, Rig]:
        """Return the panel of `panel` and a rig for it, at the pixels of a tile, which need not be square."""
        width, height = self.tile_px()
        across, down = width / panel.width_px, height / panel.height_px
        (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
        rig = replace(rig, focal_px=(fx * across, fy * down), principal_point_px=(cx * across, cy * down))
        return replace(panel, width_px=width, height_px=height), rig


# By the displays' usual names; all values may be overridden. Some sizes leave a few pixels over that belong to no tile.
QUILT_PRESETS = {
    name: QuiltLayout(columns, rows, kind.aspect, width, height)
    for kind in DISPLAY_KINDS.values()
    for name, (columns, rows, width, height) in kind.quilts.items()
}


_MOST_SIDE_PX = 8192  # of a panel's quilt; tiles are reduced to fit
_LEFT_OVER = 0.01  # fraction of a quilt's width and height that may belong to no tile, in excess of whole pixels
_LEAST_RESOLUTION = 0.5  # of a square quilt's, below which another number of views is taken; chosen by hand


def panel_quilt(panel: Panel, tiles: tuple[int, int] | None = None) -> QuiltLayout:
    """Return a quilt with the views of a panel, as square as the number of views allows.

    Each tile has the panel's size, reduced where the quilt would be wider or higher than 8192 pixels. A quilt has
    columns x rows views. A prime number of views allows only narrow strips, 1 x N. If such tiles have less than half
    the resolution, the quilt has the next number of views that does better: displays and `weave` take quilts of any
    number and mix neighbouring views. An Assumption tells so.

    Args:
        panel: The panel.
        tiles: Columns and rows of tiles; None: as above.
    """
    if tiles is not None:
        return _layout(panel, *tiles)
    best = _squarest_layout(panel, panel.views)
    found, views = best, panel.views
    least = _LEAST_RESOLUTION * min(1.0, _MOST_SIDE_PX / math.sqrt(panel.views * panel.width_px * panel.height_px))
    while _scale(panel, found.columns, found.rows) < least and views < MAX_VIEWS:
        views += 1
        found = _squarest_layout(panel, views)
    if views > panel.views:
        assume(
            f"a quilt of {found.columns} x {found.rows} = {views} views for the {panel.views} of panel {panel.name}, "
            f"of which {best.columns} x {best.rows} would leave tiles of {best.tile_px()[0]} x {best.tile_px()[1]} "
            f"pixels (to have those: tiles={best.columns}x{best.rows})"
        )
    return found


def _squarest_layout(panel: Panel, views: int) -> QuiltLayout:
    """Return the most square layout of a number of views."""
    width, height = panel.width_px, panel.height_px
    ways = [(count, views // count) for count in range(1, views + 1) if views % count == 0]
    return _layout(panel, *min(ways, key=lambda way: abs(math.log(way[0] * width / (way[1] * height)))))


def _layout(panel: Panel, columns: int, rows: int) -> QuiltLayout:
    """Return a layout of a number of tiles, as large as fit."""
    scale = _scale(panel, columns, rows)
    size = [
        count * max(1, math.floor(scale * side)) for count, side in ((columns, panel.width_px), (rows, panel.height_px))
    ]
    return QuiltLayout(columns, rows, panel.width_px / panel.height_px, *size)


def _scale(panel: Panel, columns: int, rows: int) -> float:
    """Return the size of the largest tiles relative to the panel."""
    return min(1.0, _MOST_SIDE_PX / (columns * panel.width_px), _MOST_SIDE_PX / (rows * panel.height_px))


def stated_layout(path: str | Path) -> QuiltLayout | None:
    """Return the layout in the name of a quilt; None where the name has none.

    Raises:
        InputError: The name cannot be read.
    """
    stem = _stem(Path(path))
    if (found := _SUFFIX.search(stem)) is None:
        if _LIKE_A_SUFFIX.search(stem):
            raise InputError(
                f"{path}: expected a name that ends in _qs<columns>x<rows>a<aspect>, such as _qs8x6a0.75, before the "
                "extension; rename it"
            )
        return None
    try:
        return QuiltLayout(int(found[1]), int(found[2]), float(found[3]))
    except InputError as error:
        raise InputError(f"{path}: its name cannot be used: {error}") from None


def with_suffix(path: str | Path, layout: QuiltLayout) -> Path:
    """Return the path with the suffix of the layout before its extension (.png by default), unless it has one.

    Raises:
        InputError: The path has the suffix of another layout.
    """
    path = Path(path)
    stated = stated_layout(path)
    if stated is None:
        return path.with_name(f"{path.stem}{layout.suffix}{path.suffix or '.png'}")
    same = (stated.columns, stated.rows) == (layout.columns, layout.rows)
    if not same or not math.isclose(stated.aspect, layout.aspect, rel_tol=0.02):
        raise InputError(
            f"{path}: its name says {stated.suffix}, and the quilt is {layout.suffix}; rename it, or leave "
            "the suffix out"
        )
    return path.with_name(f"{path.name}.png") if _stem(path) == path.name else path


def _stem(path: Path) -> str:
    """Return the name without its extension; all of NAME_qs8x6a0.75, because .75 belongs to the aspect."""
    return path.name if path.suffix[1:].isdecimal() else path.stem


def check_divides(layout: QuiltLayout, where: str) -> None:
    """Raise InputError where the tiles leave more than the odd pixels of the presets over."""
    width, height = layout.tile_px()
    size = layout.width_px or 0, layout.height_px or 0
    if all(left < max(1, _LEFT_OVER * side) for left, side in zip(layout.left_over_px(), size)):
        return
    way = f"expected for example {width * layout.columns} x {height * layout.rows}"
    if size[0] % layout.rows == size[1] % layout.columns == 0:
        way = f"they do into {layout.rows} x {layout.columns}: is that what is meant?"
    raise InputError(
        f"{where}: {size[0]} x {size[1]} pixels do not divide into {layout.columns} x {layout.rows} tiles of one size; "
        f"{way}"
    )
