"""Learning rate and averaged weights as functions of the step."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from training.config import OptimizerConfig


def learning_rate(step: int, total_steps: int, config: OptimizerConfig) -> float:
    """Return the rate of a step: a linear warm-up, then a cosine from the peak to final_share times the peak."""
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    progress = (step - config.warmup_steps) / max(1, total_steps - config.warmup_steps)
    fraction = config.final_share + (1 - config.final_share) * 0.5 * (1 + math.cos(math.pi * progress))
    return config.learning_rate * fraction


def make_optimizer(net: nn.Module, config: OptimizerConfig) -> torch.optim.AdamW:
    """AdamW that decays the weights of convolutions only."""
    groups: dict[bool, list[Tensor]] = {True: [], False: []}
    for parameter in net.parameters():
        if parameter.requires_grad:
            groups[parameter.ndim > 1].append(parameter)
    return torch.optim.AdamW(
        [{"params": groups[True], "weight_decay": config.weight_decay}, {"params": groups[False], "weight_decay": 0.0}],
        lr=config.learning_rate,
        betas=config.betas,
        fused=True,
    )


class WeightAverage:
    """Exponential moving average of a network's weights, following closely at first.

    Args:
        average: The network that holds the average.
        net: The trained network.
        decay: Decay of the average in the long run.
    """

    def __init__(self, average: nn.Module, net: nn.Module, decay: float) -> None:
        self.average, self.decay = average.requires_grad_(False).eval(), decay
        self._averages, self._weights = list(average.parameters()), list(net.parameters())

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Move the average towards the network after step number `step`."""
        decay = min(self.decay, (1 + step) / (10 + step))
        torch._foreach_lerp_(self._averages, self._weights, 1 - decay)
