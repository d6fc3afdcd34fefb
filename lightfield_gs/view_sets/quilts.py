"""The tiles of a quilt as views, and how a quilt's file says that it is divided."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.file_kinds import refuse_large_no_image
from lightfield_gs.io.images import as_floats
from lightfield_gs.io.pillow_images import pillow_errors
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels.quilt import QuiltLayout, check_divides, stated_layout
from lightfield_gs.view_sets.colours import in_colour
from lightfield_gs.view_sets.joins import rows_join_otherwise

_EXIF_TAGS, _USER_COMMENT = 0x8769, 0x9286
_COMMENT_CODES = {b"ASCII\0\0\0": "ascii", b"UNICODE\0": "utf-16", b"\0\0\0\0\0\0\0\0": "utf-8"}
_MOST_COMMENT_BYTES = 1 << 16
_PLAIN = 4 / 255  # between the samples of a tile up to which nothing is in it: JPEG makes them differ a little


class QuiltViews:
    """The tiles of a quilt [H, W, C] as views, the left-most camera's first.

    count: of views, where fewer than the tiles. top_first: rows go on downwards from the top. right_to_left: views
    begin with the right-most camera's. Raises InputError where the tiles do not divide the quilt.
    """

    def __init__(
        self,
        pixels: np.ndarray,
        layout: QuiltLayout,
        where: str,
        background: Sequence[float] = (0, 0, 0),
        *,
        count: int | None = None,
        top_first: bool = False,
        right_to_left: bool = False,
    ):
        height, width = pixels.shape[:2]
        if width < layout.columns or height < layout.rows:
            raise InputError(f"{where}: {width} x {height} pixels are too few for {layout.columns} x {layout.rows}")
        self.layout = replace(layout, width_px=width, height_px=height)
        check_divides(self.layout, where)
        self.pixels, self.background = pixels, background
        self.count = count or layout.views
        self.top_first, self.right_to_left = top_first, right_to_left
        self.width_px, self.height_px = self.layout.tile_px()

    def view(self, number: int) -> np.ndarray:
        """[H, W, 3] of a view."""
        place = self.count - 1 - number if self.right_to_left else number
        return in_colour(self.pixels[self.layout.tile(place, self.top_first)], self.background)

    def leave_out_plain(self, where: str) -> None:
        """Leaves out the last tiles where these are plain and others are not, as of 45 views in 8 x 6 tiles; that is
        told (Assumption)."""
        plain = 0
        while plain < self.count // 2 and self._is_plain(self.count - 1 - plain):
            plain += 1
        if 0 < plain < self.count // 2:
            self.count -= plain
            columns, rows = self.layout.columns, self.layout.rows
            assume(
                f"{where} holds {self.count} views, for the last {plain} of its {columns} x {rows} tiles are plain "
                f"(else --tiles {columns}x{rows})"
            )

    def _is_plain(self, place: int) -> bool:
        tile = as_floats(self.pixels[self.layout.tile(place, self.top_first)])
        return bool((np.ptp(tile, (0, 1)) <= _PLAIN).all())

    def tell_of_joins(self, where: str) -> None:
        """Tells (Assumption) where the rows look as if they were taken in the wrong order."""
        columns, rows = self.layout.columns, self.count // self.layout.columns

        def tile(row: int, column: int) -> np.ndarray:
            return in_colour(self.pixels[self.layout.tile(row * columns + column, self.top_first)], self.background)

        if rows_join_otherwise(tile, columns, rows):
            way = "leave --top-first out" if self.top_first else "give --top-first"
            onwards = "downwards from the top" if self.top_first else "upwards from the bottom"
            assume(
                f"the rows of {where} go on {onwards}, "
                f"though views then jump from row to row; if things jump as the eye moves, {way}, and --right-to-left "
                "if what is near seems far"
            )


Stated = tuple[QuiltLayout, bool, int]  # layout; whether the aspect is known; number of views


def layout_of_file(path: Path, tiles: tuple[int, int] | None) -> Stated | None:
    """What --tiles, the name of a quilt, or its Exif says of it; None where nothing does. Raises InputError.

    Exif has it as Looking Glass' programs wrote it: a UserComment in JSON with LKGColumns, LKGRows, LKGAspect and
    LKGNumViews.
    """
    try:
        named = stated_layout(path)
    except InputError:
        if tiles is None:
            raise
        named = None  # which --tiles is there to mend
    if tiles is not None:
        layout = QuiltLayout(*tiles, 1.0 if named is None else named.aspect)
        return layout, named is not None, layout.views
    comment = _of_comment(path)
    if named is None or comment is None:
        return comment if named is None else (named, True, named.views)
    if (comment[0].columns, comment[0].rows) != (named.columns, named.rows):
        assume(
            f"{path} has {named.columns} x {named.rows} views as its name says, though its Exif says "
            f"{comment[0].columns} x {comment[0].rows} (else --tiles)"
        )
    return named, True, named.views


def _of_comment(path: Path) -> Stated | None:
    """What the Exif of a quilt says. Raises InputError where it cannot be used."""
    said = _comment(path)
    if not {"LKGColumns", "LKGRows"} <= said.keys():
        return None
    try:
        numbers = {
            key: float(said[key]) for key in said if key in ("LKGColumns", "LKGRows", "LKGAspect", "LKGNumViews")
        }
        layout = QuiltLayout(
            int(numbers["LKGColumns"]), int(numbers["LKGRows"]), round(numbers.get("LKGAspect", 1.0), 4)
        )
        count = int(numbers.get("LKGNumViews", layout.views))
    except (InputError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: its Exif cannot be used ({error}); give --tiles COLUMNSxROWS") from None
    return layout, "LKGAspect" in numbers, count if 2 <= count <= layout.views else layout.views


def _comment(path: Path) -> dict[str, Any]:
    """The object that the Exif UserComment of a file holds in JSON; empty where there is none."""
    from PIL import Image

    comment: object = b""
    # Other readers see to files that are no images
    with contextlib.suppress(InputError), pillow_errors(str(path)):
        refuse_large_no_image(path)
        with Image.open(path) as image:
            comment = image.getexif().get_ifd(_EXIF_TAGS).get(_USER_COMMENT, b"")
    if isinstance(comment, str):
        comment = comment.encode(errors="replace")
    if not isinstance(comment, bytes) or len(comment) > _MOST_COMMENT_BYTES:
        return {}
    code = _COMMENT_CODES.get(comment[:8])
    text = comment if code is None else comment[8:]
    if code == "utf-16" and text[:1] == b"\0":  # of "{", in files of the other byte order
        code = "utf-16-be"
    try:
        data = parse_json(text.decode(code or "utf-8", errors="replace").strip("\0 \r\n"))
    except ValueError:
        return {}
    return data if isinstance(data, dict) else {}
