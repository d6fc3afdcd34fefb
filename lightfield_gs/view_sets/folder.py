"""Folders with a picture for each view, and one row of a light field.

Layouts:
    A row of pictures, by the number that varies in their names.
    Grids, named by row and column.
    The 4D Light Field Benchmark of HCI (Honauer et al. 2016): parameters.cfg, input_Cam000.png and on, row by row
        from the top left.
    Light fields of the Stanford gantry: out_RR_CC_*.png, row and column.
"""

from __future__ import annotations

import configparser
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import read_text
from lightfield_gs.view_sets.file_names import Grid, arrange, without_maps
from lightfield_gs.view_sets.pixels import ViewColours, looks_like_rows

_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".bmp", ".heic", ".avif")
_HCI = re.compile(r"input_cam(\d{1,5})", re.IGNORECASE)
_STANFORD = re.compile(r"out_(\d{1,4})_(\d{1,4})(_.*)?", re.IGNORECASE)
_CONFIG_BYTES = 1 << 16
_HCI_SIDE = 9  # cameras a side of the benchmark's light fields
_MOST_NAMED = 3
_LEAST_SIDE = 3  # of an unnamed grid
Tiles = tuple[int, int]


class FileViews:
    """A file for each view, read on demand. Raises InputError where they are of several sizes or kinds."""

    def __init__(self, paths: Sequence[Path], colours: ViewColours):
        self.paths, self.colours, self.count = list(paths), colours, len(paths)
        first = colours.read(self.paths[0])
        self.height_px, self.width_px = first.shape[:2]
        self._type = first.dtype
        for path in self.paths[1:]:
            info = read_info(path)
            size = (info.width_px, info.height_px)
            if size[:: -1 if info.orientation > 4 else 1] != (self.width_px, self.height_px):
                raise InputError(
                    f"{path}: expected {self.width_px} x {self.height_px} pixels as {self.paths[0].name} has, got "
                    f"{size[0]} x {size[1]}; give views of one size"
                )

    def view(self, number: int) -> np.ndarray:
        """Read a view, [H, W, 3]. Raises InputError."""
        pixels = self.colours.read(self.paths[number])
        if pixels.dtype != self._type:
            raise InputError(
                f"{self.paths[number]}: expected {self._type} samples as {self.paths[0].name} has, got {pixels.dtype}"
            )
        return pixels


def folder_views(
    folder: Path, colours: ViewColours, tiles: Tiles | None, row: int | None, right_to_left: bool
) -> tuple[list[Path], str]:
    """Return the files of a folder's views, the left-most camera's first, and a description.

    Assumptions are noted.

    Args:
        folder: the folder.
        colours: reads views, to compare them.
        tiles: columns and rows of cameras, whose pictures go row by row from the top left.
        row: of the grid; None: the middle one.
        right_to_left: whether the first view is the right-most camera's.

    Raises:
        InputError: for folders without pictures, and with missing views.
    """
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        names = [entry.name for entry in entries if entry.is_file()]
    except OSError as error:
        raise InputError(f"cannot read {folder}: {error.strerror or error}") from error
    pictures = [folder / name for name in names if name.lower().endswith(_PICTURES) and not name.startswith(".")]
    if not pictures:
        inner = [entry.name for entry in entries if entry.is_dir() and not entry.name.startswith(".")][:_MOST_NAMED]
        way = f"; give the folder in it that has them ({', '.join(inner)})" if inner else f" ({', '.join(_PICTURES)})"
        raise InputError(f"{folder}: expected a picture for each view, found none{way}")
    paths, description = _find_files(folder, names, pictures, colours, tiles, row)
    return paths[:: -1 if right_to_left else 1], description


def _find_files(
    folder: Path, names: list[str], pictures: list[Path], colours: ViewColours, tiles: Tiles | None, row: int | None
) -> tuple[list[Path], str]:
    if grid := _hci(folder, names, pictures, tiles):
        return _grid_row(folder, grid, row, "an HCI light field")
    if grid := _stanford(pictures):
        assume(f"views of {folder} go from left to right with their column (else right_to_left=True)")
        return _grid_row(folder, grid, row, "a Stanford light field")
    found = arrange(folder, without_maps(folder, pictures))
    if isinstance(found, dict) and tiles is None:
        return _grid_row(folder, found, row, "a grid of views")
    paths = [found[position] for position in sorted(found)] if isinstance(found, dict) else found
    columns, why = _count_columns(folder, paths, colours, tiles, row)
    if columns == len(paths):
        return paths, f"{len(paths)} views"
    if tiles is None:
        assume(
            f"the {len(paths)} pictures of {folder} are a grid of {columns} x {columns} cameras, row by row from the "
            f"top left, {why} (else tiles={len(paths)}x1)"
        )
    return _grid_row(folder, {divmod(k, columns): path for k, path in enumerate(paths)}, row, "a grid of views")


