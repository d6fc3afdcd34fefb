"""Score fillings of hidden surfaces: `python -m training.hidden.evaluate --meshes FOLDER --photographs FOLDER ...`.

It prints the mean PSNR in the hidden regions of a smooth filling (membrane) and of patches of the picture (exemplar).
Compositions are scored by their hidden layer, fitted captures by views from the sides.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch
from torch import Tensor

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import write_image
from lightfield_gs.photo.hidden import Hidden, fill_hidden
from lightfield_gs.photo.inpainting import solve_membrane
from training.command import with_line_errors
from training.hidden.compositions import CompositionOptions
from training.hidden.scores import ScoredCompositions
from training.hidden.views import ANGLES_DEG, Fill, SideViews

_SHOWN_DEG, _SHOWN = 15, 8  # angle and number of compositions of the pictures


def _membrane(image: Tensor, depth: Tensor, found: Hidden) -> tuple[Hidden, Tensor]:
    return found, solve_membrane(found.image, found.hole, found.linked)


def _exemplar(image: Tensor, depth: Tensor, found: Hidden) -> tuple[Hidden, Tensor]:
    return found, fill_hidden(found, depth)


_FILLS: dict[str, Fill] = {"membrane": _membrane, "exemplar": _exemplar}


def _print_row(name: str, values: dict[str, float]) -> None:
    print(f"{name:<34}" + "".join(f"{filling} {value:6.2f}   " for filling, value in values.items()), flush=True)


def _score_captures(captures: list[list[str]], sheet: Path | None) -> None:
    """Print a row for each angle, and write the views at -15 and 15 degrees below each other, the truth first."""
    for capture, scene, name in captures:
        photo = SideViews(Path(capture), Path(scene), name)
        views = {filling: photo.views(fill) for filling, fill in _FILLS.items()}
        scores = {filling: photo.scores(images) for filling, images in views.items()}
        for deg in ANGLES_DEG:
            _print_row(f"{Path(capture).name} {name} {deg} deg", {filling: scores[filling][deg] for filling in scores})
        left = 2 * ANGLES_DEG.index(_SHOWN_DEG)
        pairs = ((images[left], images[left + 1]) for images in (photo.truths, *views.values()))
        if sheet is not None:
            rows = [torch.cat(pair, 1) for pair in pairs]
            path = sheet.with_stem(f"{sheet.stem}-{Path(capture).name}")
            write_image(path, (255 * torch.cat(rows).clamp(0, 1)).round().byte().numpy())


def _score_compositions(compositions: ScoredCompositions, sheet: Path | None) -> None:
    """Print the scores, and write photographs, fillings and truths side by side."""
    _print_row("compositions", compositions.scores())
    print(f"mean error of log disparity: {compositions.disparity_error():.3f}", flush=True)
    if sheet is not None:
        rows = [
            torch.cat([example.image[0], *fillings.values(), example.truth[0]], 2)
            for example, fillings in compositions.filled[:_SHOWN]
        ]
        image = torch.cat(rows, 1).movedim(0, 2).cpu()
        write_image(sheet.with_stem(f"{sheet.stem}-compositions"), (255 * image.clamp(0, 1)).round().byte().numpy())


@with_line_errors("training.hidden.evaluate")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.hidden.evaluate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--meshes", type=Path, help="folder of mesh packs: score compositions")
    parser.add_argument("--photographs", type=Path, help="folder of photographs for them")
    parser.add_argument("--names", nargs="+", default=["*"], help="file name patterns of those to use (default: all)")
    parser.add_argument("--count", type=int, default=48, help="compositions (default: 48)")
    parser.add_argument("--size", type=int, default=CompositionOptions.size_px, help="their side, pixels")
    parser.add_argument(
        "--capture",
        nargs=3,
        action="append",
        default=[],
        metavar=("FOLDER", "SCENE", "NAME"),
        help="score views beside a photograph of a capture, of which there is a fitted scene; may be repeated",
    )
    parser.add_argument("--sheet", type=Path, help="write pictures of the fillings, with names that begin so (.png)")
    options = parser.parse_args(arguments)
    count = whole_number("--count", options.count, 1, 4096)
    if options.meshes is not None:
        if options.photographs is None:
            raise InputError("--meshes: expected --photographs as well, a folder of pictures for walls and floors")
        ranges = CompositionOptions(options.size)
        compositions = ScoredCompositions(options.meshes, options.photographs, options.names, ranges, count)
        _score_compositions(compositions, options.sheet)
    _score_captures(options.capture, options.sheet)
    return 0


if __name__ == "__main__":
    sys.exit(main())
