"""Objects before a plain background, cut out of picture after picture: a few milliseconds for each.

A small picture tells which part is the object, as for a photo. How much of each pixel is the object, and its colour
without the background's, is a formula of the pixel and of the object's own colour close by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from lightfield_gs.base.errors import InputError
from lightfield_gs.models.crop import MARGIN
from lightfield_gs.photo.cut_out import is_empty
from lightfield_gs.photo.foreground import mixed_alpha
from lightfield_gs.photo.image_filters import max_filter
from lightfield_gs.photo.plain import alpha_of_distance, plain_outline

_SMALL_PX = 320  # longer side of the small picture
_EDGE_PX = 1  # pixels of the small picture on either side of an outline that may be mixtures
_OWN_PX = 3  # reach of the means of the object's own colours, pixels of the small picture
_FAINT = 0.25  # share below which a pixel takes the object's own colour close by: its own is mostly noise


@dataclass(frozen=True)
class Outline:
    """What a small picture tells.

    Attributes:
        small: The small picture, [h, w, 3], floats in 0..1.
        inside: bool [h, w], its pixels that are the object.
        backdrop: `PlainBackground.colours`.
    """

    small: Tensor
    inside: Tensor
    backdrop: Tensor

    def to(self, device: torch.device | str) -> Outline:
        """Return it on a device."""
        return Outline(*(part.to(device) for part in vars(self).values()))

    def box(self, height: int, width: int) -> tuple[slice, slice]:
        """Return the rows and columns of the object in the picture of this size, with room for the network's crop."""
        rows, columns = (np.flatnonzero(self.inside.any(axis).cpu().numpy()) for axis in (1, 0))
        scales = height / self.inside.shape[0], width / self.inside.shape[1]
        sides = (rows[0], rows[-1] + 1), (columns[0], columns[-1] + 1)
        room = MARGIN * max(scale * (high - low) for (low, high), scale in zip(sides, scales))
        spans = [
            slice(
                max(0, int((low - _EDGE_PX) * scale - room)), min(size, int(np.ceil((high + _EDGE_PX) * scale + room)))
            )
            for (low, high), scale, size in zip(sides, scales, (height, width))
        ]
        return spans[0], spans[1]


def find_outline(pixels: np.ndarray, name: str) -> Outline:
    """Find the object in a picture, uint8 [H, W, 3]. Raises InputError where it has none, or no plain background."""
    small = np.array(Image.fromarray(pixels).reduce(max(1, round(max(pixels.shape) / _SMALL_PX))))
    found = plain_outline(small)
    if found is None:
        raise InputError(f"{name} has no cut-out and no plain background")
    inside, backdrop = found
    if is_empty(inside):
        raise InputError(f"{name}: its background looks plain and nothing stands out from it")
    return Outline(torch.from_numpy(small).float() / 255, torch.from_numpy(inside), torch.from_numpy(backdrop))


@torch.no_grad()
def cut_along(picture: Tensor, outline: Outline, box: tuple[slice, slice] | None = None) -> Tensor:
    """Return the object, uint8 [h, w, 4] with straight alpha, without the background's colour.

    Args:
        picture: uint8 [H, W, 3], on the outline's device.
        outline: Of this picture.
        box: Its part that is returned. None: all of it.
    """
    height, width = picture.shape[:2]
    rows, columns = (slice(0, height), slice(0, width)) if box is None else box
    inside = outline.inside.float()
    core, reach = -max_filter(-inside, _EDGE_PX), max_filter(inside, _EDGE_PX)
    maps = torch.cat([core[None], reach[None], _own_colours(outline.small, core)])
    maps = interpolate(maps[None], size=(height, width), mode="bilinear", align_corners=False)[0, :, rows, columns]
    core, reach, own = maps[0], maps[1], maps[2:]
    down = torch.linspace(-1, 1, height, device=picture.device)[rows, None]
    across = torch.linspace(-1, 1, width, device=picture.device)[columns]
    behind = outline.backdrop[:, :, None, None]
    behind = behind[0] + down * behind[1] + across * behind[2]
    colours = picture[rows, columns].movedim(2, 0) / 255
    seen = colours - behind
    share = mixed_alpha(seen, own - behind, alpha_of_distance(seen.square().sum(0).sqrt()))
    alpha = torch.where(core >= 1, 1.0, torch.where(reach > 0, share, 0.0))
    # What the background leaves of the pixel's colour is the object's
    rest = behind + seen / alpha.clamp(min=_FAINT)
    trust = (alpha / _FAINT - 1).clamp(0, 1)
    rgb = torch.where(alpha < 1, torch.lerp(own, rest.clamp(0, 1), trust), colours)
    return (255 * torch.cat([rgb, alpha[None]])).round().to(torch.uint8).movedim(0, 2).contiguous()


def _own_colours(small: Tensor, core: Tensor) -> Tensor:
    """Return the mean colour of the object close to each pixel, [3, h, w]; far from it, of all of it."""
    known = small.movedim(2, 0) * core
    side = 2 * _OWN_PX + 1
    sums = avg_pool2d(torch.cat([known, core[None]])[None], side, 1, _OWN_PX)[0]
    mean = known.sum((1, 2)) / core.sum().clamp(min=1)
    return torch.where(sums[3] > 0, sums[:3] / sums[3].clamp(min=1e-6), mean[:, None, None])
