"""Score a checkpoint: `python -m training.evaluate --data DIR [--checkpoint F] [--save-renders DIR] --json F`.

The scores are PSNR, SSIM and sharpness (PSNR of gradients). Two floors have scores beside the network: a copy of the
input, and the input as a flat card. They are written as JSON and printed as a table, over all novel views, per angle,
and of the source view. training/evaluation.py describes the protocol. Several folders, such as plain and textured
objects, are scored apart. Objects that cannot be scored are left out, each with a note.

Scores are of pictures of 128 px by default (--size). At 512, if objects are stored so large, they show how much detail
of a photo the output keeps. The network still sees the object as in a photo, cropped to its own size.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from training.command import with_line_errors
from training.data.background import CHOICES

if TYPE_CHECKING:
    from lightfield_gs.models import SplatterNet

# Prefix, name and decimals of the scores of a table's row.
_COLUMNS = [
    (shown, name, digits)
    for shown in ("", "copy_", "card_")
    for name, digits in (("psnr_db", 2), ("ssim", 3), ("gradient_psnr_db", 2))
]
_FRACTIONS = ("holes", "ghosts")


def _table(report: dict[str, Any]) -> str:
    """The report as lines of text."""
    from training.evaluation import labelled

    titles = [f"{shown}{title}" for shown in ("", "copy ", "card ") for title in ("PSNR dB", "SSIM", "sharp dB")]
    percents = [f"{name} %" for name in _FRACTIONS]
    lines = ["   ".join(["angle   views", *titles, *percents])]
    for label, row in labelled(report):
        scores = [
            f"{row[f'{shown}{name}']:{len(title)}.{digits}f}" for (shown, name, digits), title in zip(_COLUMNS, titles)
        ]
        scores += [f"{100 * row[name]:{len(title)}.2f}" for name, title in zip(_FRACTIONS, percents)]
        lines.append("   ".join([f"{label:<7} {row['views']:>5}", *scores]))
    return "\n".join(lines)


def _source(text: str) -> int | str:
    """The value of --source."""
    if text != "middle" and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a number from 0 on, or middle, got {text!r}")
    return text if text == "middle" else int(text)


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m training.evaluate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, required=True, nargs="+", help="folders of objects: SRN layout or transforms.json"
    )
    parser.add_argument(
        "--split",
        choices=("train", "val", "test"),
        default="val",
        help="views of objects that come in splits, transforms_<split>.json (default: val)",
    )
    parser.add_argument("--checkpoint", type=Path, help="safetensors file; default: the one in the package")
    parser.add_argument(
        "--size",
        type=int,
        default=128,
        metavar="PX",
        help="longer side of the pictures that are compared, 16..4096 (default: 128)",
    )
    parser.add_argument(
        "--detail",
        type=int,
        choices=(1, 2, 4),
        help="lay the source's own pixels over the prediction, so many times finer than the network's (default: not)",
    )
    parser.add_argument(
        "--save-renders",
        type=Path,
        help="folder for pictures, in folders as the objects are: truth above prediction, by angle",
    )
    parser.add_argument("--json", type=Path, required=True, help="file for the results")
    parser.add_argument(
        "--device", default="auto", choices=("auto", "cpu", "cuda"), help="default: a GPU if there is one"
    )
    parser.add_argument(
        "--supersampling",
        type=int,
        choices=range(1, 9),
        default=1,
        metavar="1..8",
        help="samples of a rendered pixel along each axis (default: 1, as in the model card)",
    )
    parser.add_argument(
        "--source",
        type=_source,
        default=0,
        metavar="INDEX|middle",
        help="the view that is the source: its number from 0 on, or the one whose direction is nearest "
        "to the mean of all (default: 0)",
    )
    parser.add_argument(
        "--background",
        choices=CHOICES,
        default="auto",
        help="of images without alpha and masks (default: auto, found for each object)",
    )
    parser.add_argument("--limit", type=int, help="score only so many objects of a folder, spread evenly over it")
    return parser.parse_args(arguments)


def _scored(net: SplatterNet, data: Path, options: argparse.Namespace, device: str) -> dict[str, Any]:
    """Return the report on one folder, with its settings; note objects that are left out or in doubt."""
    from training.evaluation import score_folder

    renders = options.save_renders
    if renders is not None and len(options.data) > 1:
        renders = renders / data.name
    report = score_folder(
        net,
        data,
        limit=options.limit,
        save_renders=renders,
        split=options.split,
        device=device,
        supersampling=options.supersampling,
        source=options.source,
        background=options.background,
        size_px=options.size,
        detail=options.detail,
    )
    for reason in report["skipped"].values():
        note(f"skipped {reason}")
    if report["doubts"]:
        name, doubt = next(iter(report["doubts"].items()))
        note(f"{len(report['doubts'])} objects may be scored in vain, such as {name}: {doubt}")
    return report | {
        "source_view": options.source,
        "background": options.background,
        "data": str(data),
        "checkpoint": str(options.checkpoint or "pretrained"),
        "size_px": options.size,
        "detail": options.detail,
        "supersampling": options.supersampling,
    }


@with_line_errors("training.evaluate")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = _options(arguments)
    from lightfield_gs.base.device import choose_device
    from lightfield_gs.io.atomic import atomic_path, check_output_path
    from lightfield_gs.models import SplatterNet

    whole_number("--size", options.size, 16, 4096)
    names = [data.resolve().name for data in options.data]
    if len(set(names)) < len(names):
        raise InputError(f"--data: expected folders of different names, got {', '.join(names)}")
    check_output_path(options.json)
    device = choose_device(options.device)
    net = SplatterNet.from_pretrained(options.checkpoint).to(device)
    reports = {name: _scored(net, data, options, device) for name, data in zip(names, options.data)}
    with atomic_path(options.json) as temporary:
        written = reports if len(reports) > 1 else next(iter(reports.values()))
        temporary.write_text(json.dumps(written, indent=1) + "\n")
    for name, report in reports.items():
        if len(reports) > 1:
            print(f"{name}:")
        print(_table(report))
        print(f"{report['objects']} objects scored from view {options.source}, {len(report['skipped'])} skipped")
    return 0


if __name__ == "__main__":
    sys.exit(main())
