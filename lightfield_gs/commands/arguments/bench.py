"""The arguments of `lightfield-gs bench`."""

from __future__ import annotations

from functools import partial

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench.benchmarks import BENCHMARKS, DEFAULT, load
from lightfield_gs.bench.options import add_light_field
from lightfield_gs.commands.options.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the options of the default benchmark, and a subcommand for each benchmark."""
    parser.description = "Measure speed and accuracy on this computer."
    parser.text.examples = (
        ("bench", "a picture of a synthetic scene"),
        ("bench photo", "a photo through the network to the picture"),
    )
    parser.text.sections = {"benchmarks": BENCHMARKS}
    parser.text.footer = "All options: lightfield-gs bench --help-all; those of each: bench BENCHMARK --help-all"
    add_light_field(parser)
    kinds = parser.add_subparsers(
        title="benchmarks", dest="what", metavar="BENCHMARK", parser_class=Parser, required=False
    )
    for name, purpose in BENCHMARKS.items():
        kinds.add_parser(
            name, description=f"{purpose[0].upper()}{purpose[1:]}.", allow_abbrev=False, fill=partial(_fill, name)
        )
    parser.set_defaults(what=DEFAULT)


def _fill(name: str, parser: Parser) -> None:
    try:
        load(name).add_arguments(parser)
    except InputError:  # `run` gives the reason
        parser.takes_anything = True
