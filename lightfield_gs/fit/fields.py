"""What a fit optimises: the Gaussians in the form in which every value is allowed, and the moments of Adam."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.scene.gaussians import Gaussians

NAMES = ("means", "log_scales", "quaternions", "logits", "sh")


@dataclass
class Fields:
    """N Gaussians under optimisation; all tensors are contiguous, of one dtype and on one device.

    means [N,3]; log_scales [N,3], natural logarithms of the standard deviations; quaternions [N,4], wxyz of any length;
    logits [N], log(opacity / (1 - opacity)); sh [N,K,3], K = (degree + 1)^2 of the degree that is in use.
    first, second: the moments of Adam of each, by name. scales [N,3] and opacities [N] are what is drawn: exp and
    sigmoid of theirs, which every step renews.
    """

    values: dict[str, Tensor]
    first: dict[str, Tensor]
    second: dict[str, Tensor]
    scales: Tensor
    opacities: Tensor

    @classmethod
    def of(cls, gaussians: Gaussians) -> Fields:
        """Those of a scene [N, ...], with moments of zero."""
        logits = torch.logit(gaussians.opacities, eps=1e-6)
        values = dict(
            zip(
                NAMES,
                (gaussians.means, gaussians.scales.log(), gaussians.quaternions, logits, gaussians.sh),
            )
        )
        return cls._of_values({name: value.detach().contiguous().clone() for name, value in values.items()})

    @classmethod
    def _of_values(cls, values: dict[str, Tensor]) -> Fields:
        first, second = ({name: torch.zeros_like(value) for name, value in values.items()} for _ in range(2))
        return cls(values, first, second, values["log_scales"].exp(), values["logits"].sigmoid())

    @property
    def count(self) -> int:
        """N."""
        return self.values["means"].shape[0]

    @property
    def degree(self) -> int:
        """Of the harmonics that are in use."""
        return SH_COEFFICIENTS.index(self.values["sh"].shape[1])

    def gaussians(self) -> Gaussians:
        """The scene as it is drawn; it shares the memory of the fields."""
        means, _, quaternions, _, sh = self.values.values()
        return Gaussians(means, quaternions, self.scales, self.opacities, sh)

    def changed(self, change: Callable[[Tensor], Tensor]) -> Fields:
        """Every tensor changed, moments too."""
        values, first, second = (
            {name: change(tensor).contiguous() for name, tensor in group.items()}
            for group in (self.values, self.first, self.second)
        )
        return Fields(values, first, second, change(self.scales).contiguous(), change(self.opacities).contiguous())

    def renew(self) -> None:
        """Writes scales and opacities anew, after log_scales and logits were set."""
        self.scales.copy_(self.values["log_scales"].exp())
        self.opacities.copy_(self.values["logits"].sigmoid())

    def raise_degree(self, degree: int) -> None:
        """Makes room for harmonics up to `degree`: those that are new begin at zero."""
        count = SH_COEFFICIENTS[degree]
        for group in (self.values, self.first, self.second):
            old = group["sh"]
            group["sh"] = old.new_zeros(old.shape[0], count, 3)
            group["sh"][:, : old.shape[1]] = old
