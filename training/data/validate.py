"""Check a folder of objects: `python -m training.data.validate DIR` prints every problem; exit code 2 if any."""
from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from lightfield_gs.errors import InputError
from training.data.images import read_view
from training.data.objects import find_objects, read_object


def problems(root: Path) -> Iterator[str]:
    """Yield one line for each object at or below root that cannot be used, naming its first fault per image."""
    for path in find_objects(root):
        try:
            views = read_object(path)
        except InputError as error:
            yield str(error)
            continue
        for index in range(len(views.image_paths)):
            try:
                read_view(views, index)
            except InputError as error:
                yield str(error)


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns 0 when all is well, 2 otherwise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder of objects: SRN layout or transforms.json")
    options = parser.parse_args(arguments)
    try:
        found = list(problems(options.data))
    except InputError as error:
        found = [str(error)]
    for line in found:
        print(line, file=sys.stderr)
    if not found:
        print(f"{options.data}: {len(find_objects(options.data))} objects, all well")
    return 2 if found else 0


if __name__ == "__main__":
    sys.exit(main())
