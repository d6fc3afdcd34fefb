"""Adaptive density (Kerbl et al. 2023, section 5): Gaussians that the loss pulls about are cloned or split, faint and
huge ones pruned, and opacities now and then reset.
"""

from __future__ import annotations

from lightfield_gs.fit.fields import Fields
from lightfield_gs.fit.settings import FitSettings
from lightfield_gs.fit.tally import Tally


def change(fields: Fields, tally: Tally, settings: FitSettings, step: int) -> Fields:
    """The fields after a round, once `step` steps are done."""
    raise NotImplementedError
