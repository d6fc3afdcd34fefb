"""The arguments of `lightfield-gs calibrate nudge`."""

from __future__ import annotations

from lightfield_gs.commands.arguments.calibrate_pattern import KINDS
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_quiet
from lightfield_gs.commands.options.panel import add_changed_profile
from lightfield_gs.commands.options.parser import Parser, numbers

_TO_SHOW = [kind for kind in KINDS if kind != "single"]


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs calibrate nudge`."""
    parser.description = "Change the lens in a calibration a little."
    parser.epilog = (
        "Pitch, slope and centre are the words of Looking Glass; line number, slant and phase are the "
        "words of a .yaml. Profiles of both kinds take both. The content in the middle of the panel stays, "
        "unless the centre or the phase is moved. `calibrate pattern` pitch, slope and centre label their "
        "bands with the values for this command."
    )
    parser.text.examples = (
        ("calibrate nudge visual.json -o new.json --pitch-by 0.1%", "0.1 % more pitch"),
        ("calibrate nudge visual.json -o new.json --centre-by 0.05", "move the centre"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add_changed_profile(add)
    add(
        "--pitch-by",
        type=_amount,
        metavar="LPI|P%",
        short="more lenses per inch, or percent of them",
        help="more lenses per inch across their axis, or percent of them",
    )
    add(
        "--slope-by",
        type=_amount,
        metavar="S|P%",
        short="more slope, or percent of it",
        help="more slope (dy/dx of the lens axis), or percent of it",
    )
    add(
        "--centre-by",
        type=numbers(1),
        metavar="LENSES",
        short="move the centre, in lens widths",
        help="move the centre, in lens widths",
    )
    add("--line-number-by", type=numbers(1), metavar="SUBPIXELS", help="wider lenses, in sub-pixels along a row")
    add("--slant-by", type=numbers(1), metavar="TAN", help="more slant, in its tangent")
    add("--phase-by", type=numbers(1), metavar="SUBPIXELS", help="move the phase, in sub-pixels")
    add(
        "--pattern",
        choices=_TO_SHOW,
        metavar="KIND",
        short="also write a test picture: pitch, slope, centre, ...",
        help="also write a pattern of the new profile: NEW-KIND.png",
    )
    add("--yes", action="store_true", help="do not ask about a change of more than 2 %% of pitch or slope")
    add_quiet(add)


def _amount(text: str) -> tuple[float, bool]:
    """Parse "0.1%" to (0.1, True), which is percent; "0.05" to (0.05, False)."""
    relative = text.endswith("%")
    return numbers(1)(text.removesuffix("%"))[0], relative
