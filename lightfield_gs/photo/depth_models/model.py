"""What every network for depths offers, whoever wrote it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.nn.functional import interpolate

from lightfield_gs.base.device import capture_graph
from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth import far_distance

Pixels = np.ndarray | Tensor  # a picture, uint8 [H, W, 3]; tensors on the network's device stay there
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
        never_waits: Whether `predict` of tensors on CUDA never waits for them, so that a graph can hold its launches.
    """

    family: str
    kind: DepthKind | None
    at_once: int
    never_waits: bool

    def shrink(self, pixels: Pixels, shorter_px: int | None = None) -> Pixels:
        """Return a picture at the size that the network sees.

        Args:
            pixels: The picture.
            shorter_px: Its shorter side at most, about. Networks of one size do not heed it.
        """

    def predict(self, pictures: Sequence[Pixels]) -> list[Prediction]:
        """Return the numbers of pictures in a row, as `shrink` returns them."""


class ReplayedModel:
    """The numbers of pictures in a row, on CUDA by one graph where the network never waits.

    The graph computes in TF32: a network of the size of Depth Anything V2 Small takes 9.2 ms on an H200 so, not 13.1,
    and of random weights its numbers move by 7e-4 of the largest at most.

    Args:
        network: The network.
    """

    def __init__(self, network: DepthModel) -> None:
        self._network = network
        self._seen: Tensor | None = None

    def predict(self, pictures: Sequence[Pixels]) -> list[Prediction]:
        """Return the numbers, as DepthModel.predict does."""
        first = pictures[0]
        if len(pictures) > 1 or isinstance(first, np.ndarray) or not (first.is_cuda and self._network.never_waits):
            return self._network.predict(pictures)
        if self._seen is None or self._seen.shape != first.shape:
            self._seen = seen = first.clone()
            with _tf32():
                self._graph, self._found = capture_graph(lambda: self._network.predict([seen]), warm_up=True)
        self._seen.copy_(first)
        self._graph.replay()
        return [part._replace(values=part.values.clone()) for part in self._found]


@contextmanager
def _tf32() -> Iterator[None]:
    products, before = torch.backends.cuda.matmul, torch.backends.cuda.matmul.allow_tf32
    products.allow_tf32 = True
    try:
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=True):
            yield
    finally:
        products.allow_tf32 = before


def as_tensor(pixels: Pixels) -> Tensor:
    """Return a picture as a tensor, where it is."""
    return torch.from_numpy(np.array(pixels)) if isinstance(pixels, np.ndarray) else pixels


def resized(pixels: Pixels, height: int, width: int, how: Image.Resampling = Image.Resampling.BICUBIC) -> Pixels:
    """Return a picture at another size."""
    if isinstance(pixels, np.ndarray):
        return np.asarray(Image.fromarray(pixels).resize((width, height), how))
    channels = pixels.movedim(2, 0)[None].float()
    smaller = interpolate(channels, size=(height, width), mode=how.name.lower(), antialias=True, align_corners=False)
    return smaller[0].round().clamp(0, 255).to(torch.uint8).movedim(0, 2)


def normalized(
    pictures: Sequence[Pixels], device: torch.device, mean: Sequence[float] = _MEAN, std: Sequence[float] = _STD
) -> Tensor:
    """Return pictures of one size as [B, 3, h, w], in 0..1, without the mean and by the standard deviation."""
    images = torch.stack([as_tensor(part) for part in pictures]).to(device).float().movedim(3, 1) / 255
    middle, unit = (_per_channel(tuple(values), device) for values in (mean, std))
    return (images - middle) / unit


@lru_cache
def _per_channel(values: tuple[float, ...], device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        return torch.tensor(values, device=device)[:, None, None]


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
