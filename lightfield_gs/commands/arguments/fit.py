"""The arguments of `lightfield-gs fit`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.fit import add_capture, add_cone, add_optimisation, add_run
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_quiet
from lightfield_gs.commands.options.parser import Parser
from lightfield_gs.commands.options.scene import SAVED_FORMATS


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs fit`."""
    parser.description = "Make a 3D scene of photographs that show it from many sides."
    parser.epilog = (
        "The cameras come from COLMAP or another program, or with --sfm from the photographs. Ctrl-C stops the "
        "fit and writes the scene so far; the same command goes on from there. The same capture, options and "
        "machine give the same file."
    )
    parser.text.examples = (
        ("fit photos -o scene.ply --sfm --cone 27", "photographs alone, or a film"),
        ("fit capture -o scene.ply", "a capture with cameras"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "input",
        type=Path,
        metavar="CAPTURE",
        short="a folder with COLMAP's sparse/0 or transforms.json",
        help="a folder with photographs and COLMAP's sparse/0 or a transforms.json; a .json of this kind with "
        "another name; an export of Polycam, Record3D or NeRFCapture; with --sfm, a folder of photographs alone, or "
        "a film",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="SCENE",
        short="the scene: .ply, .glb, .usd, .spz or .splat",
        help=f"the scene: {SAVED_FORMATS}",
    )
    add_capture(add)
    add_optimisation(add)
    add_cone(add)
    add_run(add)
    add_quiet(add)
