"""Open a set of views: a quilt, a folder or a movie; quilts are divided by their file name or Exif."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.file_kinds import refuse_large_non_image, refuse_video
from lightfield_gs.io.images import Picture, as_floats
from lightfield_gs.io.pillow_images import pillow_errors
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels.panel import MAX_VIEWS
from lightfield_gs.panels.quilt import QuiltLayout, check_divides, stated_layout
from lightfield_gs.view_sets.folder import FileViews, folder_views
from lightfield_gs.view_sets.movies import FrameRange, FrameViews, Movie, is_movie
from lightfield_gs.view_sets.pixels import ViewColours, in_colour, rows_are_reversed

_EXIF_TAGS, _USER_COMMENT = 0x8769, 0x9286
_COMMENT_CODES = {b"ASCII\0\0\0": "ascii", b"UNICODE\0": "utf-16", b"\0\0\0\0\0\0\0\0": "utf-8"}
_MOST_COMMENT_BYTES = 1 << 16
_PLAIN = 4 / 255  # largest range of a plain tile's samples: JPEG makes them differ a little


class QuiltViews:
    """The tiles of a quilt as views, the left-most camera's first.

    Args:
        pixels: [H, W, C].
        layout: columns, rows and aspect.
        where: the file, for messages.
        background: behind pixels with alpha.
        count: number of views, where some tiles are empty.
        top_first: whether rows go on downwards from the top.
        right_to_left: whether the first view is the right-most camera's.

    Raises:
        InputError: where the tiles do not divide the quilt.
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
        """Return a view, [H, W, 3]."""
        tile_number = self.count - 1 - number if self.right_to_left else number
        return in_colour(self.pixels[self.layout.tile(tile_number, self.top_first)], self.background)

    def leave_out_plain(self, where: str) -> None:
        """Leave out the last tiles where these alone are plain, as of 45 views in 8 x 6 tiles, with a note."""
        plain = 0
        while plain < self.count // 2 and self._is_plain(self.count - 1 - plain):
            plain += 1
        if 0 < plain < self.count // 2:
            self.count -= plain
            columns, rows = self.layout.columns, self.layout.rows
            assume(
                f"{where} holds {self.count} views, for the last {plain} of its {columns} x {rows} tiles are plain "
                f"(else tiles={columns}x{rows})"
            )

    def _is_plain(self, tile_number: int) -> bool:
        tile = as_floats(self.pixels[self.layout.tile(tile_number, self.top_first)])
        return bool((np.ptp(tile, (0, 1)) <= _PLAIN).all())

    def note_row_order(self, where: str) -> None:
        """Note rows that look as if they were in the wrong order."""
        columns, rows = self.layout.columns, self.count // self.layout.columns

        def tile(row: int, column: int) -> np.ndarray:
            return in_colour(self.pixels[self.layout.tile(row * columns + column, self.top_first)], self.background)

        if rows_are_reversed(tile, columns, rows):
            way = "leave top_first= out" if self.top_first else "give top_first=True"
            onwards = "downwards from the top" if self.top_first else "upwards from the bottom"
            assume(
                f"the rows of {where} go on {onwards}, "
                f"though views then jump from row to row; if things jump as the eye moves, {way}, and "
                "right_to_left=True if what is near seems far"
            )


FileLayout = tuple[QuiltLayout, bool, int]  # layout; whether the aspect is known; number of views


def read_quilt_layout(path: Path, tiles: tuple[int, int] | None) -> FileLayout | None:
    """Return the layout of a quilt by `tiles`, its file name, or its Exif; None where nothing tells it.

    Looking Glass' programs wrote a UserComment in JSON with LKGColumns, LKGRows, LKGAspect and LKGNumViews. Raises
    InputError.
    """
    try:
        named = stated_layout(path)
    except InputError:
        if tiles is None:
            raise
        named = None  # `tiles` overrides the name
    if tiles is not None:
        layout = QuiltLayout(*tiles, 1.0 if named is None else named.aspect)
        return layout, named is not None, layout.views
    comment = _exif_layout(path)
    if named is None or comment is None:
        return comment if named is None else (named, True, named.views)
    if (comment[0].columns, comment[0].rows) != (named.columns, named.rows):
        assume(
            f"{path} has {named.columns} x {named.rows} views as its name says, though its Exif says "
            f"{comment[0].columns} x {comment[0].rows} (else tiles=)"
        )
    return named, True, named.views


