"""Gather photographs for random objects: `python -m training.data.gather_photographs --output data/photographs`.

Random objects wear pieces of them. The photographs are the package's own, and those of scikit-image's wheel (`pip
install scikit-image`) that its documentation calls public domain or CC0. LICENCES.txt beside them names the licence of
each. Any other folder of photographs will do: the more they differ, the better.
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import sys
from pathlib import Path

import lightfield_gs
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_folder, check_new_folder
from training.command import with_line_errors

# From skimage/data in scikit-image 0.26, with the sources in its docstrings.
_OF_SCIKIT_IMAGE = {
    "astronaut.png": "public domain (NASA)",
    "brick.png": "CC0 (CC0Textures, Bricks25)",
    "camera.png": "CC0 (Lav Varshney)",
    "chelsea.png": "CC0 (Stefan van der Walt)",
    "coffee.png": "CC0 (Rachel Michetti)",
    "grass.png": "CC0 (linolafett)",
    "gravel.png": "CC0 (CC0Textures, Gravel04)",
    "hubble_deep_field.jpg": "public domain (NASA)",
    "retina.jpg": "CC0 (Mikael Haggstrom)",
    "rocket.jpg": "public domain (SpaceX)",
}
_OWN = {
    "banana/images": "MIT, (c) 2019 Piero Toffanin (lightfield_gs/data/banana/LICENSE.txt)",
    "cat.png": "MIT, (c) the authors of LGM (lightfield_gs/data/LICENCES.txt)",
}


def gather_photographs(output: Path) -> int:
    """Makes the folder `output`, complete or not at all; returns how many photographs it has.

    Raises InputError where it exists and is not empty or cannot be written, and where scikit-image is not installed or
    has other files.
    """
    output = check_new_folder(output)
    spec = importlib.util.find_spec("skimage")
    if spec is None or spec.origin is None:
        raise InputError("the photographs come with scikit-image, which is not installed: pip install scikit-image")
    data = Path(spec.origin).parent / "data"
    missing = [name for name in _OF_SCIKIT_IMAGE if not (data / name).is_file()]
    if missing:
        raise InputError(f"{data}: expected {', '.join(missing)} there: pip install 'scikit-image>=0.20'")
    with atomic_folder(output) as temporary:
        lines = _copied(temporary, data, _OF_SCIKIT_IMAGE, "scikit-image/")
        lines += _copied(temporary, Path(lightfield_gs.__file__).parent / "data", _OWN, "lightfield_gs/data/")
        (temporary / "LICENCES.txt").write_text("\n".join(["# file | from | licence", *lines, ""]))
    return len(lines)


def _copied(folder: Path, data: Path, licences: dict[str, str], origin: str) -> list[str]:
    """Copies files, and those in folders, into one folder; returns a line on each."""
    lines = []
    for name, licence in licences.items():
        path = data / name
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            copy = name.split("/")[0] + "-" + file.name if path.is_dir() else file.name
            shutil.copyfile(file, folder / copy)
            lines.append(f"{copy} | {origin}{name} | {licence}")
    return lines


@with_line_errors("training.data.gather_photographs")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.data.gather_photographs",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", type=Path, required=True, help="folder for the photographs")
    options = parser.parse_args(arguments)
    print(f"{options.output}: {gather_photographs(options.output)} photographs")
    return 0


if __name__ == "__main__":
    sys.exit(main())
