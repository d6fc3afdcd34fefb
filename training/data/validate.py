"""Check a folder of objects: `python -m training.data.validate DIR [--sheet FILE.png]`.

Prints what training will see: what says which pixels are object, and what of the files is taken otherwise than a viewer
would show it. Every problem is a line on stderr, and the exit code 2 if there is any; what may not be meant is a note
there. --sheet draws the views with what is left out under a tint.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import describe_coefficients
from lightfield_gs.io.captures.objects import ObjectImages
from lightfield_gs.io.captures.undistortion import fraction_beyond
from lightfield_gs.io.images import read_info
from lightfield_gs.photo.plain import cut_from_plain_background
from training.command import with_line_errors
from training.data.background import CHOICES, Choice
from training.data.cache import square_of_view
from training.data.distance import distance_doubt
from training.data.images import Cutout, find_cutout, read_colours, read_view
from training.data.objects import find_objects, read_object
from training.data.sheet import Sheet, check_sheet_path

_FADED = 0.02  # fraction of an object; more is no noise of its outline


@dataclass
class Examined:
    """An object, as find_objects names it, and the findings on it.

    Attributes:
        views, cutout: None if they cannot be found.
        problems: Lines.
        filled: Fraction of the picture that the object covers, for each readable view.
        cut: Number of these views whose object the border cuts.
        faded: Before a background of about one colour, the fraction of the object in each view that went with the
            background though its colour differs.
    """

    path: Path
    views: ObjectImages | None = None
    cutout: Cutout | None = None
    problems: list[str] = field(default_factory=list)
    filled: list[float] = field(default_factory=list)
    cut: int = 0
    faded: list[float] = field(default_factory=list)

    def _count(self, number: int) -> str:
        return f"{number} of {len(self.views.image_paths)} views"

    def findings(self) -> Iterator[str]:
        """Yield the choices made, for people; the same lines for similar objects."""
        if self.cutout is None:
            return
        yield str(self.cutout)
        turned = [info for path in self.views.image_paths if (info := _orientation(path)) > 1]
        if turned:
            yield (
                f"Exif orientation {turned[0]} in {self._count(len(turned))} is not applied: poses are of the "
                "pixels as stored"
            )
        if self.views.distortion is not None:
            yield _lens(self.views)

    def doubts(self) -> Iterator[str]:
        """Yield findings that may be mistakes."""
        whole = self.filled.count(1)
        if whole:
            yield f"the whole picture is object in {self._count(whole)}: give alpha, masks or --background if it is not"
        if self.cut > whole:
            yield f"the picture's border cuts the object in {self._count(self.cut - whole)}"
        faded = [fraction for fraction in self.faded if fraction > _FADED]
        if faded:
            yield (
                f"up to {max(faded):.0%} of the object is lost to the background, which is of nearly its colour, in "
                f"{self._count(len(faded))}: give alpha or masks, or renders in a lossless format"
            )
        if self.views is not None and (doubt := distance_doubt(self.views.camera_to_world)):
            yield doubt


def _orientation(path: Path) -> int:
    try:
        return read_info(path).orientation
    except InputError:  # a problem, and named as such
        return 1


def _lens(views: ObjectImages) -> str:
    """Return the treatment of lens distortion, by the first view."""
    fx, fy, cx, cy = intrinsics = views.intrinsics[0]
    lens = views.distortion[0]
    beyond = fraction_beyond(intrinsics, lens, views.width_px, views.height_px)
    return (
        f"undistorted ({describe_coefficients(lens)}) to a pinhole camera of "
        f"{views.width_px} x {views.height_px} px, fx {fx:g}, fy {fy:g}, "
        f"cx {cx:g}, cy {cy:g}; {beyond:.0%} of the stored picture lies beyond it"
    )


def examine(path: Path, background: Choice = "auto") -> Examined:
    """Looks at all files of an object."""
    found = Examined(path)
    try:
        found.views = read_object(path)
        found.cutout = find_cutout(found.views, background)
    except InputError as error:
        found.problems.append(str(error))
        return found
    for index, image in enumerate(found.views.image_paths):
        try:
            alpha = read_view(found.views, index, found.cutout)[..., 3]
            square_of_view(image, alpha)
        except InputError as error:
            found.problems.append(str(error))
            continue
        if found.cutout.background is not None and not found.cutout.background.exact:
            plain = cut_from_plain_background(read_colours(found.views, index))
            found.faded += [] if plain is None else [plain.faded]
        opaque = alpha > 127
        found.filled.append(float(opaque.mean()))
        found.cut += bool(np.concatenate([opaque[[0, -1]].ravel(), opaque[:, [0, -1]].ravel()]).any())
    return found


def problems(objects: Iterable[Path], background: Choice = "auto") -> Iterator[str]:
    """Yield a line with the first fault of each object that cannot be read, and of each image of the others.

    Args:
        objects: As find_objects names them.
    """
    for path in objects:
        yield from examine(path, background).problems


def _name(path: Path, root: Path) -> str:
    """An object's place below the folder that was asked for."""
    return path.resolve().name if path == root else str(path.relative_to(root))


@dataclass
class Summary:
    """The findings on all objects.

    Attributes:
        findings, doubts: for each line the names of its objects.
        filled: Fractions of pictures that objects cover.
        faults: Number of problems.
    """

    findings: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    doubts: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    filled: list[float] = field(default_factory=list)
    faults: int = 0

    def add(self, found: Examined, name: str) -> None:
        """An object by its name."""
        for lines, told in ((self.findings, found.findings()), (self.doubts, found.doubts())):
            for line in told:
                lines[line].append(name)
        self.filled += found.filled
        self.faults += len(found.problems)

    def tell(self) -> None:
        """Prints the findings and notes the doubts."""
        for line in _grouped(self.findings):
            print(line)
        if self.filled:
            print(f"the object fills {min(self.filled):.0%} to {max(self.filled):.0%} of a picture")
        for line in _grouped(self.doubts):
            note(line)


def _grouped(lines: dict[str, list[str]]) -> Iterator[str]:
    """Return lines, each with its objects."""
    for line, names in lines.items():
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        yield f"{', '.join(names[:3])}{more}: {line}"


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m training.data.validate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("data", type=Path, help="folder of objects: SRN layout or transforms.json")
    parser.add_argument(
        "--background",
        choices=CHOICES,
        default="auto",
        help="of images without alpha and masks (default: auto, found for each object)",
    )
    parser.add_argument("--sheet", type=Path, help="PNG file for a contact sheet")
    return parser.parse_args(arguments)


@with_line_errors("training.data.validate")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns 0 when all is well, 2 otherwise."""
    options = _options(arguments)
    objects, summary = find_objects(options.data), Summary()
    sheet = Sheet(len(objects)) if options.sheet and check_sheet_path(options.sheet) else None
    for path in objects:
        found, name = examine(path, options.background), _name(path, options.data)
        for line in found.problems:
            print(line, file=sys.stderr)
        summary.add(found, name)
        if sheet:
            sheet.add(f"{name}: {found.cutout or found.problems[0]}", found.views, found.cutout)
    summary.tell()
    if sheet:
        print(sheet.write(options.sheet))
    if not summary.faults:
        print(f"{options.data}: {len(objects)} objects, all well")
    return 2 if summary.faults else 0


if __name__ == "__main__":
    sys.exit(main())
