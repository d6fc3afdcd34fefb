"""Draw photos and demos as three eyes see them, before and after a change, and the sheets of the pages.

`python benchmarks/pictures.py --photos FOLDER --before CHECKOUT` draws with the default options of CHECKOUT and of this
checkout. Both need their native module. Drawings of a commit are kept and not made again.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from lightfield_gs.io.atomic import atomic_path

ROOT = Path(__file__).resolve().parents[1]
EYES = "--eyes=-536,536,3"  # 15 degrees to the left, in the middle, 15 degrees to the right, at 2 m
DEMOS = ("scene", "depth")  # the demo's third picture is of one of the photos
GAP_PX = 12
CELL_PX = (320, 360)  # height and width of a picture on the front page
MOST_BYTES = 390_000
QUALITIES = (85, 75, 65, 60, 55, 45, 35)
FRONT = ("catstatue_rgba", "bird_rgba", "chair", "robot", "hamburger")  # of README.md
DETAILED = ("horse", "hamburger")  # with and without detail


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, required=True, help="folder of cut-out photos, .png")
    parser.add_argument("--before", type=Path, required=True, help="checkout of the earlier commit")
    parser.add_argument("--drawings", type=Path, default=ROOT / "build/pictures", help="folder of what the eyes see")
    parser.add_argument("--pages", type=Path, default=ROOT / "docs/pictures", help="folder of the sheets")
    parser.add_argument("--private", default="", help="photos, by name, of which no sheet is made: NAME,NAME")
    given = parser.parse_args()
    private = set(filter(None, given.private.split(",")))
    photos = {path.name.split(".")[0]: path for path in sorted(given.photos.glob("*.png"))}
    before = draw_all(given.before, photos, given.drawings)
    after = draw_all(ROOT, photos, given.drawings)
    for name in DETAILED:
        draw(ROOT, photos[name], after / f"{name}-none.png", ["--detail", "none"])
    shown = [name for name in (*photos, *DEMOS) if name not in private]
    for name in (*photos, *DEMOS):
        folder = given.drawings / "private" if name in private else given.pages
        folder.mkdir(exist_ok=True)
        save(beside(eyes(before / f"{name}.png"), eyes(after / f"{name}.png")), folder / f"side-{name}.webp")
    rows = [[strip(eyes(folder / f"{name}.png"), 780) for folder in (before, after)] for name in shown]
    save(stack([stack(row, 1) for row in rows], 0), given.pages / "defaults.webp")
    cells = [np.concatenate([thumbnail(photos[name]), front(eyes(after / f"{name}.png"))], 1) for name in FRONT]
    save(stack(cells, 0), given.pages / "photos.webp")
    pairs = [strip(eyes(after / f"{name}{kind}.png"), 1400, True) for name in DETAILED for kind in ("-none", "")]
    save(stack(pairs, 0), given.pages / "detail.webp")


def draw_all(checkout: Path, photos: dict[str, Path], drawings: Path) -> Path:
    """Draw photos and the demos of a checkout, with its default options.

    Args:
        checkout: Its package and Makefile are used.
        photos: Files by their names.
        drawings: Folder; what is there already of the same commit is kept.

    Returns:
        The commit's folder, with NAME.png: what the eyes see, side by side.
    """
    commit = output("git", "-C", checkout, "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*")
    folder = drawings.resolve() / commit
    folder.mkdir(parents=True, exist_ok=True)
    if commit.endswith("-dirty"):
        for path in folder.iterdir():
            path.unlink()
    for name, path in photos.items():
        draw(checkout, path, folder / f"{name}.png")
    if not all((folder / f"{name}.png").exists() for name in DEMOS):
        program = folder / "lightfield-gs"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -m lightfield_gs "$@"\n')
        program.chmod(0o755)
        call(checkout, "make", "-o", "setup", "demo", f"BIN={folder}")
        for name in DEMOS:
            (checkout / f"demo/{name}-eyes.png").replace(folder / f"{name}.png")
    return folder


def draw(checkout: Path, photo: Path, to: Path, options: list[str] | None = None) -> None:
    """Encode a photo for the default panel, and write what three eyes see of it to a file, unless it is there."""
    if to.exists():
        return
    print(f"{to.parent.name}: {to.stem}", file=sys.stderr)
    image = to.with_suffix(".panel.png")
    program = (sys.executable, "-m", "lightfield_gs")
    call(checkout, *program, "encode", photo.resolve(), "-o", image, *(options or []))
    with atomic_path(to) as path:
        call(checkout, *program, "simulate", image, EYES, "-o", path)
    image.unlink()


def call(checkout: Path, *command: str | Path) -> None:
    """Run a command with the package of a checkout."""
    subprocess.run(command, cwd=checkout, env=os.environ | {"PYTHONPATH": str(checkout.resolve())}, check=True)


def output(*command: str | Path) -> str:
    """Return what a command prints."""
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def eyes(path: Path) -> list[np.ndarray]:
    """Return the pictures [H, W, 3] of three eyes from a file where they lie side by side."""
    return np.split(np.asarray(Image.open(path).convert("RGB")), 3, 1)


def box(pictures: list[np.ndarray]) -> tuple[slice, slice]:
    """Return the rows and columns of an object in any of the pictures; of a scene, all."""
    ground = [picture[:1, :1].astype(int) for picture in pictures]
    other = [np.abs(picture - colour).max(2) > 12 for picture, colour in zip(pictures, ground, strict=True)]
    found = np.any(other, 0)
    if max(found[0].mean(), found[:, 0].mean()) > 0.1:
        return slice(None), slice(None)
    rows, columns = (np.flatnonzero(found.any(axis)) for axis in (1, 0))
    sides = (slice(max(0, at[0] - GAP_PX), at[-1] + 1 + GAP_PX) for at in (rows, columns))
    down, across = sides
    return down, across


def beside(before: list[np.ndarray], after: list[np.ndarray]) -> np.ndarray:
    """Return the eyes side by side at their own resolution, before above after, cut to the object."""
    part = box([*before, *after])
    return stack([stack([picture[part] for picture in pictures], 1) for pictures in (before, after)], 0)


def strip(pictures: list[np.ndarray], width_px: int, cut: bool = False) -> np.ndarray:
    """Return three pictures side by side, cut to the object or whole, this wide together."""
    joined = np.concatenate([picture[box(pictures)] if cut else picture for picture in pictures], 1)
    return resized(joined, width_px)


def front(pictures: list[np.ndarray]) -> np.ndarray:
    """Return what three eyes see of an object, each in a cell of the front page, on its own background."""
    part = box(pictures)
    return np.concatenate([in_cell(picture[part], picture[0, 0]) for picture in pictures], 1)


def thumbnail(photo: Path) -> np.ndarray:
    """Return the object of a photo in a cell of the front page, on white."""
    image = Image.open(photo).convert("RGBA")
    flat = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    is_there = image.getchannel("A").point(lambda alpha: 255 * (alpha > 127))
    white = np.full(3, 255, np.uint8)
    return in_cell(np.asarray(flat.crop(is_there.getbbox()).convert("RGB")), white)


def in_cell(picture: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return a picture as large as a cell with its margins can show it, in the middle of a ground."""
    height, width = picture.shape[:2]
    scale = min((part - 2 * GAP_PX) / size for part, size in zip(CELL_PX, (height, width), strict=True))
    small = resized(picture, round(scale * width))
    cell = np.broadcast_to(ground, (*CELL_PX, 3)).copy()
    top, left = ((part - size) // 2 for part, size in zip(CELL_PX, small.shape, strict=False))
    cell[top : top + small.shape[0], left : left + small.shape[1]] = small
    return cell


def resized(picture: np.ndarray, width_px: int) -> np.ndarray:
    """Return a picture at another width."""
    height, width = picture.shape[:2]
    return np.asarray(
        Image.fromarray(picture).resize((width_px, round(height * width_px / width)), Image.Resampling.LANCZOS)
    )


def stack(pictures: list[np.ndarray], axis: int) -> np.ndarray:
    """Return pictures below (0) or beside (1) each other, with a grey line between."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP_PX // 4
    line = np.full(shape, 128, np.uint8)
    parts = [part for picture in pictures for part in (line, picture)]
    return np.concatenate(parts[1:], axis)


def save(picture: np.ndarray, path: Path) -> None:
    """Write a WebP of the best quality that has not too many bytes."""
    for quality in QUALITIES:
        with atomic_path(path) as temporary:
            Image.fromarray(picture).save(temporary, "webp", quality=quality, method=6)
        if path.stat().st_size <= MOST_BYTES:
            break
    print(f"{path.name}: {picture.shape[1]} x {picture.shape[0]}, {path.stat().st_size} bytes, quality {quality}")


if __name__ == "__main__":
    main()
