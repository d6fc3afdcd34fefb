"""Photographs as the skin of random objects: pieces of them, and how a part wears one.

A part repeats one piece in mirror images along the two local axes that its surface faces least. These are three
projections with seams between them, as in many models of games.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_image
from training.data.superquadrics import named
from training.data.uniform import Numbers

PIECE_PX = 256
# Numbers of a part's skin. piece: its number. density: pieces per scene unit. cosine, sine: of its turn. place: of its
# corner, pieces. tint: fraction of the part's two colours, mixed by the piece's brightness, in place of its own. order:
# which channel each channel shows. gamma: of its colours. weight: of the skin in the part's colour, 0 for none.
SKIN = {"piece": 1, "density": 1, "cosine": 1, "sine": 1, "place": 2, "tint": 1, "order": 3, "gamma": 1, "weight": 1}
_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
_SHORTER_PX = 2 * PIECE_PX  # a photograph's shorter side, where it is longer
_PLAIN, _DARK, _OPAQUE = 5 / 255, 0.1, 0.98  # less deviation or brightness, or fewer opaque pixels, make no skin
_GREY = 2 / 255  # mean difference of the channels, below which a piece has no colours


class Photographs:
    """Pieces of photographs, uint8 [T,PIECE_PX,PIECE_PX,3], on the device that asks for them.

    grey: which of them have no colours, bool [T], on the host.
    """

    def __init__(self, pieces: Tensor) -> None:
        self._pieces = pieces
        spread = (pieces.amax(-1).int() - pieces.amin(-1).int()).float().mean((1, 2)) / 255
        self.grey = (spread < _GREY).cpu().numpy()

    def __len__(self) -> int:
        return len(self._pieces)

    def on(self, device: torch.device) -> Tensor:
        """The pieces, copied once."""
        if self._pieces.device != device:
            self._pieces = self._pieces.to(device)
        return self._pieces


def read_photographs(folder: Path) -> Photographs:
    """Pieces of all photographs at or below a folder: squares side by side, but for plain and transparent ones.

    Larger photographs are reduced first, so that a piece shows things and not grain. Raises InputError where there is
    none of PIECE_PX or more, and for files that cannot be read.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of photographs, found no such folder")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
    pieces = [piece for path in paths for piece in _cut_pieces(path)]
    if not pieces:
        raise InputError(
            f"{folder}: expected photographs of {PIECE_PX} px or more on each side ({', '.join(_SUFFIXES)}), found "
            f"{len(paths)} files of which none will do"
        )
    return Photographs(torch.stack(pieces))


