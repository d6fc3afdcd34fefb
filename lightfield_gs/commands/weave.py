"""`lightfield-gs weave`: the views of a quilt, a folder, a light field or a video become the image of a panel."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.panel import load_panel
from lightfield_gs.base.cli_messages import Stopwatch, say, say_next
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, write_image

if TYPE_CHECKING:
    import numpy as np

    from lightfield_gs.app.weaving import WeaveOptions


def run(args: argparse.Namespace) -> None:
    """Weave args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    from lightfield_gs.app.weaving import WeaveOptions

    _weave(read_options(WeaveOptions, args), watch)


def _weave(options: WeaveOptions, watch: Stopwatch) -> None:
    from lightfield_gs.app.weaving import interpolation_words, say_colours, weave_arguments, weave_metadata, weave_movie
    from lightfield_gs.encoding.view_files import read_view_map
    from lightfield_gs.encoding.weave import weave
    from lightfield_gs.view_sets.movies import is_movie
    from lightfield_gs.view_sets.view_set import QuiltMovie, open_views

    source, output = options.input, options.output
    if not is_movie(source):  # the tiles of a movie decide its use
        check_image_path(output)
    check_outputs((output,), (source, options.panel.panel, options.view_map))
    panel = load_panel(options.panel)
    found = open_views(
        source,
        options.tiles,
        row=options.row,
        top_first=options.top_first,
        right_to_left=options.right_to_left,
        span=options.frames,
        background=options.background,
        keeps_linear=output.suffix.lower() == ".exr",
    )
    if isinstance(found, QuiltMovie):
        weave_movie(options, panel, found, watch)
        return
    check_image_path(output)
    if options.overwrite:
        raise InputError("--overwrite is about folders of frames; leave it out")
    views = found.views
    view_map = None if options.view_map is None else read_view_map(options.view_map, panel, views.count)
    watch.lap("load")
    image = weave(views, panel, **weave_arguments(options, panel, views, found.aspect, view_map)).cpu()
    watch.lap("weave")
    metadata = weave_metadata(options, panel, views.count)
    write_image(output, _to_file_type(output, image.numpy()), metadata, options.compression)
    watch.lap("write")
    print(f"{output}: {panel.width_px} x {panel.height_px}, {panel.views} views")
    watch.say_if(options.stats)
    size = f"{views.width_px} x {views.height_px} pixels each"
    say(f"{source}: {found.description}, {size}; {interpolation_words(options, views, panel)}")
    say_colours(found.colours)
    say_next("show", output)


def _to_file_type(path: Path, image: np.ndarray) -> np.ndarray:
    """Return the image in the type that the file takes: .png takes no floats, .exr nothing else."""
    from lightfield_gs.io.images import as_floats
    from lightfield_gs.show.preview import to_integers

    suffix = path.suffix.lower()
    if suffix == ".exr":
        return as_floats(image)
    return to_integers(image, 16) if suffix == ".png" and image.dtype.name == "float32" else image
