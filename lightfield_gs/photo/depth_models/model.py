"""What every network for depths offers, whoever wrote it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth import far_distance

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's colours, which most of them expect
_FARTHEST = 0.99  # quantile of the distances that counts as the farthest: single pixels at edges are wrong


class Prediction(NamedTuple):
    """The numbers of a network for a picture.

    Attributes:
        values: [h, w], float32, about as large as the picture that it saw.
        focal: Focal length by the picture's width; None where the network does not estimate it.
        sky: Fraction 0..1 of the picture that is sky, put behind everything.
    """

    values: Tensor
    focal: float | None = None
    sky: float = 0.0


class DepthModel(Protocol):
    """A network for depths.

    Attributes:
        family: Its name, for messages.
        kind: Of its numbers, unless the user says otherwise; None: nobody knows.
        at_once: Pictures of a video that it wants to see together.
    """

    family: str
    kind: DepthKind | None
    at_once: int

    def shrink(self, pixels: np.ndarray) -> np.ndarray:
        """Return a picture, uint8 [H, W, 3], at the size that the network sees."""

    def predict(self, pictures: list[np.ndarray]) -> list[Prediction]:
        """Return the numbers of pictures in a row, as `shrink` returns them."""


def resized(
    pixels: np.ndarray, height: int, width: int, how: Image.Resampling = Image.Resampling.BICUBIC
) -> np.ndarray:
    """Return a picture, uint8 [H, W, 3], at another size."""
    return np.asarray(Image.fromarray(pixels).resize((width, height), how))


def normalized(
    pictures: list[np.ndarray], device: torch.device, mean: Sequence[float] = _MEAN, std: Sequence[float] = _STD
) -> Tensor:
    """Return pictures, uint8 [h, w, 3] of one size, as [B, 3, h, w], from which the mean is taken, by the deviation."""
    images = torch.from_numpy(np.stack(pictures)).to(device).float().movedim(3, 1) / 255
    middle, unit = (torch.tensor(tuple(values), device=device)[:, None, None] for values in (mean, std))
    return (images - middle) / unit


def with_sky(distances: Tensor, is_sky: Tensor, focal: float | None = None) -> Prediction:
    """Return a prediction whose sky is behind everything else.

    Args:
        distances: [h, w].
        is_sky: bool [h, w].
        focal: See Prediction.
    """
    sky = float(is_sky.double().mean())
    if 0 < sky < 1:
        rest = distances[~is_sky].sort().values
        farthest = float(rest[round(_FARTHEST * (len(rest) - 1))])
        distances = torch.where(is_sky, far_distance(farthest), distances)
    return Prediction(distances, focal, sky)
