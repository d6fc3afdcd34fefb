"""`lightfield-gs encode`: a photo, with or without a depth map, or a file of Gaussians becomes the image of a panel."""

from __future__ import annotations

import argparse
from typing import Any

from lightfield_gs.app.encoding import Encoding, use_threads
from lightfield_gs.app.options import EncodeOptions
from lightfield_gs.app.panel import why_no_eye
from lightfield_gs.app.stereo import refuse_stereo, write_stereo
from lightfield_gs.base.cli_messages import Stopwatch, note, say, say_next
from lightfield_gs.commands.options.parser import read_options


def run(args: argparse.Namespace) -> None:
    """Encode args.input into args.output. Raises InputError."""
    options, watch = read_options(EncodeOptions, args), Stopwatch(args.began)
    refuse_stereo(options.stereo)
    if options.stereo.stereo is not None:
        paths = write_stereo(options, watch)
        if options.stereo.stereo in ("sbs", "half-sbs", "tab", "mpo"):  # as `show` takes them
            say_next("show", *paths)
        return
    encoding = Encoding(options, watch)
    if args.threads is not None:
        use_threads(args.threads)
    encoding.read()
    encoding.draw()
    encoding.write()
    _say(encoding)
    say_next("show", options.output)


def _say(encoding: Encoding) -> None:
    """Print the size of the image, the times, and notes on decisions and suspicious contents."""
    options, panel, count = encoding.options, encoding.panel, encoding.scene.gaussians.count
    if options.preview is not None and (why := why_no_eye(panel)):
        note(f"{options.preview} has no left-eye.png and right-eye.png: {why}")
    print(f"{options.output}: {panel.width_px} x {panel.height_px}, {panel.views} views, {count} Gaussians")
    encoding.watch.say_if(options.stats)
    if options.stats:
        print("\n".join(_stats_lines(encoding.stats, count)))
    say(*encoding.messages)


def _stats_lines(stats: dict[str, Any], gaussians: int) -> list[str]:
    from lightfield_gs.rasterizer.stats import skipped_lines

    each = stats["evaluations_per_subpixel"]
    lines = [
        f"intersections of tile and Gaussian: {stats['pairs']}",
        *skipped_lines(stats.get("skipped", {}), gaussians),
    ]
    return lines if each is None else [*lines, f"evaluations per sub-pixel: {each:.1f}"]
