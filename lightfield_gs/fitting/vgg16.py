"""The convolutions of VGG-16 (Simonyan & Zisserman 2015), and torchvision's weights of them.

The weights are those of ImageNet in torchvision's own file, in the folder of torch.hub. The package torchvision is not
needed. A file with the 26 tensors of the convolutions alone suffices, in any floating dtype.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.fetch import RemoteFile

WEIGHTS = RemoteFile("https://download.pytorch.org/models/vgg16-397923af.pth", "397923af")
# torchvision's numbers of the convolutions, block by block, with the channels that a block returns
_BLOCKS = (((0, 2), 64), ((5, 7), 128), ((10, 12, 14), 256), ((17, 19, 21), 512), ((24, 26, 28), 512))


class Convolution(NamedTuple):
    """The tensors of a convolution: weight [C,B,3,3] and bias [C]."""

    weight: Tensor
    bias: Tensor


Vgg16 = tuple[tuple[Convolution, ...], ...]  # block by block


def fetch_weights(say: Callable[[str], None]) -> Path:
    """Return the path of torchvision's weights of VGG-16, after a download if there is no such file.

    Args:
        say: called with a line before a download.

    Raises:
        InputError: the file could not be fetched.
    """
    return WEIGHTS.fetched("loss wd needs the weights of VGG-16", "528 MB", "leave the loss at l1-ssim", say)


def read_weights(path: Path, device: torch.device | str = "cpu") -> Vgg16:
    """Read the convolutions from a file, as float32.

    Args:
        path: torchvision's file, or one with the tensors of its convolutions alone.
        device: where to.

    Raises:
        InputError: the file is damaged, or its tensors are not those of VGG-16.
    """
    way_out = f"remove it, and save {WEIGHTS.url} there"
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of the file, its ZIP archive or its pickle: it may be anything
        words = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected the weights of VGG-16, but {words}; {way_out}") from None
    wanted: dict[str, tuple[int, ...]] = {}
    channels = 3
    for numbers, width in _BLOCKS:
        for number in numbers:
            wanted[f"features.{number}.weight"], wanted[f"features.{number}.bias"] = (width, channels, 3, 3), (width,)
            channels = width
    for name, shape in wanted.items():
        found = tensors.get(name) if isinstance(tensors, Mapping) else None
        if not isinstance(found, Tensor) or tuple(found.shape) != shape or not found.is_floating_point():
            got = f"a tensor {list(found.shape)}" if isinstance(found, Tensor) else "none"
            raise InputError(f"{path}: expected a tensor {name} {list(shape)} of VGG-16, got {got}; {way_out}")
    # Convolutions on CUDA are fastest with channels last, the order of images
    own = {name: tensors[name].to(device, torch.float32) for name in wanted}
    return tuple(
        tuple(
            Convolution(
                own[f"features.{number}.weight"].contiguous(memory_format=torch.channels_last),
                own[f"features.{number}.bias"],
            )
            for number in numbers
        )
        for numbers, _ in _BLOCKS
    )


def features(vgg: Vgg16, image: Tensor) -> Iterator[Tensor]:
    """Yield the activations at the end of each block, with averages in place of maxima between blocks.

    Averages keep the texture that maxima would sample (Gatys et al. 2015). Blocks for which an image is too small are
    left out.

    Args:
        vgg: weights, in the dtype of the image and on its device.
        image: [N,3,H,W], normalised as for ImageNet.

    Yields:
        [N,C,H',W'] for each block, sizes halved from one to the next.
    """
    for place, block in enumerate(vgg):
        if place:
            if min(image.shape[2:]) < 2:
                return
            image = functional.avg_pool2d(image, 2)
        for weight, bias in block:
            image = functional.relu(functional.conv2d(image, weight, bias, padding=1))
        yield image
