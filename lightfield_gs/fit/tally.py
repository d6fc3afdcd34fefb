"""What density control wants to know of the steps since it last changed anything."""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.fit.settings import FitSettings
from lightfield_gs.fit.views import Views
from lightfield_gs.rasterizer.screen import radii_px


class Tally:
    """Sums over steps, for N Gaussians; on their device, and filled without waiting for it.

    seen [N] uint8: 1 if drawn since the round before the last; regularisers leave the others alone, which would melt
    what no photograph of some rounds shows. Only for adaptive density: gradients [N], the sum of the norms of the
    gradients of the loss by the projected means, in units of half the image; drawn [N], in how many views that was; and
    radii [N], the largest in pixels.
    """

    def __init__(self, count: int, settings: FitSettings, device: torch.device | str):
        adaptive = settings.density == "adaptive"
        self.screen_numbers = (4 if settings.absolute_gradients else 2) if adaptive else 0
        self.seen, self._seen_now = (torch.ones(count, dtype=torch.uint8, device=device) for _ in range(2))
        size = count if adaptive else 0
        self.gradients, self.drawn, self.radii = (torch.zeros(size, device=device) for _ in range(3))

    def add(self, splats: Tensor, screen: Tensor, kept: Tensor, views: Views) -> None:
        """Adds a step of splats [V,N,...] and gradients screen [V,N,2|4]; kept [1]: 1, or 0 where the step is void."""
        drawn = splats[..., _core.SPLAT_REACH_INDEX] >= 0
        self._seen_now |= drawn.any(0) & (kept > 0)
        self.seen |= self._seen_now
        if not self.screen_numbers:
            return
        half = screen.new_tensor([views.width_px / 2, views.height_px / 2])
        norms = (screen[..., -2:] * half).norm(dim=-1) * drawn
        self.gradients += norms.sum(0) * kept
        self.drawn += drawn.sum(0) * kept
        torch.maximum(self.radii, (radii_px(splats) * kept).amax(0), out=self.radii)

    def next_round(self) -> None:
        """Begins another round, for as many Gaussians as before."""
        self.seen.copy_(self._seen_now)
        for sums in (self._seen_now, self.gradients, self.drawn, self.radii):
            sums.zero_()

    def tensors(self) -> dict[str, Tensor]:
        """All of it by name, for a checkpoint."""
        return {
            "seen": self.seen,
            "seen_now": self._seen_now,
            "gradients": self.gradients,
            "drawn": self.drawn,
            "radii": self.radii,
        }

    def set(self, tensors: dict[str, Tensor]) -> None:
        """Takes over what tensors() gave."""
        for name, own in self.tensors().items():
            own.copy_(tensors[name])
