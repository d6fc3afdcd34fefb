"""The arguments of `lightfield-gs displays`."""

from __future__ import annotations

from lightfield_gs.commands.options.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs displays`."""
    parser.description = "List the screens that are connected, and the 3D displays among them."
    parser.epilog = (
        "Sizes, places and scales are listed, and the calibrations of Looking Glass displays. Commands without "
        "--panel take the first of these displays."
    )
    parser.text.examples = (("displays", "what is connected"),)
    parser.add_argument("--json", action="store_true", short="print the same as JSON", help="print the same as JSON")
