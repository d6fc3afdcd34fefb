"""Draw the sheet of a camera roll: each photo of a folder, and what three eyes see of it with default options.

`python -m benchmarks.camera_roll FOLDER` takes NAME.png with NAME.depth.npy, the distances that a network would
estimate, where it is there. Drawings of a commit are kept and not made again.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from benchmarks.pictures import ROOT, draw, eyes, output, save, stack

PANEL = ("--panel", "65in-8k-96v")
CELL_PX = (300, 200)  # width and height of a photo's own picture
EYES_PX = 400  # width of one eye's picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of photos, .png, in the order of their names")
    parser.add_argument("--drawings", type=Path, default=ROOT / "build/pictures", help="folder of what the eyes see")
    parser.add_argument("--sheet", type=Path, default=ROOT / "docs/pictures/camera-roll.webp", help="the sheet")
    given = parser.parse_args()
    commit = output("git", "-C", ROOT, "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*")
    drawings = given.drawings.resolve() / f"{commit}-roll"
    drawings.mkdir(parents=True, exist_ok=True)
    rows = []
    for photo in sorted(given.folder.glob("*.png")):
        depth = photo.with_suffix(".depth.npy")
        seen = drawings / photo.name
        draw(ROOT, photo, seen, [*PANEL, *(["--depth", str(depth.resolve())] if depth.exists() else [])])
        cell = ImageOps.pad(Image.open(photo).convert("RGB"), CELL_PX, color="white")
        row = np.concatenate([np.asarray(Image.fromarray(eye).resize((EYES_PX, CELL_PX[1]))) for eye in eyes(seen)], 1)
        rows.append(stack([np.asarray(cell), row], 1))
    save(stack(rows, 0), given.sheet)


if __name__ == "__main__":
    main()
