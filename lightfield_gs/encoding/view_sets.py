"""Sets of views in files, the left-most camera's first: quilts, and folders with a picture for each view.

Folders: a row of pictures, numbered or in the order of their names; the 4D Light Field Benchmark of HCI (Honauer et
al. 2016: parameters.cfg, input_Cam000.png and on, row by row from the top left); the light fields of the Stanford
gantry (out_RR_CC_*.png: row and column). Of the latter two, one row is taken.
"""

from __future__ import annotations

import configparser
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.io.text_file import read_text
from lightfield_gs.panels.panel import MAX_VIEWS
from lightfield_gs.panels.quilt import QuiltLayout, check_divides, stated_layout

_PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".bmp", ".heic", ".avif")
_HCI = re.compile(r"input_cam(\d{1,5})", re.IGNORECASE)
_STANFORD = re.compile(r"out_(\d{1,4})_(\d{1,4})(_.*)?", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(.*?)(\d{1,9})(\D*)", re.DOTALL)
_CONFIG_BYTES = 1 << 16


class QuiltViews:
    """The tiles of a quilt [H, W, C] as views. Raises InputError where they do not divide it."""

    def __init__(self, pixels: np.ndarray, layout: QuiltLayout, where: str, background: Sequence[float] = (0, 0, 0)):
        height, width = pixels.shape[:2]
        if width < layout.columns or height < layout.rows:
            raise InputError(f"{where}: {width} x {height} pixels are too few for {layout.columns} x {layout.rows}")
        self.layout = replace(layout, width_px=width, height_px=height)
        check_divides(self.layout, where)
        self.pixels, self.background = pixels, background
        self.count = layout.views
        self.width_px, self.height_px = self.layout.tile_px()

    def view(self, number: int) -> np.ndarray:
        return in_colour(self.pixels[self.layout.tile(number)], self.background)


class FileViews:
    """A file for each view, read when it is wanted. Raises InputError where they are of several sizes or kinds."""

    def __init__(self, paths: Sequence[Path], background: Sequence[float] = (0, 0, 0)):
        self.paths, self.background, self.count = list(paths), background, len(paths)
        first = read_image(self.paths[0], as_stored=True)
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
        pixels = read_image(self.paths[number], as_stored=True)
        if pixels.dtype != self._type:
            raise InputError(
                f"{self.paths[number]}: expected {self._type} samples as {self.paths[0].name} has, got {pixels.dtype}"
            )
        return in_colour(pixels, self.background)


@dataclass(frozen=True)
class ViewSet:
    """Views, the left-most camera's first; aspect: width by height of one as it is seen; said: what was found."""

    views: QuiltViews | FileViews
    aspect: float
    said: str


def open_views(
    path: str | Path,
    layout: QuiltLayout | None = None,
    *,
    row: int | None = None,
    right_to_left: bool = False,
    background: Sequence[float] = (0, 0, 0),
) -> ViewSet:
    """The views of a quilt or a folder.

    layout: of a quilt, in place of what its name says. row: which of a light field's rows of cameras, 0 the top one
    (None: the middle one). right_to_left: the files of a folder begin with the right-most camera's. background: behind
    pictures with alpha. Raises InputError, also for views that are missing or of several sizes.
    """
    path = checked_path(path)
    if not path.is_dir():
        if row is not None or right_to_left:
            raise InputError(f"{path}: the row and the order of cameras are those of a folder, and this is a file")
        return _of_quilt(path, layout, background)
    if layout is not None:
        raise InputError(f"{path}: tiles are those of a quilt, and this is a folder")
    paths, said = _files(path, row)
    if right_to_left:
        paths = paths[::-1]
    if len(paths) < 2 or len(paths) > MAX_VIEWS:
        raise InputError(f"{path}: expected 2..{MAX_VIEWS} views, got {len(paths)}")
    views = FileViews(paths, background)
    return ViewSet(views, views.width_px / views.height_px, f"{said}, from {paths[0].name} to {paths[-1].name}")


def _of_quilt(path: Path, layout: QuiltLayout | None, background: Sequence[float]) -> ViewSet:
    layout = layout or stated_layout(path)
    if layout is None:
        raise InputError(
            f"{path}: its name does not say how it is divided; give --tiles COLUMNSxROWS, or rename it to "
            f"{path.stem}_qs<columns>x<rows>a<aspect>{path.suffix}"
        )
    views = QuiltViews(read_image(path, as_stored=True), layout, str(path), background)
    return ViewSet(views, layout.aspect, f"a quilt of {layout.columns} x {layout.rows} views")


def in_colour(pixels: np.ndarray, background: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """[H, W, 3] of pixels [H, W, C] of the same type: grey in three channels, alpha (2 or 4 channels) blended."""
    channels = pixels.shape[2]
    colour = pixels[..., :3] if channels >= 3 else np.repeat(pixels[..., :1], 3, 2)
    if channels not in (2, 4):
        return np.ascontiguousarray(colour)
    most = np.float32(1 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max)
    alpha = pixels[..., -1:] / most
    if bool((alpha == 1).all()):
        return np.ascontiguousarray(colour)
    blended = colour * alpha + (1 - alpha) * (np.asarray(background, np.float32) * most)
    return (blended if pixels.dtype == np.float32 else np.rint(blended)).astype(pixels.dtype)


def _files(folder: Path, row: int | None) -> tuple[list[Path], str]:
    try:
        names = sorted(entry.name for entry in os.scandir(folder) if entry.is_file())
    except OSError as error:
        raise InputError(f"cannot read {folder}: {error.strerror or error}") from error
    pictures = [folder / name for name in names if name.lower().endswith(_PICTURES) and not name.startswith(".")]
    if not pictures:
        raise InputError(f"{folder}: expected a picture for each view, found none")
    if grid := _hci(folder, names, pictures):
        return _row_of(folder, grid, row, "an HCI light field")
    if grid := _stanford(pictures):
        assume(f"views of {folder} go from left to right with their column (else --right-to-left)")
        return _row_of(folder, grid, row, "a Stanford light field")
    if row is not None:
        raise InputError(f"{folder}: a row is one of a light field (HCI, Stanford), and these are views in one row")
    return _numbered(folder, pictures), f"{len(pictures)} views"


Grid = dict[tuple[int, int], Path]  # (row, column) of cameras -> picture


def _hci(folder: Path, names: list[str], pictures: list[Path]) -> Grid | None:
    found = {int(match[1]): path for path in pictures if (match := _HCI.fullmatch(path.stem))}
    if not found:
        return None
    across, down = _hci_size(folder / "parameters.cfg") if "parameters.cfg" in names else (9, 9)
    return {divmod(number, across): path for number, path in found.items() if number < across * down}


def _hci_size(path: Path) -> tuple[int, int]:
    """Cameras across and down. Raises InputError."""
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
    places = [((int(match[1]), int(match[2])), path) for match, path in matches if match]
    twice = [place for place, times in Counter(place for place, _ in places).items() if times > 1]
    if twice:
        raise InputError(f"{pictures[0].parent}: row {twice[0][0]}, column {twice[0][1]} comes more than once")
    return dict(places)


def _row_of(folder: Path, grid: Grid, row: int | None, kind: str) -> tuple[list[Path], str]:
    """The pictures of one row by column. Raises InputError where one is missing."""
    rows = sorted({place[0] for place in grid})
    chosen = rows[len(rows) // 2] if row is None else row
    if chosen not in rows:
        raise InputError(f"{folder}: expected a row of {rows[0]}..{rows[-1]}, got {chosen}")
    columns = {place[1] for place in grid}
    first, last = min(columns), max(columns)
    for column in range(first, last + 1):
        if (chosen, column) not in grid:
            raise InputError(f"{folder}: the view of row {chosen}, column {column} is missing; give all of a row")
    paths = [grid[chosen, column] for column in range(first, last + 1)]
    return paths, f"{kind}, row {chosen} of {len(rows)}, {len(paths)} views"


def _numbered(folder: Path, pictures: list[Path]) -> list[Path]:
    """By the last number in their names, where names differ in that alone; else by name. Raises InputError where a
    number is missing."""
    matches = [_LAST_NUMBER.fullmatch(path.stem) for path in pictures]
    parts = [(match[1], match[3]) for match in matches if match]
    if len(parts) < len(pictures) or len(set(parts)) > 1:
        return pictures
    by_number = {int(match[2]): path for match, path in zip(matches, pictures) if match}
    if len(by_number) < len(pictures):
        raise InputError(f"{folder}: expected each view once, some numbers come more than once")
    first, last = min(by_number), max(by_number)
    if last - first + 1 > len(by_number):
        missing = next(number for number in range(first, last) if number not in by_number)
        raise InputError(
            f"{folder}: views are numbered {first}..{last}, and {missing} is missing; add it, or number them anew"
        )
    return [by_number[number] for number in range(first, last + 1)]
