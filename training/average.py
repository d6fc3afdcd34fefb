"""Average two checkpoints of one network: `python -m training.average FIRST SECOND --share 0.6 -o MEAN`.

The average of the weights before and after further training is mostly as good as either. It lies between them in
everything that the training changed. Source: Wortsman et al., "Model soups", ICML 2022.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.models import SplatterNet
from training.command import with_line_errors
from training.trainer import with_attention


@torch.no_grad()
def average(first: SplatterNet, second: SplatterNet, weight: float) -> SplatterNet:
    """Move the first network's parameters towards the second's, and return the first network.

    Self-attention that the second network alone has counts in the first as self-attention without effect.

    Args:
        weight: weight of the second network in the mean, 0..1.

    Raises:
        InputError: the networks have different configurations, or the weight is out of range.
    """
    if not 0 <= weight <= 1:
        raise InputError(f"share: expected 0..1, got {weight}")
    first = _with_attention_of(first, second)
    if first.config != second.config:
        raise InputError("the two checkpoints are of different networks: expected the same configuration in both")
    for parameter, other in zip(first.parameters(), second.parameters()):
        parameter.lerp_(other, weight)
    return first


def _with_attention_of(first: SplatterNet, second: SplatterNet) -> SplatterNet:
    """Return the first network with the second's self-attention where it has none; its output there is zero."""
    before, more = first.config.unet.attention_px, second.config.unet.attention_px
    if not (added := set(more) - set(before)):
        return first
    known, first = set(first.state_dict()), with_attention(first, sorted(added))
    for name, parameter in second.named_parameters():
        if name not in known:
            own = first.get_parameter(name)
            own.zero_() if ".projection." in name else own.copy_(parameter)
    return first


@with_line_errors("training.average")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.average", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("first", type=Path, help="safetensors file")
    parser.add_argument("second", type=Path, help="safetensors file of the same network")
    parser.add_argument("--share", type=float, default=0.5, metavar="0..1", help="of the second (default: %(default)s)")
    parser.add_argument("-o", "--output", type=Path, required=True, help="where to write the mean, in float16")
    options = parser.parse_args(arguments)
    nets = [SplatterNet.from_pretrained(path) for path in (options.first, options.second)]
    notes = {"average": f"{1 - options.share:g} {options.first.name} + {options.share:g} {options.second.name}"}
    average(*nets, options.share).save(options.output, notes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
