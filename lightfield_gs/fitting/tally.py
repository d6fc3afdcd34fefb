"""What density control wants to know of the steps since it last changed anything."""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.views import Views


class Tally:
    """Sums over steps, for N Gaussians; on their device, and filled without waiting for it.

    seen [N] uint8: 1 if drawn since the round before the last; regularisers leave the others alone, which would melt
    what no photograph of some rounds shows. Only for adaptive density: gradients [N], the sum over views of the norms
    of the gradients of a view's own loss by the projected means, in units of half the image; and drawn [N], in how many
    views that was.
    """

    def __init__(self, count: int, settings: FitSettings, device: torch.device | str):
        adaptive = settings.density == "adaptive"
        self.screen_numbers = (4 if settings.absgrad else 2) if adaptive else 0
        self._views = settings.batch_size
        self.seen, self._seen_now = (torch.ones(count, dtype=torch.uint8, device=device) for _ in range(2))
        size = count if adaptive else 0
        self.gradients, self.drawn = (torch.zeros(size, device=device) for _ in range(2))

    def measured(self, splats: Tensor, screen: Tensor, views: Views) -> Tensor:
        """What there is to add of a step: float32 [1,N], in how many views a Gaussian was drawn, and for adaptive
        density [2,N], the sum of the norms as well; sums over the views, which may be shared out.

        splats [V,N,...]; screen [V,N,2|4]: gradients of the mean loss of all views of the step.
        """
        drawn = splats[..., _core.SPLAT_REACH_INDEX] >= 0
        if not self.screen_numbers:
            return drawn.sum(0, dtype=torch.float32)[None]
        norms = torch.hypot(screen[..., -2] * (views.width_px / 2), screen[..., -1] * (views.height_px / 2)) * drawn
        return torch.stack([drawn.sum(0, dtype=torch.float32), norms.sum(0) * self._views])

    def add(self, sums: Tensor, kept: Tensor) -> None:
        """Adds what measured() gave. kept [1]: 1, or 0 where the step is void."""
        sums = torch.where(kept > 0, sums, 0)
        self._seen_now |= sums[0] > 0
        self.seen |= self._seen_now
        if self.screen_numbers:
            self.drawn += sums[0]
            self.gradients += sums[1]

    def next_round(self) -> None:
        """Begins another round, for as many Gaussians as before."""
        self.seen.copy_(self._seen_now)
        for sums in (self._seen_now, self.gradients, self.drawn):
            sums.zero_()

    def sort(self, order: Tensor) -> None:
        """Follows Gaussians to other places: what was at order[i] is at i."""
        for sums in self.tensors().values():
            if len(sums):
                sums.copy_(sums[order])

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, for a checkpoint."""
        return {"seen": self.seen, "seen_now": self._seen_now, "gradients": self.gradients, "drawn": self.drawn}

    def set(self, tensors: dict[str, Tensor]) -> None:
        """Takes over what tensors() gave."""
        for name, own in self.tensors().items():
            own.copy_(tensors[name])
