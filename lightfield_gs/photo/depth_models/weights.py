"""The weights of a network by their names, and the layers that they make."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.base.errors import InputError


class WrongWeights(Exception):
    """Weights are not those of their family."""


class Weights:
    """Tensors by name, below a common prefix.

    Args:
        tensors: All of them.
        prefix: Of those that count, with its final dot.
    """

    def __init__(self, tensors: dict[str, Tensor], prefix: str = "") -> None:
        self._tensors, self._prefix = tensors, prefix

    def __getitem__(self, name: str) -> Tensor:
        try:
            return self._tensors[self._prefix + name]
        except KeyError:
            raise WrongWeights(f"they have no {self._prefix}{name}") from None

    def __contains__(self, name: str) -> bool:
        return self._prefix + name in self._tensors

    def at(self, name: str) -> Weights:
        """Return the weights below a name."""
        return Weights(self._tensors, f"{self._prefix}{name}.")

    def count(self, name: str) -> int:
        """Return the length of a list of layers."""
        start = f"{self._prefix}{name}."
        numbers = {key[len(start) :].split(".")[0] for key in self._tensors if key.startswith(start)}
        return 1 + max((int(number) for number in numbers if number.isdigit()), default=-1)

    @property
    def bias(self) -> Tensor | None:
        """The bias of this layer, if it has one."""
        return self["bias"] if "bias" in self else None

    def linear(self, x: Tensor) -> Tensor:
        """Return what this linear layer makes of [..., C]."""
        return F.linear(x, self["weight"], self.bias)

    def layer_norm(self, x: Tensor, eps: float) -> Tensor:
        """Return what this layer norm makes of [..., C]."""
        return F.layer_norm(x, x.shape[-1:], self["weight"], self.bias, eps)

    def convolve(self, x: Tensor, stride: int = 1, mode: str = "constant") -> Tensor:
        """Return what this convolution makes of [B, C, H, W], padded to its size by zeros or by "replicate"."""
        around = self["weight"].shape[-1] // 2
        if around and stride < self["weight"].shape[-1]:
            x = F.pad(x, (around,) * 4, mode=mode)
        return F.conv2d(x, self["weight"], self.bias, stride)

    def enlarge(self, x: Tensor) -> Tensor:
        """Return what this transposed convolution, of a stride as large as its kernel, makes of [B, C, H, W]."""
        return F.conv_transpose2d(x, self["weight"], self.bias, self["weight"].shape[-1])


def read_tensors(path: Path, device: str) -> dict:
    """Return the tensors of a file of weights; of a checkpoint of torch, all that it holds.

    Raises:
        InputError: the file cannot be read. Files that would run code are refused.
    """
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path, device)
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # of the file's bytes: it may be anything
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"depth_model=: expected weights, got {path}: {reason}") from None


def in_float32(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors in single precision."""
    return {name: tensor.float() if tensor.is_floating_point() else tensor for name, tensor in tensors.items()}
