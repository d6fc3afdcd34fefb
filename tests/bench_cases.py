"""Cases for tests of the benchmark: a small panel, and the arguments of a command line."""

import argparse

from lightfield_gs.cli import build_parser
from lightfield_gs.panels.panel import Panel

PANEL = Panel(width_px=96, height_px=48, views=6, line_number=6.3, slant_tan=0.2)


def arguments(*words: str) -> argparse.Namespace:
    """Of `lightfield-gs bench WORDS`."""
    return build_parser("bench").parse_args(["bench", *words])
