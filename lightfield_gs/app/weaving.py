"""How the options of `lightfield-gs weave` become those of the weaving, for one picture and for movies of quilts."""

from __future__ import annotations

import argparse
import json
from fractions import Fraction
from typing import Any

from lightfield_gs.app.provenance import package_versions, software
from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.io.atomic import sha256
from lightfield_gs.panels.panel import Panel
from lightfield_gs.view_sets.pixels import ViewColours
from lightfield_gs.view_sets.view_set import QuiltMovie

_SAME_ASPECT = 1.03  # of tiles and panel, up to which the tiles' pixels are taken for square
_DEFAULT_FPS = Fraction(30)


def weaving_of(args: argparse.Namespace, panel: Panel, views, aspect: float | None, table=None) -> dict[str, Any]:
    """The options of `encoding.weave.weave`. aspect: of a view, None where nothing says it; then the panel's is taken
    for tiles of another one, which is told (Assumption)."""
    return {
        "interpolation": args.interpolation,
        "place": args.views,
        "view_filter": args.view_filter,
        "view_map": table,
        "aspect": args.aspect or aspect or _assumed_aspect(args, panel, views),
        "fit": args.fit,
        "crop": args.crop,
        "shift": args.shift,
        "background": args.background,
        "device": choose_device(args.device),
    }


def _assumed_aspect(args: argparse.Namespace, panel: Panel, views) -> float:
    pixels, own = views.width_px / views.height_px, panel.width_px / panel.height_px
    if max(pixels, own) <= _SAME_ASPECT * min(pixels, own):
        return pixels
    assume(
        f"the views of {args.input}, tiles of {views.width_px} x {views.height_px} pixels, are as wide as the panel, "
        f"{own:.4g} times their height (else --aspect {pixels:.4g}, or what it is)"
    )
    return own


def words_of(args: argparse.Namespace, views, panel: Panel) -> str:
    """How views became those of the panel."""
    exact = args.view_map is not None or views.count == panel.views and args.views == "integer"
    if args.view_filter * (1 if args.view_map is not None else views.count / panel.views) > 1:
        return f"{views.count} views for the panel's {panel.views}: means over {args.view_filter:g} views of the panel"
    if exact:
        return "every sub-pixel is that of one view"
    return f"{views.count} views for the panel's {panel.views}: {args.interpolation} between them"


def say_colours(colours: ViewColours) -> None:
    """Says what was done to the colours of the views, and what may be wrong with them."""
    if colours.messages:
        print(f"colours: {'; '.join(colours.messages)}")
    for words in colours.notes:
        note(words)


def metadata_of(args: argparse.Namespace, panel: Panel, count: int) -> dict[str, str]:
    """What the image was made from and for; the values but "software" and "input" are JSON."""
    return {
        "software": software(),
        "input": args.input.name,
        "panel": json.dumps(panel.to_dict()),
        "encoding": json.dumps(_encoding(args, count)),
        "versions": json.dumps(package_versions()),
    }


def _encoding(args: argparse.Namespace, count: int) -> dict[str, Any]:
    return {
        "method": "weave",
        "source_views": count,
        "interpolation": args.interpolation,
        "views": args.views,
        **({"view_filter": args.view_filter} if args.view_filter else {}),
        "fit": args.fit,
        "crop": list(args.crop),
        "shift": args.shift,
    }


def weave_movie(args: argparse.Namespace, panel: Panel, movie: QuiltMovie, watch: Stopwatch) -> None:
    """Weaves each frame of a movie of quilts, into a folder of PNG files or a video without loss. Raises InputError."""
    from tqdm import tqdm

    from lightfield_gs.encoding.weave import weave

    if args.view_map is not None:
        raise InputError("--view-map is for one picture, and this is a movie of quilts; leave it out")
    sink, words, made = _sink(args, panel, movie), "", 0
    watch.lap("load")
    wanted = set(sink.missing)
    with sink, tqdm(total=len(movie.numbers), unit="frame", dynamic_ncols=True, disable=None) as bar:
        for number, views in enumerate(movie.frames()):
            if number in wanted:
                options = weaving_of(args, panel, views, movie.aspect)
                sink.put(number, sink.fetch(weave(views, panel, **options)))
            words = f"{views.width_px} x {views.height_px} pixels each; {words_of(args, views, panel)}"
            made += 1
            bar.update()
    watch.lap("frames")
    there = len(movie.numbers) - len(sink.missing)
    kept = f", of which {there} were there" if there else ""
    print(
        f"{args.output}: {made} frames of {panel.width_px} x {panel.height_px}{kept}, {float(_fps(movie)):g} a second"
    )
    print(watch.line())
    print(f"{args.input}: {movie.description}, {words}")
    say_colours(movie.colours)


def _fps(movie: QuiltMovie) -> Fraction:
    return movie.fps or _DEFAULT_FPS


def _sink(args: argparse.Namespace, panel: Panel, movie: QuiltMovie):
    """The files that the frames go to. Raises InputError."""
    count = len(movie.numbers)
    if args.output.suffix and not args.output.is_dir():
        from lightfield_gs.video.video_file import VideoFile, choose_codec

        codec = choose_codec(args.output, "native", None)
        return VideoFile(args.output, count, (panel.width_px, panel.height_px), _fps(movie), codec)
    from lightfield_gs.video.frame_folder import FrameFolder

    layout = movie.layout
    job = {
        "software": software(),
        "input": args.input.name,
        "pictures": sha256(args.input),
        "panel": panel.to_dict(),
        "quilt": [layout.columns, layout.rows, args.aspect or movie.aspect],
        "order": [args.top_first, args.right_to_left],
        "frames": [movie.numbers.start, movie.numbers.stop, movie.numbers.step],
        "background": list(args.background),
        "compression": args.compression,
        "device": choose_device(args.device),
        **_encoding(args, layout.views),
    }
    return FrameFolder(
        args.output,
        count,
        job,
        fps=float(_fps(movie)),
        metadata=lambda number: {**metadata_of(args, panel, layout.views), "frame": str(number)},
        compression=args.compression,
        overwrite=args.overwrite,
    )
