"""The arguments of `lightfield-gs simplify`."""

from __future__ import annotations

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.parser import Parser, whole, within
from lightfield_gs.commands.options.smaller import add_drawing, add_scenes


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs simplify`."""
    parser.description = "Make a scene much smaller: merge what a display cannot show apart."
    parser.epilog = (
        "Gaussians merge until the picture of the display would differ by more than --psnr. The whole picture is drawn "
        "and compared at each step."
    )
    parser.text.examples = (
        ("simplify scene.ply -o small.ply", "for the connected display"),
        ("simplify scene.ply -o tiny.spz --gaussians 50000", "as few as that"),
        ("simplify scene.ply -o levels/lod-meta.json", "in levels of detail, for all distances"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add_scenes(add)
    add(
        "--psnr",
        type=within(0, 100),
        metavar="DB",
        short="least PSNR of the picture, dB (default 45)",
        help="least PSNR of the light field against the whole scene's, 0..100 dB (default 45, none with --gaussians)",
    )
    add(
        "--gaussians",
        type=whole(1, 2_000_000_000),
        metavar="N",
        short="how many are left at most",
        help="merge until so many are left; with --psnr as well, or as many as that takes",
    )
    add(
        "--levels",
        type=whole(1, 16),
        metavar="N",
        short="how many levels of detail (default 6)",
        help="with -o FOLDER/lod-meta.json, a streamed SOG: how many levels of detail, each with half of the Gaussians "
        "of the one before, for all viewpoints (default 6)",
    )
    add_drawing(add)