def _cut_pieces(path: Path) -> list[Tensor]:
    """The pieces of one photograph, uint8 [PIECE_PX,PIECE_PX,3]."""
    pixels = read_image(path)
    pixels = pixels.astype(np.float32) / np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else pixels
    image = torch.from_numpy(np.ascontiguousarray(pixels, np.float32)).permute(2, 0, 1)
    if image.shape[0] < 3:
        image = torch.cat([image[:1].expand(3, -1, -1), image[1:]])
    shorter = min(image.shape[1:])
    if shorter > _SHORTER_PX:
        size = [max(PIECE_PX, round(side * _SHORTER_PX / shorter)) for side in image.shape[1:]]
        image = F.interpolate(image[None], size=size, mode="bilinear", antialias=True)[0]
    found = []
    rows, columns = (side // PIECE_PX for side in image.shape[1:])
    top, left = ((side % PIECE_PX) // 2 for side in image.shape[1:])
    for row in range(rows):
        for column in range(columns):
            y, x = top + PIECE_PX * row, left + PIECE_PX * column
            piece = image[:, y : y + PIECE_PX, x : x + PIECE_PX]
            opaque = len(piece) < 4 or bool((piece[3] > 0.99).float().mean() >= _OPAQUE)
            brightness = piece[:3].mean(0)
            if opaque and bool((brightness.std() >= _PLAIN) & (brightness.mean() >= _DARK)):
                found.append((255 * piece[:3].clamp(0, 1)).round().to(torch.uint8).permute(1, 2, 0).contiguous())
    return found


def draw_skin(u: Numbers, group: np.ndarray, groups: int, photographs: Photographs) -> np.ndarray:
    """Return the skins [B,P,F] in the order of SKIN; all parts of a group wear the same.

    Most grey pieces are tinted: few things are grey.

    Args:
        group: [B,P], each less than `groups`.
    """
    turn = u.chosen([0.0, 0.5, 1.0, 1.5], [0.25] * 4, groups) * np.pi
    turn = np.where(u(groups) < 0.4, u.between(0, 2 * np.pi, groups), turn)
    piece = np.floor(len(photographs) * u(groups)).astype(int)
    untinted = u(groups) < np.where(photographs.grey[piece], 0.15, 0.5)
    table = {
        "piece": piece,
        "density": np.exp(u.between(np.log(0.8), np.log(3.5), groups)),
        "cosine": np.cos(turn),
        "sine": np.sin(turn),
        "place": u.between(0, 2, groups, 2),
        "tint": np.where(untinted, 0, u.between(0.3, 1.2, groups).clip(0, 1)),
        "order": np.where(u(groups, 1) < 0.6, np.arange(3), np.argsort(u(groups, 3), -1)),
        "gamma": np.exp(u.between(-0.7, 0.3, groups)),
        "weight": np.where(u(groups) < 0.75, 1, 0),
    }
    columns = [table[name].reshape(*table["piece"].shape, count) for name, count in SKIN.items()]
    return np.take_along_axis(np.concatenate(columns, -1), group[..., None], 1)


def worn(skin: Tensor, pieces: Tensor, local: Tensor, facing: Tensor, base: Tensor, second: Tensor) -> Tensor:
    """Return colours [B,N,3] where skins [B,N,F] (order of SKIN) lie on points `local` [B,N,3] of parts.

    A colour is the bilinear mean of four pixels.

    Args:
        pieces: Pieces of Photographs.
        facing: [B,N,3], outward normals in the same axes.
        base, second: [B,N,3], the part's own two colours.
    """
    numbers, axis = named(skin, SKIN), facing.abs().argmax(-1, keepdim=True)
    x, y = (local.gather(-1, (axis + step) % 3).squeeze(-1) for step in (1, 2))
    across = numbers["density"] * (numbers["cosine"] * x - numbers["sine"] * y) + numbers["place"][..., 0]
    down = numbers["density"] * (numbers["sine"] * x + numbers["cosine"] * y) + numbers["place"][..., 1]
    colour = _looked_up(pieces, numbers["piece"].long(), across, down)
    colour = colour.gather(-1, numbers["order"].long()).pow(numbers["gamma"][..., None])
    tinted = torch.lerp(base, second, colour.mean(-1, keepdim=True)) * (0.5 + colour.mean(-1, keepdim=True))
    return torch.lerp(colour, tinted, numbers["tint"][..., None]).clamp(0, 1)


def _looked_up(pieces: Tensor, piece: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Colours [...,3], 0..1, of places [...] in pieces, repeated in mirror images."""
    side = pieces.shape[1]
    flat = pieces.view(-1, 3)
    (left, right, x), (top, bottom, y) = (_neighbours(place, side) for place in (across, down))
    rows = [(side * piece + row) * side for row in (top, bottom)]
    upper, lower = (torch.lerp(flat[row + left].float(), flat[row + right].float(), x[..., None]) for row in rows)
    return torch.lerp(upper, lower, y[..., None]) / 255


def _neighbours(place: Tensor, side: int) -> tuple[Tensor, Tensor, Tensor]:
    """The two pixels about a place (in pieces, mirrored beyond 0..1), and how far it is on the way between them."""
    pixel = ((1 - (1 - place.remainder(2)).abs()) * side - 0.5).clamp(0, side - 1)
    first = pixel.floor().clamp_max(side - 2)
    return first.long(), first.long() + 1, pixel - first
