"""Learning rate and averaged weights as functions of the step."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from training.config import OptimizerConfig, TrainingConfig


def progress(step: int, seconds: float, config: TrainingConfig) -> float:
    """Return the fraction of a run that is done after some steps and seconds, 0..1; the warm-up's steps count nothing.

    Where stages end by the clock, it is the fraction of the time.
    """
    if config.by_time:
        return min(1.0, seconds / config.total_seconds)
    warmup = config.optimizer.warmup_steps
    return max(0, step - warmup) / max(1, config.total_steps - warmup)


def learning_rate(step: int, done: float, config: OptimizerConfig) -> float:
    """Return the rate of a step: a linear warm-up of a cosine from the peak to final_share times the peak.

    Args:
        done: See progress.
    """
    fraction = config.final_share + (1 - config.final_share) * 0.5 * (1 + math.cos(math.pi * done))
    return config.learning_rate * fraction * min(1.0, (step + 1) / max(1, config.warmup_steps))


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
