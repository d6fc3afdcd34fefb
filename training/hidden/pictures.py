"""Pictures on the planes of compositions: pieces of photographs, and made-up ones of leaves that lie on each other.

The leaves follow the statistics of natural pictures: edges at all scales, occlusion, smooth shading (Lee, Mumford and
Huang, "Occlusion models for natural images", 2001). They are as many as wanted, which photographs at hand are not.
"""

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
_LEAVES = 220  # of a made-up picture
_AT_ONCE = 32  # made-up pictures: a gigabyte for a moment


def read_pieces(folder: Path, patterns: list[str], held_out: bool) -> Tensor:
    """Return squares of the photographs in a folder, uint8 [T,3,PIECE_PX,PIECE_PX].

    Args:
        folder: Folder of photographs.
        patterns: File name patterns of the photographs that training never sees.
        held_out: Whether those are wanted, or all others.

    Raises:
        InputError: there is none, or a file cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of photographs, found no such folder")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
    chosen = [path for path in paths if any(fnmatch(path.name.lower(), p.lower()) for p in patterns) == held_out]
    pieces = [piece for path in chosen for piece in _cut(path)]
    if not pieces:
        raise InputError(
            f"{folder}: expected photographs ({', '.join(_SUFFIXES)}) {'that' if held_out else 'that do not'} match "
            f"{', '.join(patterns) or 'any pattern'}, found none of {len(paths)} that is large and bright enough"
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


def make_leaves(count: int, seed: int, device: torch.device) -> Tensor:
    """Return made-up pictures, uint8 [count,3,PIECE_PX,PIECE_PX], the same for the same seed."""
    parts = [
        _leaves(min(_AT_ONCE, count - start), np.random.default_rng((seed, start)), device)
        for start in range(0, count, _AT_ONCE)
    ]
    return torch.cat(parts) if parts else torch.zeros(0, 3, PIECE_PX, PIECE_PX, dtype=torch.uint8, device=device)


def _leaves(count: int, rng: np.random.Generator, device: torch.device) -> Tensor:
    def numbers(*shape: int) -> Tensor:
        return torch.from_numpy(rng.random((count, *shape), np.float32)).to(device)

    grid = (torch.arange(PIECE_PX, device=device) + 0.5) / PIECE_PX
    y, x = grid[:, None], grid[None]
    palette = numbers(5, 3)
    # Few pictures have all colours: most are near one hue
    palette = torch.lerp(palette, palette[:, :1].expand_as(palette), 0.3 + 0.7 * numbers(1, 1))
    one, other = palette[:, 0], palette[:, 1]
    image = torch.lerp(one[..., None, None], other[..., None, None], ((x + y) / 2).expand(count, 1, -1, -1))
    # Radii between 4 and 200 px, as many of each octave by area
    least, most = 4 / PIECE_PX, numbers() * 0.3 + 0.08
    for _ in range(_LEAVES):
        u = numbers(16)[..., None, None]
        radius = 1 / (u[:, 0] * (1 / least - 1 / most[:, None, None]) + 1 / most[:, None, None])
        angle = torch.pi * u[:, 1]
        dx, dy = x - (1.2 * u[:, 2] - 0.1), y - (1.2 * u[:, 3] - 0.1)
        along, across = torch.cos(angle) * dx + torch.sin(angle) * dy, torch.cos(angle) * dy - torch.sin(angle) * dx
        across = across * (1 + 5 * u[:, 4].square())  # long and round ones
        distance = torch.where(u[:, 5] < 0.5, torch.hypot(along, across), torch.maximum(along.abs(), across.abs()))
        inside = ((radius - distance) * PIECE_PX + 0.5).clamp(0, 1)[:, None]
        colour = palette[torch.arange(count, device=device), (5 * u[:, 6, 0, 0]).long()] + 0.25 * (
            u[:, 7:10, 0, 0] - 0.5
        )
        wave = torch.sin(along * 2 * torch.pi * (10 + 70 * u[:, 10]))
        shade = 0.3 * (u[:, 11] - 0.5) * along / radius + torch.where(u[:, 12] < 0.3, 0.2 * u[:, 13] * wave, 0)
        image = torch.lerp(image, (colour[..., None, None] + shade[:, None]).clamp(0, 1), inside)
    grain = torch.from_numpy(rng.standard_normal((count, 1, PIECE_PX, PIECE_PX), np.float32)).to(device)
    image = image + 0.04 * numbers(1, 1, 1).square() * grain
    return (255 * image.clamp(0, 1)).round().to(torch.uint8)
