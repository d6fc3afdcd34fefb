"""Quilts: all views of a light field as the tiles of one picture, as Looking Glass has them.

The name says how it is divided: NAME_qs<columns>x<rows>a<aspect>.png. View 0 is that of the left-most camera and lies
at the bottom left; views go on to the right, then up (Looking Glass, "Quilts", docs.lookingglassfactory.com).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import MAX_PIXELS, MAX_SIDE_PX
from lightfield_gs.panels.panel import MAX_VIEWS, Panel
from lightfield_gs.panels.rig import Rig

_SUFFIX = re.compile(r"_qs(\d{1,5})x(\d{1,5})a(\d{1,3}(?:\.\d{1,12})?|\.\d{1,12})$", re.IGNORECASE)
_LIKE_A_SUFFIX = re.compile(r"_qs\d", re.IGNORECASE)


@dataclass(frozen=True)
class QuiltLayout:
    """How a quilt is divided. Raises InputError for values out of their ranges.

    columns, rows: of tiles, whole, 1 or more. aspect: width by height of a view as it is seen, 0.01..100; the pixels of
    a tile need not be square. width_px, height_px: of the whole quilt, or None where not known. What is left at the
    right and at the top where they do not divide belongs to no tile.
    """

    columns: int
    rows: int
    aspect: float
    width_px: int | None = None
    height_px: int | None = None

    def __post_init__(self) -> None:
        for key in ("columns", "rows"):
            object.__setattr__(self, key, whole_number(f"quilt: {key}", getattr(self, key), 1, MAX_VIEWS))
        if self.views > MAX_VIEWS:
            raise InputError(f"quilt: expected at most {MAX_VIEWS} views, got {self.columns} x {self.rows}")
        object.__setattr__(self, "aspect", real_number("quilt: aspect", self.aspect, 0.01, 100))
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
        """For example "_qs8x6a0.75"."""
        return f"_qs{self.columns}x{self.rows}a{self.aspect:.5g}"

    def tile_px(self) -> tuple[int, int]:
        """Width and height of a tile, pixels of the quilt. Raises InputError where the quilt's size is not known."""
        if self.width_px is None or self.height_px is None:
            raise InputError("quilt: its size in pixels is not known; give one")
        return self.width_px // self.columns, self.height_px // self.rows

    def left_over_px(self) -> tuple[int, int]:
        """Pixels at the right and at the top that belong to no tile."""
        width, height = self.tile_px()
        return (self.width_px or 0) - width * self.columns, (self.height_px or 0) - height * self.rows

    def tile(self, view: int, top_first: bool = False) -> tuple[slice, slice]:
        """Rows and columns of the pixels of a view, which counts from the left-most camera. top_first: rows of views
        go on downwards from the top edge."""
        (width, height), whole = self.tile_px(), self.height_px or 0
        onwards, along = divmod(view, self.columns)
        bottom = (onwards + 1) * height if top_first else whole - onwards * height
        return slice(bottom - height, bottom), slice(along * width, (along + 1) * width)

    def panel(self, cone_deg: float, like: Panel | None = None) -> Panel:
        """A panel whose views are those of the quilt, as high as a tile and of the views' aspect, for framing.

        cone_deg: full angle of the fan. like: the panel that says how large the picture is and from where it is seen.
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
        """What `panel` returned and a rig for it, at the pixels of a tile, which need not be square."""
        width, height = self.tile_px()
        across, down = width / panel.width_px, height / panel.height_px
        (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
        rig = replace(rig, focal_px=(fx * across, fy * down), principal_point_px=(cx * across, cy * down))
        return replace(panel, width_px=width, height_px=height), rig


# What Looking Glass renders for its displays, by the names that owners know them by; all may be overridden. The sizes
# of the 16 and 65 inch leave one or two pixels over that belong to no tile.
QUILT_PRESETS = {
    "portrait": QuiltLayout(8, 6, 0.75, 3360, 3360),
    "go": QuiltLayout(11, 6, 0.5625, 4092, 4092),
    "16": QuiltLayout(5, 9, 16 / 9, 4096, 4096),
    "16-gen3": QuiltLayout(7, 7, 16 / 9, 5999, 5999),
    "32": QuiltLayout(7, 7, 16 / 9, 8190, 8190),
    "65": QuiltLayout(8, 9, 16 / 9, 8192, 8192),
}


_MOST_SIDE_PX = 8192  # of the quilt of a panel, where tiles of the panel's own size would make it larger
_LEFT_OVER = 0.01  # of a quilt's width and height, less of which may belong to no tile
_LEAST_SHARE = 0.5  # of the resolution that a square quilt would have, below which other numbers of views are taken


def panel_quilt(panel: Panel, tiles: tuple[int, int] | None = None) -> QuiltLayout:
    """A quilt with the views of a panel, or so many columns and rows of `tiles`: each of the panel's size, or smaller
    where the quilt would then be wider or higher than 8192 pixels; as square as the number of views allows.

    A quilt has columns x rows views. Where the panel's number allows but narrow strips (a prime one, 1 x N), whose
    tiles would have less than half the resolution, the quilt has the next number of views that does better: displays
    and `weave` take quilts of any number and mix neighbouring views. That is told (Assumption).
    """
    if tiles is not None:
        return _with_tiles(panel, *tiles)
    best = _squarest(panel, panel.views)
    found, views = best, panel.views
    least = _LEAST_SHARE * min(1.0, _MOST_SIDE_PX / math.sqrt(panel.views * panel.width_px * panel.height_px))
    while _scale(panel, found.columns, found.rows) < least and views < MAX_VIEWS:
        views += 1
        found = _squarest(panel, views)
    if views > panel.views:
        assume(
            f"a quilt of {found.columns} x {found.rows} = {views} views for the {panel.views} of panel {panel.name}, "
            f"of which {best.columns} x {best.rows} would leave tiles of {best.tile_px()[0]} x {best.tile_px()[1]} "
            f"pixels (to have those: --tiles {best.columns}x{best.rows})"
        )
    return found


def _squarest(panel: Panel, views: int) -> QuiltLayout:
    """The layout of so many views that is the most square."""
    width, height = panel.width_px, panel.height_px
    ways = [(count, views // count) for count in range(1, views + 1) if views % count == 0]
    return _with_tiles(panel, *min(ways, key=lambda way: abs(math.log(way[0] * width / (way[1] * height)))))


def _with_tiles(panel: Panel, columns: int, rows: int) -> QuiltLayout:
    scale = _scale(panel, columns, rows)
    size = [
        count * max(1, math.floor(scale * side)) for count, side in ((columns, panel.width_px), (rows, panel.height_px))
    ]
    return QuiltLayout(columns, rows, panel.width_px / panel.height_px, *size)


def _scale(panel: Panel, columns: int, rows: int) -> float:
    """How large tiles can be, against the panel."""
    return min(1.0, _MOST_SIDE_PX / (columns * panel.width_px), _MOST_SIDE_PX / (rows * panel.height_px))


def stated_layout(path: str | Path) -> QuiltLayout | None:
    """What the name of a quilt says of it; None where it says nothing. Raises InputError where it cannot be read."""
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
    """The path with the suffix of the layout before its extension (.png where it has none), unless it has one.

    Raises InputError where it has that of another layout.
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
    """The name without its extension; of NAME_qs8x6a0.75 all of it: .75 is the aspect's."""
    return path.name if path.suffix[1:].isdecimal() else path.stem


def check_divides(layout: QuiltLayout, where: str) -> None:
    """Raises InputError where the tiles leave more of the quilt over than whole pixels make them, as in presets."""
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
