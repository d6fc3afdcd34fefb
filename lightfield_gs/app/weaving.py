"""Weaving: views of a quilt, a folder or a movie become the image of a panel, or a folder or a video of images."""

from __future__ import annotations

import json
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import package_versions, software
from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.cli_messages import Stopwatch, note, say
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Compression, Device, Views
from lightfield_gs.io.atomic import sha256
from lightfield_gs.panels.panel import Panel
from lightfield_gs.view_sets.movies import FrameRange
from lightfield_gs.view_sets.pixels import ViewColours
from lightfield_gs.view_sets.view_set import QuiltMovie

if TYPE_CHECKING:
    import numpy as np

_SAME_ASPECT = 1.03  # ratio of the aspects of tiles and panel up to which the tiles' pixels are taken for square
_DEFAULT_FPS = Fraction(30)


@dataclass(frozen=True, slots=True)
class WeaveOptions:
    """Views that become the image of a panel.

    Attributes:
        input: a quilt, a folder of views, or a movie.
        output: the image, or a folder or a video of images.
        panel: see there.
        tiles: columns and rows of a quilt, or of the cameras of a folder.
        aspect: width by height of a view as it is seen.
        row: of a light field.
        top_first, right_to_left: order of the views.
        frames: those taken of a movie.
        view_map: file with the view of each sub-pixel, in place of the lens.
        interpolation, views, view_filter, fit, crop, shift, background: see `lightfield_gs.weave`.
        device: where the views are woven.
        compression: of the file.
        overwrite: whether to remove frames of another job that are in the folder.
        stats: whether to print the times of the stages.
    """

    input: Path
    output: Path
    panel: PanelOptions
    tiles: tuple[int, int] | None = None
    aspect: float | None = None
    row: int | None = None
    top_first: bool = False
    right_to_left: bool = False
    frames: FrameRange | None = None
    view_map: Path | None = None
    interpolation: str = "linear"
    views: Views = "integer"
    view_filter: float = 0.0
    fit: str = "cover"
    crop: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    shift: float = 0.0
    background: tuple[float, ...] = (0.0, 0.0, 0.0)
    device: Device = "auto"
    compression: Compression = "fast"
    overwrite: bool = False
    stats: bool = False


def weave_arguments(
    options: WeaveOptions, panel: Panel, views: Any, aspect: float | None, view_map: np.ndarray | None = None
) -> dict[str, Any]:
    """Return the arguments of `encoding.weave.weave`.

    Args:
        options: what is asked for.
        panel: the panel that shows the views.
        views: their pixels.
        aspect: of a view. None: unknown; then tiles of another aspect than the panel's are assumed to have that one.
        view_map: the view of each sub-pixel.
    """
    return {
        "interpolation": options.interpolation,
        "place": options.views,
        "view_filter": options.view_filter,
        "view_map": view_map,
        "aspect": options.aspect or aspect or _assumed_aspect(options.input, panel, views),
        "fit": options.fit,
        "crop": options.crop,
        "shift": options.shift,
        "background": options.background,
        "device": choose_device(options.device),
    }


def _assumed_aspect(path: Path, panel: Panel, views: Any) -> float:
    pixels, own = views.width_px / views.height_px, panel.width_px / panel.height_px
    if max(pixels, own) <= _SAME_ASPECT * min(pixels, own):
        return pixels
    assume(
        f"the views of {path}, tiles of {views.width_px} x {views.height_px} pixels, are as wide as the panel, "
        f"{own:.4g} times their height (else --aspect {pixels:.4g}, or what it is)"
    )
    return own


def interpolation_words(options: WeaveOptions, views: Any, panel: Panel) -> str:
    """Describe how the views are mapped to the panel's views."""
    has_map = options.view_map is not None
    ratio = 1 if has_map else views.count / panel.views
    counts = f"{views.count} views for the panel's {panel.views}"
    if options.view_filter * ratio > 1:
        return f"{counts}: means over {options.view_filter:g} views of the panel"
    if has_map or views.count == panel.views and options.views == "integer":
        return "every sub-pixel is that of one view"
    return f"{counts}: {options.interpolation} between them"


