"""Check a folder of objects: `python -m training.data.validate DIR` prints every problem; exit code 2 if any."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from lightfield_gs.errors import InputError
from training.command import with_line_errors
from training.data.cache import square_of_view
from training.data.images import read_view
from training.data.objects import find_objects, read_object


def problems(objects: Iterable[Path]) -> Iterator[str]:
    """Yield a line with the first fault of each object that cannot be read, and of each image of the others.

    objects: as find_objects names them.
    """
    for path in objects:
        try:
            views = read_object(path)
        except InputError as error:
            yield str(error)
            continue
        for index, image in enumerate(views.image_paths):
            try:
                square_of_view(image, read_view(views, index)[..., 3])
            except InputError as error:
                yield str(error)


@with_line_errors("training.data.validate")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns 0 when all is well, 2 otherwise."""
    parser = argparse.ArgumentParser(prog="python -m training.data.validate", description=__doc__)
    parser.add_argument("data", type=Path, help="folder of objects: SRN layout or transforms.json")
    options = parser.parse_args(arguments)
    objects, faults = find_objects(options.data), 0
    for faults, line in enumerate(problems(objects), 1):
        print(line, file=sys.stderr)
    if not faults:
        print(f"{options.data}: {len(objects)} objects, all well")
    return 2 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
