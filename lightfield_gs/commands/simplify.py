"""`lightfield-gs simplify`: a scene of merged Gaussians, within a bound of the light field's error, or in levels."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.app.options import WHITE
from lightfield_gs.app.scene import LoadedScene
from lightfield_gs.base.cli_messages import Stopwatch, say
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.smaller import Smaller, SmallerOptions, make_smaller, smaller
from lightfield_gs.io.scenes.streamed_sog import LOD_META
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

_PSNR_DB = 45.0  # by default: looked at on a captured guitar, where no difference was found; a biker reports it


@dataclass(frozen=True, slots=True, kw_only=True)
class SimplifyOptions(SmallerOptions):
    """A scene whose Gaussians are merged.

    Attributes:
        psnr: the least PSNR of the light field, dB. None: _PSNR_DB, or none with gaussians.
        gaussians: the most Gaussians that are left.
        levels: of detail, for a lod-meta.json. None: LEVELS.
    """

    psnr: float | None = None
    gaussians: int | None = None
    levels: int | None = None


def run(args: argparse.Namespace) -> None:
    """Simplify args.input into args.output. Raises InputError."""
    options = read_options(SimplifyOptions, args)
    if options.output.name == LOD_META:
        _write_levels(options, Stopwatch(args.began))
        return
    if options.levels is not None:
        raise InputError(f"--levels is for a folder of levels of detail: -o FOLDER/{LOD_META}; got {options.output}")
    least = _PSNR_DB if options.psnr is None and options.gaussians is None else options.psnr

    def simplified(scene: LoadedScene, panel: Panel, rig: Rig) -> Smaller:
        from lightfield_gs.simplification.simplify import simplify

        render = scene.render
        found = simplify(
            scene.gaussians,
            panel,
            rig,
            psnr_db=least,
            count=options.gaussians,
            background=render.background or WHITE,
            antialiased=bool(render.antialiased),
            view_filter=render.view_filter,
            progress=lambda count, psnr: say(f"{count} Gaussians: {psnr:.1f} dB"),
        )
        words = f"{found.psnr_db:.1f} dB from the whole scene in the light field"
        return smaller(scene.gaussians, found.gaussians, words, panel)

    make_smaller(options, Stopwatch(args.began), simplified)


def _write_levels(options: SimplifyOptions, watch: Stopwatch) -> None:
    """Write a scene in levels of detail. Raises InputError."""
    from lightfield_gs.io.scenes.streamed_sog import check_index_path

    for name in ("psnr", "gaussians"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name} is of one smaller scene, and {LOD_META} has --levels; leave out one of them")

    def levelled(scene: LoadedScene, panel: Panel, rig: Rig) -> Smaller:
        from lightfield_gs.simplification.levels import LEVELS, write_levels

        counts = list[int]()

        def save(path: Path, comments: list[str]) -> None:
            levels, antialiased = options.levels or LEVELS, bool(scene.render.antialiased)
            counts[:] = write_levels(scene.gaussians, path, levels, comments, antialiased, _say_chunks)

        return Smaller(scene.gaussians.count, save, lambda: f"levels of {', '.join(map(str, counts))} Gaussians")

    make_smaller(options, watch, levelled, check_index_path)


def _say_chunks(done: int, chunks: int) -> None:
    """Print a line after every tenth of the chunks."""
    if done * 10 // chunks > (done - 1) * 10 // chunks:
        say(f"{done} of {chunks} chunks")
