"""The options of `lightfield-gs bench dense` and `bench fit`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.bench import dense, fit
from lightfield_gs.commands.options.values import whole, whole_numbers

_MOST_GAUSSIANS = 100_000_000


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    """Those that only these two take; each is None where it is not given."""
    parser.add_argument("capture", nargs="?", type=Path, metavar="CAPTURE", help="of fit: the folder of a capture")
    parser.add_argument(
        "--gaussians",
        type=whole_numbers(1, _MOST_GAUSSIANS),
        metavar="N",
        help="of fit: how many a scene has at the end, of the arms that are told (default: "
        f"{fit.GAUSSIANS['cuda']}, on the CPU {fit.GAUSSIANS['cpu']}); of dense: several with commas (default: "
        f"{_listed(dense.COUNTS['cuda'])}, on the CPU {_listed(dense.COUNTS['cpu'])})",
    )
    parser.add_argument(
        "--size",
        type=whole_numbers(16, 16_384, "x", 2),
        metavar="WxH",
        help=f"of dense: the image, px (default: {_listed(dense.SIZES_PX['cuda'], 'x')}, on the CPU "
        f"{_listed(dense.SIZES_PX['cpu'], 'x')})",
    )
    parser.add_argument(
        "--steps",
        type=whole(1, 10_000_000),
        help=f"of fit; schedules are scaled to them (default: {fit.STEPS['cuda']}, on the CPU {fit.STEPS['cpu']})",
    )
    parser.add_argument("--seeds", type=whole(1, 1000), help="of fit: how many fits of each arm (default: 1)")
    parser.add_argument(
        "--arms",
        help=f"of fit: with commas, of {', '.join(fit.ARMS)} (default: {', '.join(fit.USUAL_ARMS)}, or ours alone on "
        "the CPU and where gsplat is not installed)",
    )
    parser.add_argument(
        "--longest-px",
        type=whole(16, 16_384),
        help="of fit: photographs are shrunk to this many pixels on their longer side (default: not at all, on the CPU "
        f"to {fit.LONGEST_PX['cpu']})",
    )
    parser.add_argument(
        "--test-every",
        type=whole(2, 1_000_000),
        metavar="K",
        help="of fit: one of K photographs is held out, the middle one (default: 8)",
    )


def _listed(values: tuple[int, ...], separator: str = ",") -> str:
    return separator.join(map(str, values))
