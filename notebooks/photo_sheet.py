"""A sheet of photos and what eyes see of them on the panel: `python notebooks/photo_sheet.py PHOTO... -o sheet.webp`.

A row per photo: the photo, then what an eye at each angle sees through the lenses of the encoded 8K image.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from PIL import Image
from tqdm import tqdm

from lightfield_gs import Panel, PhotoEncoder, SplatterNet, load_photo
from lightfield_gs.panels.simulate import simulate
from lightfield_gs.show.preview import to_integers

TILE_PX = 360
WHITE = 250  # of 255, and above


def on_white(rgba: np.ndarray) -> np.ndarray:
    """Straight RGBA floats [H,W,4] over white, uint8 [H,W,3]."""
    return to_integers(rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:], 8)


def fitting(images: list[np.ndarray], width_per_height: float) -> float:
    """The height, at most 1, in tiles, at which none of these images of one true shape loses what is not white."""
    columns = np.flatnonzero((np.min(images, axis=0) < WHITE).any(axis=(0, 2)))
    half = images[0].shape[1] / 2
    return min(1.0, half / max(half - columns.min(), columns.max() + 1 - half) / width_per_height)


def tile(image: np.ndarray, width_per_height: float = 1.0, height: float = 1.0) -> Image.Image:
    """The middle square of an image whose true shape is width_per_height, as a tile; height: of the image, in tiles."""
    size = round(TILE_PX * height * width_per_height), round(TILE_PX * height)
    picture = Image.fromarray(image).resize(size, Image.Resampling.LANCZOS)
    square = Image.new("RGB", (TILE_PX, TILE_PX), "white")
    square.paste(picture, tuple((TILE_PX - length) // 2 for length in size))
    return square


def main() -> None:
    """Writes the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+", help="pictures of objects: RGBA, or on a plain background")
    parser.add_argument("-o", "--output", required=True, help="the sheet, in any format that Pillow writes")
    parser.add_argument("--panel", default="65in-8k-96v", help="name or file (default: %(default)s)")
    parser.add_argument("--device-serial", help="which display, where a Looking Glass .json has several")
    parser.add_argument(
        "--angles",
        type=float,
        nargs="+",
        default=[-15.0, 0.0, 15.0],
        help="of the eyes, degrees from the panel's axis, right positive (default: -15 0 15)",
    )
    options = parser.parse_args()
    panel = Panel.load(options.panel, serial=options.device_serial)
    encoder = PhotoEncoder(SplatterNet.from_pretrained(), panel)
    shape = panel.width_px / panel.height_px
    sheet = Image.new("RGB", ((1 + len(options.angles)) * TILE_PX, len(options.photos) * TILE_PX), "white")
    for row, path in enumerate(tqdm(options.photos, unit="photo")):
        photo = load_photo(path)
        image = encoder(photo).cpu().numpy()
        seen = []
        for angle in options.angles:
            eye = (panel.viewing_distance_mm * math.tan(math.radians(angle)), 0.0, panel.viewing_distance_mm)
            seen.append(to_integers(simulate(image, panel, eye), 8))
        height = fitting(seen, shape)
        tiles = [
            tile(on_white(photo), photo.shape[1] / photo.shape[0]),
            *(tile(picture, shape, height) for picture in seen),
        ]
        for column, picture in enumerate(tiles):
            sheet.paste(picture, (column * TILE_PX, row * TILE_PX))
    sheet.save(options.output, quality=93, method=6)


if __name__ == "__main__":
    main()
