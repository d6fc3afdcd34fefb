"""Pictures on the planes of compositions: pieces of photographs."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_image

PIECE_PX = 512
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
_SHORTER_PX = (PIECE_PX, 2 * PIECE_PX)  # shorter sides at which a photograph is cut into pieces
_MOST_ENLARGED = 1.8
_MOST_PIECES = 4  # of a photograph at each size: large ones are no more frequent than others
_DARK, _PLAIN = 0.12, 0.03  # less brightness, or less deviation, teaches nothing


def read_pieces(folder: Path, names: list[str]) -> Tensor:
    """Return squares of the photographs in a folder, uint8 [T,3,PIECE_PX,PIECE_PX].

    Args:
        folder: Folder of photographs.
        names: File name patterns of the photographs.

    Raises:
        InputError: there is none, or a file cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of photographs, found no such folder")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
    chosen = [path for path in paths if any(fnmatch(path.name.lower(), name.lower()) for name in names)]
    pieces = [piece for path in chosen for piece in _cut(path)]
    if not pieces:
        raise InputError(
            f"{folder}: expected photographs ({', '.join(_SUFFIXES)}) that match {', '.join(names)}, found none of "
            f"{len(paths)} that is large and bright enough"
        )
    return torch.stack(pieces)


def _cut(path: Path) -> list[Tensor]:
    """Return squares of a photograph, side by side, at each size that it can fill."""
    pixels = read_image(path)
    pixels = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else pixels
    image = torch.from_numpy(np.ascontiguousarray(pixels, np.float32)).movedim(2, 0)
    image = image[:3] if len(image) >= 3 else image[:1].expand(3, -1, -1)
    found = []
    for shorter in _SHORTER_PX:
        factor = shorter / min(image.shape[1:])
        if factor > _MOST_ENLARGED:
            continue
        size = [max(PIECE_PX, round(side * factor)) for side in image.shape[1:]]
        scaled = F.interpolate(image[None], size=size, mode="bilinear", antialias=True)[0]
        rows, columns = (side // PIECE_PX for side in size)
        before = len(found)
        for place in range(rows * columns):
            y, x = PIECE_PX * (place // columns), PIECE_PX * (place % columns)
            piece = scaled[:, y : y + PIECE_PX, x : x + PIECE_PX]
            if len(found) == before + _MOST_PIECES or piece.mean() < _DARK or piece.std() < _PLAIN:
                continue
            found.append((255 * piece.clamp(0, 1)).round().to(torch.uint8))
    return found
