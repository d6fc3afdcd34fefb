"""What a fit optimises: the Gaussians in the form in which every value is allowed, and the moments of Adam."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.fitting.update import MOST_LOGIT, RawFields, activated
from lightfield_gs.scene.gaussians import Gaussians

_GROUPS = ("values", "first", "second")


@dataclass
class Fields:
    """N Gaussians under optimisation; all tensors are contiguous, of one dtype and on one device.

    values: see RawFields; the K harmonics are those of the degree in use. first, second: the moments of Adam. scales
    [N,3] and opacities [N] are what is drawn, exp and sigmoid of log_scales and logits, which every update renews.
    """

    values: RawFields
    first: RawFields
    second: RawFields
    scales: Tensor
    opacities: Tensor

    @classmethod
    def of(cls, gaussians: Gaussians) -> Fields:
        """Those of a scene [N, ...], with moments of zero."""
        fields = (
            gaussians.means,
            gaussians.scales.log(),
            gaussians.quaternions,
            torch.logit(gaussians.opacities).clamp(-MOST_LOGIT, MOST_LOGIT),
            gaussians.sh,
        )
        values = RawFields(*(field.detach().contiguous().clone() for field in fields))
        return cls(values, values.zeros_like(), values.zeros_like(), *activated(values))

    @property
    def count(self) -> int:
        """N."""
        return self.values.means.shape[0]

    @property
    def degree(self) -> int:
        """Of the harmonics that are in use."""
        return SH_COEFFICIENTS.index(self.values.sh.shape[1])

    def gaussians(self) -> Gaussians:
        """The scene as it is drawn; it shares the memory of the fields."""
        return Gaussians(self.values.means, self.values.quaternions, self.scales, self.opacities, self.values.sh)

    def tensors(self) -> dict[str, Tensor]:
        """All of them by name, for a checkpoint."""
        named = {f"{group}.{name}": t for group in _GROUPS for name, t in getattr(self, group)._asdict().items()}
        return {**named, "scales": self.scales, "opacities": self.opacities}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor]) -> Fields:
        """What tensors() gave."""
        values, first, second = (
            RawFields(*(tensors[f"{group}.{name}"] for name in RawFields._fields)) for group in _GROUPS
        )
        return cls(values, first, second, tensors["scales"], tensors["opacities"])

    def changed(self, change: Callable[[Tensor], Tensor]) -> Fields:
        """Every tensor changed, moments too; for changes of which Gaussians there are, and in which order."""
        values, first, second = (
            RawFields(*(change(t).contiguous() for t in group)) for group in (self.values, self.first, self.second)
        )
        return Fields(values, first, second, change(self.scales).contiguous(), change(self.opacities).contiguous())

    def renew(self) -> None:
        """Writes scales and opacities anew, after log_scales or logits were set."""
        for drawn, fresh in zip((self.scales, self.opacities), activated(self.values)):
            drawn.copy_(fresh)

    def raise_degree(self, degree: int) -> None:
        """Makes room for harmonics up to `degree`: those that are new begin at zero."""

        def grown(raw: RawFields) -> RawFields:
            sh = raw.sh.new_zeros(self.count, SH_COEFFICIENTS[degree], 3)
            sh[:, : raw.sh.shape[1]] = raw.sh
            return raw._replace(sh=sh)

        self.values, self.first, self.second = map(grown, (self.values, self.first, self.second))
