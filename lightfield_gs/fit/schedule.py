"""What changes from step to step, for all steps of a fit at once, in tensors of the device that it runs on."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.fit.random import Purpose, uniforms
from lightfield_gs.fit.settings import FitSettings
from lightfield_gs.fit.update import update_table


@dataclass(frozen=True)
class Schedule:
    """order [steps,V] int64: the photographs of each step; numbers [steps,11]: see update_table; backgrounds
    [steps,3]. All follow from the settings and the number of photographs, so that a checkpoint need not hold them."""

    order: Tensor
    numbers: Tensor
    backgrounds: Tensor

    @classmethod
    def of(cls, settings: FitSettings, photographs: int, device: torch.device | str) -> Schedule:
        """For a fit to so many photographs."""
        steps, mcmc = settings.steps, settings.density == "mcmc"
        # More views say more surely where to go: rates grow as the root of their number (as for other batches)
        batch = settings.views**0.5
        numbers = update_table(
            steps,
            means=[batch * settings.rate_means_at(step) for step in range(steps)],
            log_scales=batch * settings.rate_log_scales,
            quaternions=batch * settings.rate_quaternions,
            logits=batch * settings.rate_logits,
            sh_dc=batch * settings.rate_sh_dc,
            sh_rest=batch * settings.rate_sh_rest,
            noise_rate=settings.noise_rate if mcmc else 0.0,
            opacity_share=settings.opacity_share if mcmc else 0.0,
            scale_share=settings.scale_share if mcmc else 0.0,
            device=device,
        )
        if settings.background is None:
            backgrounds = uniforms(settings.seed, 0, Purpose.BACKGROUND, 3 * steps).float().view(steps, 3)
        else:
            backgrounds = torch.tensor([settings.background]).expand(steps, 3)
        order = _order(settings, photographs)
        return cls(order.to(device), numbers, backgrounds.contiguous().to(device))


def _order(settings: FitSettings, photographs: int) -> Tensor:
    """[steps,V]: every photograph once in each epoch, in another order each time."""
    wanted = settings.steps * settings.views
    epochs = [
        uniforms(settings.seed, epoch, Purpose.ORDER, photographs).argsort(stable=True)
        for epoch in range(-(-wanted // photographs))
    ]
    return torch.cat(epochs)[:wanted].view(settings.steps, settings.views)