def say_colours(colours: ViewColours) -> None:
    """Print how the colours of the views were converted, and note what may be wrong with them."""
    if colours.messages:
        say(f"colours: {'; '.join(colours.messages)}")
    for words in colours.notes:
        note(words)


def weave_metadata(options: WeaveOptions, panel: Panel, count: int) -> dict[str, str]:
    """Return the input, the settings and the versions of an image; all but "software" and "input" are JSON."""
    return {
        "software": software(),
        "input": options.input.name,
        "panel": json.dumps(panel.to_dict()),
        "encoding": json.dumps(_settings(options, count)),
        "versions": json.dumps(package_versions()),
    }


def _settings(options: WeaveOptions, count: int) -> dict[str, Any]:
    return {
        "method": "weave",
        "source_views": count,
        "interpolation": options.interpolation,
        "views": options.views,
        **({"view_filter": options.view_filter} if options.view_filter else {}),
        "fit": options.fit,
        "crop": list(options.crop),
        "shift": options.shift,
    }


def weave_movie(options: WeaveOptions, panel: Panel, movie: QuiltMovie, watch: Stopwatch) -> None:
    """Weave each frame of a movie of quilts, into a folder of PNG files or a lossless video. Raises InputError."""
    from tqdm import tqdm

    from lightfield_gs.encoding.weave import weave

    if options.view_map is not None:
        raise InputError("--view-map is for one picture, and this is a movie of quilts; leave it out")
    sink, words, made = _sink(options, panel, movie), "", 0
    watch.lap("load")
    wanted = set(sink.missing)
    with sink, tqdm(total=len(movie.numbers), unit="frame", dynamic_ncols=True, disable=None) as bar:
        for number, views in enumerate(movie.frames()):
            if number in wanted:
                arguments = weave_arguments(options, panel, views, movie.aspect)
                sink.put(number, sink.fetch(weave(views, panel, **arguments)))
            words = f"{views.width_px} x {views.height_px} pixels each; {interpolation_words(options, views, panel)}"
            made += 1
            bar.update()
    watch.lap("frames")
    there = len(movie.numbers) - len(sink.missing)
    kept = f", of which {there} were there" if there else ""
    size = f"{panel.width_px} x {panel.height_px}"
    print(f"{options.output}: {made} frames of {size}{kept}, {float(_fps(movie)):g} a second")
    watch.say_if(options.stats)
    say(f"{options.input}: {movie.description}, {words}")
    say_colours(movie.colours)


def _fps(movie: QuiltMovie) -> Fraction:
    return movie.fps or _DEFAULT_FPS


def _sink(options: WeaveOptions, panel: Panel, movie: QuiltMovie) -> Any:
    """Return the video or the folder that the frames go to. Raises InputError."""
    count, output = len(movie.numbers), options.output
    if output.suffix and not output.is_dir():
        from lightfield_gs.video.video_file import VideoFile, choose_codec

        codec = choose_codec(output, "native", None)
        return VideoFile(output, count, (panel.width_px, panel.height_px), _fps(movie), codec)
    from lightfield_gs.video.frame_folder import FrameFolder

    layout = movie.layout
    job = {
        "software": software(),
        "input": options.input.name,
        "pictures": sha256(options.input),
        "panel": panel.to_dict(),
        "quilt": [layout.columns, layout.rows, options.aspect or movie.aspect],
        "order": [options.top_first, options.right_to_left],
        "frames": [movie.numbers.start, movie.numbers.stop, movie.numbers.step],
        "background": list(options.background),
        "compression": options.compression,
        "device": choose_device(options.device),
        **_settings(options, layout.views),
    }
    return FrameFolder(
        output,
        count,
        job,
        fps=float(_fps(movie)),
        metadata=lambda number: {**weave_metadata(options, panel, layout.views), "frame": str(number)},
        compression=options.compression,
        overwrite=options.overwrite,
    )
