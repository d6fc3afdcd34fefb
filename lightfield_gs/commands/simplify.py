"""`lightfield-gs simplify`: a scene whose Gaussians are merged, within a bound of the light field's error."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from lightfield_gs.app.options import WHITE
from lightfield_gs.app.scene import LoadedScene
from lightfield_gs.base.cli_messages import Stopwatch, say
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.smaller import Smaller, SmallerOptions, make_smaller
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

_PSNR_DB = 45.0  # by default: looked at on a captured guitar, where no difference was found; a biker reports it


@dataclass(frozen=True, slots=True, kw_only=True)
class SimplifyOptions(SmallerOptions):
    """A scene whose Gaussians are merged.

    Attributes:
        psnr: the least PSNR of the light field, dB. None: _PSNR_DB, or none with gaussians.
        gaussians: the most Gaussians that are left.
    """

    psnr: float | None = None
    gaussians: int | None = None


def run(args: argparse.Namespace) -> None:
    """Simplify args.input into args.output. Raises InputError."""
    options = read_options(SimplifyOptions, args)
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
        return Smaller(found.gaussians, f"{found.psnr_db:.1f} dB from the whole scene in the light field")

    make_smaller(options, Stopwatch(args.began), simplified)
