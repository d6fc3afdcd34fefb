"""How the views of a quilt lie beside each other, and the name that says so.

Looking Glass: `<name>_qs<columns>x<rows>a<aspect>`, view 0 is the left-most camera and the tile at the bottom left;
then to the right, then up. The aspect is that of a view, width / height.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from lightfield_gs.base.errors import InputError

_NAME = re.compile(r"_qs(\d{1,3})x(\d{1,3})a(\d+(?:\.\d+)?)$")
_MOST_SIDE_PX = 4096  # of a quilt where no size is said: more than that many decoders of H.264 do not take


@dataclass(frozen=True)
class QuiltTiles:
    """columns, rows: of tiles; tile_px: (width, height) of a view in pixels; aspect: of a view as it is seen."""

    columns: int
    rows: int
    tile_px: tuple[int, int]
    aspect: float

    @staticmethod
    def fitted(columns: int, rows: int, aspect: float, size_px: tuple[int, int] | None = None) -> QuiltTiles:
        """Tiles of a quilt of this size, which it fills, but for the pixels left over by whole tiles; None: views of
        this aspect, as large as fit into 4096 x 4096. Quilts have even sides, as 4:2:0 needs. Raises InputError."""
        if size_px is None:
            width = min(_MOST_SIDE_PX // columns, int(_MOST_SIDE_PX // rows * aspect))
            tile = width, round(width / aspect)
        else:
            tile = size_px[0] // columns, size_px[1] // rows
        tile = (tile[0] - (tile[0] * columns) % 2, tile[1] - (tile[1] * rows) % 2)
        if min(tile) < 1:
            raise InputError(f"a quilt of {columns} x {rows} views has no room in {size_px} pixels; make it larger")
        return QuiltTiles(columns, rows, tile, aspect)

    @property
    def views(self) -> int:
        """Number of views."""
        return self.columns * self.rows

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of the quilt."""
        return self.columns * self.tile_px[0], self.rows * self.tile_px[1]

    @property
    def suffix(self) -> str:
        """What the name of the file ends with, before its extension."""
        return f"_qs{self.columns}x{self.rows}a{self.aspect:.6g}"

    def named(self, path: Path) -> Path:
        """The path with the suffix, in place of another one."""
        return path.with_name(_NAME.sub("", path.stem) + self.suffix + path.suffix)

    def joined(self, views: Tensor) -> Tensor:
        """The quilt [H, W, 3] of views [columns * rows, h, w, 3], left-most camera first."""
        height, width = views.shape[1:3]
        grid = views.view(self.rows, self.columns, height, width, 3).flip(0)
        return grid.permute(0, 2, 1, 3, 4).reshape(self.rows * height, self.columns * width, 3)


def stated_tiles(path: str | Path) -> tuple[int, int, float] | None:
    """(columns, rows, aspect) that the name of a quilt states; None where it states none."""
    name = _NAME.search(Path(path).stem)
    if name is None or not (int(name[1]) and int(name[2]) and float(name[3])):
        return None
    return int(name[1]), int(name[2]), float(name[3])