def _count_columns(
    folder: Path, paths: list[Path], colours: ViewColours, tiles: Tiles | None, row: int | None
) -> tuple[int, str]:
    """Return how many cameras stand in each row, where names do not tell, and why. Raises InputError."""
    count, side = len(paths), math.isqrt(len(paths))
    if tiles is not None:
        if tiles[0] * tiles[1] != count:
            raise InputError(f"{folder}: expected {tiles[0]} x {tiles[1]} pictures as tiles= says, got {count}")
        return tiles[0], ""
    is_square = side * side == count and side >= _LEAST_SIDE
    if row is not None:
        if not is_square:
            raise InputError(
                f"{folder}: a row is one of a grid of cameras, and nothing says that these {count} pictures are one; "
                "give tiles=COLUMNSxROWS, or leave row= out"
            )
        return side, "as row= asks for"
    if is_square and looks_like_rows(lambda k: colours.read(paths[k]), side):
        return side, "for the pictures jump from row to row"
    return count, ""


def _hci(folder: Path, names: list[str], pictures: list[Path], tiles: Tiles | None) -> Grid | None:
    found = {int(match[1]): path for path in pictures if (match := _HCI.fullmatch(path.stem))}
    if not found:
        return None
    across, down = tiles or _hci_size(folder, names, set(found))
    return {divmod(number, across): path for number, path in found.items() if number < across * down}


def _hci_size(folder: Path, names: list[str], numbers: set[int]) -> Tiles:
    """Return cameras across and down: by parameters.cfg, else of a square that all numbers fill, else the benchmark's.

    Raises InputError.
    """
    if "parameters.cfg" in names:
        return _configured(folder / "parameters.cfg")
    side = math.isqrt(len(numbers))
    if numbers != set(range(side * side)):
        side = _HCI_SIDE
    if max(numbers) >= side * side:
        raise InputError(
            f"{folder}: expected parameters.cfg, or a square number of pictures, got numbers up to {max(numbers)}; "
            "give tiles=COLUMNSxROWS"
        )
    assume(f"{folder} holds a light field of {side} x {side} cameras, for it has no parameters.cfg (else tiles=CxR)")
    return side, side


def _configured(path: Path) -> Tiles:
    """Return cameras across and down in a parameters.cfg. Raises InputError."""
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(read_text(path, _CONFIG_BYTES, "configuration"))
        across, down = (int(parser["extrinsics"][key]) for key in ("num_cams_x", "num_cams_y"))
        if not (1 <= across <= 999 and 1 <= down <= 999):
            raise ValueError(f"{across} x {down} cameras")
    except (configparser.Error, KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{path}: expected [extrinsics] with num_cams_x and num_cams_y ({reason})") from None
    return across, down


def _stanford(pictures: list[Path]) -> Grid | None:
    matches = [(_STANFORD.fullmatch(path.stem), path) for path in pictures]
    if not all(match for match, _ in matches):
        return None
    positions = [((int(match[1]), int(match[2])), path) for match, path in matches if match]
    twice = [position for position, times in Counter(position for position, _ in positions).items() if times > 1]
    if twice:
        raise InputError(f"{pictures[0].parent}: row {twice[0][0]}, column {twice[0][1]} comes more than once")
    return dict(positions)


def _grid_row(folder: Path, grid: Grid, row: int | None, kind: str) -> tuple[list[Path], str]:
    """Return the pictures of one row by column. Raises InputError where one is missing."""
    rows = sorted({position[0] for position in grid})
    chosen = rows[len(rows) // 2] if row is None else row
    if chosen not in rows:
        raise InputError(f"{folder}: expected a row of {rows[0]}..{rows[-1]}, got {chosen}")
    columns = {position[1] for position in grid}
    first, last = min(columns), max(columns)
    for column in range(first, last + 1):
        if (chosen, column) not in grid:
            raise InputError(f"{folder}: the view of row {chosen}, column {column} is missing; give all of a row")
    paths = [grid[chosen, column] for column in range(first, last + 1)]
    return paths, f"{kind}, row {chosen} of {len(rows)}, {len(paths)} views"