def _exif_layout(path: Path) -> FileLayout | None:
    """Return the layout in the Exif of a quilt. Raises InputError where it cannot be used."""
    tags = _comment(path)
    if not {"LKGColumns", "LKGRows"} <= tags.keys():
        return None
    try:
        names = {"LKGColumns", "LKGRows", "LKGAspect", "LKGNumViews"} & tags.keys()
        numbers = {key: float(tags[key]) for key in names}
        columns, rows = int(numbers["LKGColumns"]), int(numbers["LKGRows"])
        layout = QuiltLayout(columns, rows, round(numbers.get("LKGAspect", 1.0), 4))
        count = int(numbers.get("LKGNumViews", layout.views))
    except (InputError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: its Exif cannot be used ({error}); give tiles=COLUMNSxROWS") from None
    return layout, "LKGAspect" in numbers, count if 2 <= count <= layout.views else layout.views


def _comment(path: Path) -> dict[str, Any]:
    """Return the object in the Exif UserComment of a file, JSON; empty where there is none."""
    from PIL import Image

    comment: object = b""
    # Other readers report files that are no images
    with contextlib.suppress(InputError), pillow_errors(str(path)):
        refuse_large_non_image(path)
        with Image.open(path) as image:
            comment = image.getexif().get_ifd(_EXIF_TAGS).get(_USER_COMMENT, b"")
    if isinstance(comment, str):
        comment = comment.encode(errors="replace")
    if not isinstance(comment, bytes) or len(comment) > _MOST_COMMENT_BYTES:
        return {}
    code = _COMMENT_CODES.get(comment[:8])
    text = comment if code is None else comment[8:]
    if code == "utf-16" and text[:1] == b"\0":  # "{" in the other byte order
        code = "utf-16-be"
    try:
        data = parse_json(text.decode(code or "utf-8", errors="replace").strip("\0 \r\n"))
    except ValueError:
        return {}
    return data if isinstance(data, dict) else {}


@dataclass(frozen=True)
class ViewSet:
    """Views, the left-most camera's first.

    Attributes:
        views: the views.
        aspect: width by height of a displayed view; None where nothing tells it.
        description: description of the files found.
        colours: the conversion of their colours.
    """

    views: QuiltViews | FileViews | FrameViews
    aspect: float | None
    description: str
    colours: ViewColours


class QuiltMovie:
    """The frames of a movie of quilts.

    Attributes:
        layout: of each quilt.
        aspect: see ViewSet.
        fps: frames a second; None where the file does not tell.
        numbers: of the frames in the range.

    Raises:
        InputError: where the range has no frames.
    """

    def __init__(self, movie: Movie, stated: FileLayout, span: FrameRange, colours: ViewColours, **order: bool):
        self.layout, is_known, self._count = stated
        self.aspect = self.layout.aspect if is_known else None
        self.numbers = span.numbers(movie.count)
        if not self.numbers:
            raise InputError(f"{movie.path}: span= takes none of its {movie.count} frames")
        self.fps = None if movie.fps is None else movie.fps / span.step
        self.description = f"a movie of {len(self.numbers)} quilts of {self.layout.columns} x {self.layout.rows} views"
        self.colours, self._movie = colours, movie
        self._order: dict[str, Any] = order

    def frames(self) -> Iterator[QuiltViews]:
        """Yield the views of each frame; note frames that are missing at the end. Raises InputError."""
        made, path = 0, self._movie.path
        for _, pixels in self._movie.frames(self.numbers):
            picture = self.colours.convert(Picture(pixels), path)
            yield QuiltViews(picture, self.layout, str(path), count=self._count, **self._order)
            made += 1
        if not made:
            raise InputError(f"{path}: none of its frames can be read; it is cut")
        if made < len(self.numbers):
            assume(
                f"{path} ends before its frame {self.numbers[made]} of {self._movie.count}: it is cut, or its header "
                "counts what is not shown"
            )


def open_views(
    path: str | Path,
    tiles: tuple[int, int] | None = None,
    *,
    row: int | None = None,
    top_first: bool = False,
    right_to_left: bool = False,
    span: FrameRange | None = None,
    background: Sequence[float] = (0, 0, 0),
    keeps_linear: bool = False,
) -> ViewSet | QuiltMovie:
    """Open the views of a quilt, a folder, or a movie: of quilts, or with a frame for each view.

    Assumptions are noted.

    Args:
        path: the file or folder.
        tiles: columns and rows of a quilt, in place of the file's own, or of the cameras of a folder.
        row: the row of a grid of cameras, 0 the top one; None: the middle one.
        top_first: whether rows of a quilt go on downwards from the top.
        right_to_left: whether the first view is the right-most camera's.
        span: the frames of a movie; each is a view, unless it is a movie of quilts.
        background: red, green and blue in 0..1 behind images with alpha.
        keeps_linear: see ViewColours.

    Raises:
        InputError: also for missing views, and views of several sizes.
    """
    path, colours = checked_path(path), ViewColours(background, keeps_linear)
    if path.is_dir():
        if top_first or span is not None:
            raise InputError(f"{path}: top_first= is about quilts and span= about movies, and this is a folder")
        return _read_folder(path, colours, tiles, row, right_to_left)
    if row is not None:
        raise InputError(f"{path}: row= is about the cameras of a folder, and this is a file; leave it out")
    if is_movie(path):
        return _read_movie(path, colours, tiles, span, top_first=top_first, right_to_left=right_to_left)
    if span is not None:
        refuse_video(path)
        raise InputError(
            f"{path}: span= is about videos and animations, and by its name and its start this is none; leave it "
            "out, or rename or convert it to .mp4, or give its pictures as files in a folder"
        )
    return _read_quilt(path, colours, tiles, top_first, right_to_left)


def _read_folder(
    path: Path, colours: ViewColours, tiles: tuple[int, int] | None, row: int | None, right_to_left: bool
) -> ViewSet:
    paths, description = folder_views(path, colours, tiles, row, right_to_left)
    if len(paths) < 2 or len(paths) > MAX_VIEWS:
        raise InputError(f"{path}: expected 2..{MAX_VIEWS} views, got {len(paths)}")
    views = FileViews(paths, colours)
    aspect = views.width_px / views.height_px
    return ViewSet(views, aspect, f"{description}, from {paths[0].name} to {paths[-1].name}", colours)


def _read_quilt(
    path: Path, colours: ViewColours, tiles: tuple[int, int] | None, top_first: bool, right_to_left: bool
) -> ViewSet:
    pixels = colours.read(path)
    stated = read_quilt_layout(path, tiles)
    if stated is None:
        raise InputError(
            f"{path}: its name does not say how it is divided; give tiles=COLUMNSxROWS, or rename it to "
            f"{path.stem}_qs<columns>x<rows>a<aspect>{path.suffix}"
        )
    layout, is_known, count = stated
    views = QuiltViews(pixels, layout, str(path), count=count, top_first=top_first, right_to_left=right_to_left)
    if tiles is None:
        views.leave_out_plain(str(path))
    views.note_row_order(str(path))
    used = "" if views.count == layout.views else f", {views.count} used"
    description = f"a quilt of {layout.columns} x {layout.rows} views{used}"
    if any(left := views.layout.left_over_px()):
        side = "bottom" if top_first else "top"
        description += f", {left[0]} pixels at the right and {left[1]} at the {side} left over"
    return ViewSet(views, layout.aspect if is_known else None, description, colours)


def _read_movie(
    path: Path, colours: ViewColours, tiles: tuple[int, int] | None, span: FrameRange | None, **order: bool
) -> ViewSet | QuiltMovie:
    stated = read_quilt_layout(path, tiles)
    movie = Movie(path, in_time=stated is not None)  # frames that are no quilts are views, and come once each
    if stated is not None:
        return QuiltMovie(movie, stated, span or FrameRange(), colours, **order)
    if span is None:
        raise InputError(
            f"{path}: has {movie.count} frames, and nothing says what they are; where each is a view, as the camera "
            f"slides to the right, give span=FIRST:LAST:STEP, such as 0:{movie.count - 1}; where each is a quilt, "
            f"tiles=COLUMNSxROWS, or rename it to {path.stem}_qs<columns>x<rows>a<aspect>{path.suffix}"
        )
    if order["top_first"]:
        raise InputError(f"{path}: top_first= is about quilts, and its frames are views; leave it out")
    views = FrameViews(movie, span, colours, order["right_to_left"])
    description = f"{views.count} frames as views, from {views.first_frame} to {views.last_frame}"
    return ViewSet(views, views.width_px / views.height_px, description, colours)
