"""Score a checkpoint: `python -m training.evaluate --data DIR [--checkpoint F] [--save-renders DIR] --json F`.

Writes PSNR and SSIM of the network and of two floors, copying the input and showing it as a flat card, as JSON, and
prints them as a table: over all novel views, per angle, and of the source view. The protocol is described in
training/evaluation.py. Objects that cannot be scored are left out, each with a note.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from lightfield_gs.base.complaint import note
from training.command import with_line_errors
from training.data.background import CHOICES


def _table(report: dict[str, Any]) -> str:
    """The report as lines of text."""
    from training.evaluation import labelled

    lines = ["angle   views   PSNR dB   SSIM   copy PSNR dB   copy SSIM   card PSNR dB   card SSIM"]
    for label, row in labelled(report):
        floors = "".join(
            f"   {row[f'{floor}_psnr_db']:12.2f}   {row[f'{floor}_ssim']:9.3f}" for floor in ("copy", "card")
        )
        lines.append(f"{label:<7} {row['views']:>5}   {row['psnr_db']:7.2f}   {row['ssim']:.3f}{floors}")
    return "\n".join(lines)


def _source(text: str) -> int | str:
    """The value of --source."""
    if text != "middle" and not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a number from 0 on, or middle, got {text!r}")
    return text if text == "middle" else int(text)


@with_line_errors("training.evaluate")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.evaluate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of objects: SRN layout or transforms.json")
    parser.add_argument(
        "--split",
        choices=("train", "val", "test"),
        default="val",
        help="views of objects that come in splits, transforms_<split>.json (default: val)",
    )
    parser.add_argument("--checkpoint", type=Path, help="safetensors file; default: the one in the package")
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
    parser.add_argument("--limit", type=int, help="score only so many objects, spread evenly over the folder")
    options = parser.parse_args(arguments)
    from lightfield_gs.base.device import choose_device
    from lightfield_gs.io.atomic import atomic_path, check_output_path
    from lightfield_gs.models import SplatterNet
    from training.evaluation import score_folder

    check_output_path(options.json)
    device = choose_device(options.device)
    net = SplatterNet.from_pretrained(options.checkpoint).to(device)
    report = score_folder(
        net,
        options.data,
        limit=options.limit,
        save_renders=options.save_renders,
        split=options.split,
        device=device,
        supersampling=options.supersampling,
        source=options.source,
        background=options.background,
    )
    for reason in report["skipped"].values():
        note(f"skipped {reason}")
    if report["doubts"]:
        name, doubt = next(iter(report["doubts"].items()))
        note(f"{len(report['doubts'])} objects may be scored in vain, such as {name}: {doubt}")
    report |= {
        "source_view": options.source,
        "background": options.background,
        "data": str(options.data),
        "checkpoint": str(options.checkpoint or "pretrained"),
        "supersampling": options.supersampling,
    }
    with atomic_path(options.json) as temporary:
        temporary.write_text(json.dumps(report, indent=1) + "\n")
    print(_table(report))
    print(f"{report['objects']} objects scored from view {options.source}, {len(report['skipped'])} skipped")
    return 0


if __name__ == "__main__":
    sys.exit(main())
