"""`lightfield-gs bench paper`: the tables of Shi et al., ten scenes by three methods."""

from __future__ import annotations

import argparse

from lightfield_gs.bench import paper
from lightfield_gs.commands.benches import light_field

rows = light_field.paper_rows


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of a light-field image."""
    light_field.add_arguments(parser, paper.SCENES, paper.METHODS)
