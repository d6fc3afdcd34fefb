"""Which views a path holds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.images import Picture
from lightfield_gs.io.not_what_it_says import refuse_video
from lightfield_gs.panels.panel import MAX_VIEWS
from lightfield_gs.view_sets.colours import ViewColours
from lightfield_gs.view_sets.folder import FileViews, folder_views
from lightfield_gs.view_sets.frames import FrameViews, Movie, Span, is_movie
from lightfield_gs.view_sets.quilts import QuiltViews, Stated, layout_of_file


@dataclass(frozen=True)
class ViewSet:
    """Views, the left-most camera's first. aspect: width by height of one as it is seen, None where nothing says it.
    description: what was found. colours: what was done to their colours."""

    views: QuiltViews | FileViews | FrameViews
    aspect: float | None
    description: str
    colours: ViewColours


class QuiltMovie:
    """The frames of a movie of quilts. aspect: as ViewSet's. fps: frames a second, None where not said. numbers: of the
    frames that are taken. Raises InputError."""

    def __init__(
        self, movie: Movie, stated: Stated, span: Span, colours: ViewColours, top_first: bool, right_to_left: bool
    ):
        self.layout, is_known, self._count = stated
        self.aspect = self.layout.aspect if is_known else None
        self.numbers = span.numbers(movie.count)
        if not self.numbers:
            raise InputError(f"{movie.path}: --frames takes none of its {movie.count} frames")
        self.fps = None if movie.fps is None else movie.fps / span.step
        self.description = f"a movie of {len(self.numbers)} quilts of {self.layout.columns} x {self.layout.rows} views"
        self.colours, self._movie = colours, movie
        self._top_first, self._right_to_left = top_first, right_to_left

    def frames(self) -> Iterator[QuiltViews]:
        """The views of each frame; fewer frames than the file says are told (Assumption). Raises InputError."""
        made = 0
        for _, pixels in self._movie.frames(self.numbers):
            picture = self.colours.of(Picture(pixels), self._movie.path)
            yield QuiltViews(
                picture,
                self.layout,
                str(self._movie.path),
                count=self._count,
                top_first=self._top_first,
                right_to_left=self._right_to_left,
            )
            made += 1
        if not made:
            raise InputError(f"{self._movie.path}: none of its frames can be read; it is cut")
        if made < len(self.numbers):
            assume(
                f"{self._movie.path} ends before its frame {self.numbers[made]} of {self._movie.count}: it is cut, or "
                "its header counts what is not shown"
            )


def open_views(
    path: str | Path,
    tiles: tuple[int, int] | None = None,
    *,
    row: int | None = None,
    top_first: bool = False,
    right_to_left: bool = False,
    span: Span | None = None,
    background: Sequence[float] = (0, 0, 0),
    keeps_linear: bool = False,
) -> ViewSet | QuiltMovie:
    """The views of a quilt, a folder, or a movie: of quilts, or with a frame for each view.

    tiles: columns and rows of a quilt, in place of what its file says, or of the cameras of a folder. row: which of a
    grid's rows of cameras, 0 the top one (None: the middle one). top_first: rows of a quilt go on downwards from the
    top. right_to_left: the views begin with the right-most camera's. span: of a movie, the frames that are taken, each
    a view where it is no movie of quilts. background: behind pictures with alpha. keeps_linear: see ViewColours.
    What is assumed is told (Assumption). Raises InputError, also for views that are missing or of several sizes.
    """
    path, colours = checked_path(path), ViewColours(background, keeps_linear)
    if path.is_dir():
        if top_first or span is not None:
            raise InputError(f"{path}: --top-first is about quilts and --frames about movies, and this is a folder")
        return _of_folder(path, colours, tiles, row, right_to_left)
    if row is not None:
        raise InputError(f"{path}: --row is about the cameras of a folder, and this is a file; leave it out")
    if is_movie(path):
        return _of_movie(path, colours, tiles, span, top_first, right_to_left)
    if span is not None:
        refuse_video(path)
        raise InputError(
            f"{path}: --frames is about videos and animations, and by its name and its start this is none; leave it "
            "out, or rename or convert it to .mp4, or give its pictures as files in a folder"
        )
    return _of_quilt(path, colours, tiles, top_first, right_to_left)


def _of_folder(
    path: Path, colours: ViewColours, tiles: tuple[int, int] | None, row: int | None, right_to_left: bool
) -> ViewSet:
    paths, description = folder_views(path, colours, tiles, row, right_to_left)
    if len(paths) < 2 or len(paths) > MAX_VIEWS:
        raise InputError(f"{path}: expected 2..{MAX_VIEWS} views, got {len(paths)}")
    views = FileViews(paths, colours)
    aspect = views.width_px / views.height_px
    return ViewSet(views, aspect, f"{description}, from {paths[0].name} to {paths[-1].name}", colours)


def _of_quilt(
    path: Path, colours: ViewColours, tiles: tuple[int, int] | None, top_first: bool, right_to_left: bool
) -> ViewSet:
    pixels = colours.read(path)
    stated = layout_of_file(path, tiles)
    if stated is None:
        raise InputError(
            f"{path}: its name does not say how it is divided; give --tiles COLUMNSxROWS, or rename it to "
            f"{path.stem}_qs<columns>x<rows>a<aspect>{path.suffix}"
        )
    layout, is_known, count = stated
    views = QuiltViews(pixels, layout, str(path), count=count, top_first=top_first, right_to_left=right_to_left)
    if tiles is None:
        views.leave_out_plain(str(path))
    views.tell_of_joins(str(path))
    used = "" if views.count == layout.views else f", {views.count} used"
    description = f"a quilt of {layout.columns} x {layout.rows} views{used}"
    if any(left := views.layout.left_over_px()):
        description += (
            f", {left[0]} pixels at the right and {left[1]} at the {'bottom' if top_first else 'top'} left over"
        )
    return ViewSet(views, layout.aspect if is_known else None, description, colours)


def _of_movie(
    path: Path,
    colours: ViewColours,
    tiles: tuple[int, int] | None,
    span: Span | None,
    top_first: bool,
    right_to_left: bool,
) -> ViewSet | QuiltMovie:
    stated = layout_of_file(path, tiles)
    movie = Movie(path, in_time=stated is not None)  # what is no quilt is a view, and each comes once
    if stated is not None:
        return QuiltMovie(movie, stated, span or Span(), colours, top_first, right_to_left)
    if span is None:
        raise InputError(
            f"{path}: has {movie.count} frames, and nothing says what they are; where each is a view, as the camera "
            f"slides to the right, give --frames FIRST:LAST:STEP, such as 0:{movie.count - 1}; where each is a quilt, "
            f"--tiles COLUMNSxROWS, or rename it to {path.stem}_qs<columns>x<rows>a<aspect>{path.suffix}"
        )
    if top_first:
        raise InputError(f"{path}: --top-first is about quilts, and its frames are views; leave it out")
    views = FrameViews(movie, span, colours, right_to_left)
    description = f"{views.count} frames as views, from {views.first_frame} to {views.last_frame}"
    return ViewSet(views, views.width_px / views.height_px, description, colours)
