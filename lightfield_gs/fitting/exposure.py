"""Exposure of each photograph: cameras that choose it by themselves show one surface in other colours each time.

As in the program of Kerbl et al. 2023, an affine change of colours for each photograph stands between the render and
the loss. Held-out photographs are compared without one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs.fitting.photograph_adam import PhotographAdam
from lightfield_gs.fitting.settings import FitSettings

_DECAY = 0.1  # of the rate over the fit, as in the program of Kerbl et al.


class Exposure:
    """values [C,3,4]: of each photograph [A|b], colours A c + b of the render's colours c; [I|0] at the start.

    What all photographs have in common belongs to the scene: the mean of the values is kept at [I|0], or else the
    scene could turn blue and its photographs yellow.
    """

    def __init__(self, photographs: int, settings: FitSettings, device: torch.device):
        self.values = torch.eye(3, 4, device=device).repeat(photographs, 1, 1)
        shape = (photographs, 12)
        self._adam = PhotographAdam(shape, settings.steps, settings.exposure_lr, _DECAY, self.values.dtype, device)

    def exposed(self, colours: Tensor, chosen: Tensor) -> Tensor:
        """Colours [V,...,3] as the photographs `chosen` [V] show them."""
        affine = self._affine(colours, chosen)
        changed = affine[..., 3].expand_as(colours).clone()
        for channel in range(3):
            changed += colours[..., channel, None] * affine[..., channel]
        return changed

    def reverse(self, colours: Tensor, gradient: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """From the gradient [V,H,W,3] of what exposed(colours, chosen) returned, that of the colours [V,H,W,3], and
        that of the values [C,12]."""
        affine = self._affine(colours, chosen)
        g_colours = torch.stack([(gradient * affine[..., channel]).sum(-1) for channel in range(3)], -1)
        columns = [(gradient * colours[..., channel, None]).sum((1, 2)) for channel in range(3)]
        g_affine = torch.stack([*columns, gradient.sum((1, 2))], -1)
        return g_colours, self._adam.gathered(chosen, g_affine.flatten(1))

    def update(self, gradient: Tensor, step: Tensor, kept: Tensor) -> None:
        """Moves the values by their gradient [C,12], and the mean back; step, kept: see PhotographAdam.moves."""
        moves = self._adam.moves(gradient, step, kept).view_as(self.values)
        moved = self.values + moves
        excess = moved.mean(0) - torch.eye(3, 4, dtype=moved.dtype, device=moved.device)
        self.values.copy_(torch.where(kept > 0, moved - excess, self.values))

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, for a checkpoint, which writes to them as well."""
        return {"values": self.values, **self._adam.tensors()}

    def _affine(self, colours: Tensor, chosen: Tensor) -> Tensor:
        """Those of `chosen`, [V,1...,3,4], in the dtype and with the dimensions of colours [V,...,3]."""
        affine = self.values.index_select(0, chosen).to(colours.dtype)
        return affine.view(len(chosen), *[1] * (colours.dim() - 2), 3, 4)
