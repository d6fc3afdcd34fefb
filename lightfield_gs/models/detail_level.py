"""How finely the photo is laid over the network's Gaussians: as finely as the panel shows, within a budget."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lightfield_gs.base.checks import shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DETAILS, Detail
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.panels.panel import Panel

DEFAULT_BUDGET = 1_500_000  # Gaussians
_FACTORS = (1, 2, 4)
# The side of a photo's square as a share of the panel's height: framing fills 0.92 of it, and leaves out the margins
_SQUARE = 0.92 * 1.16


@dataclass(frozen=True)
class DetailLevel:
    """factor: texels to a side of each pixel of the network's grid. texel_px: width of one on the screen, in pixels."""

    factor: int
    texel_px: float = 1.0


def detail_level(
    detail: Detail | None, config: ModelConfig, photo_px: int, panel: Panel | None = None, budget: int = DEFAULT_BUDGET
) -> DetailLevel | None:
    """The level that was asked for: 1, 2 or 4 texels to a side of a pixel, or "auto", the fewest that give all that a
    view of the panel and the photo, photo_px along its longer side, resolve, in at most `budget` Gaussians. None, for
    the network's own Gaussians, stays None, as does "auto" where not even factor 1 is within the budget.

    Without a panel texels are taken to be a pixel wide where they are drawn. Raises InputError.
    """
    whole_number("budget", budget, 1, 1 << 31)
    if detail is None:
        return None
    if isinstance(detail, bool) or detail not in DETAILS:
        raise InputError(f"detail: expected one of {', '.join(map(str, DETAILS))}, or None, got {shown(detail)}")
    size = config.image_size_px
    factor = _automatic(config, photo_px, panel, budget) if detail == "auto" else detail
    if factor is None:
        return None
    on_screen = 1.0 if panel is None else _SQUARE * min(panel.width_px, panel.height_px) / (size * factor)
    return DetailLevel(factor, on_screen)


def count(config: ModelConfig, factor: int) -> int:
    """Gaussians of a photo at this factor, those that are not seen included."""
    return config.image_size_px**2 * (factor**2 + config.layers)


def _automatic(config: ModelConfig, photo_px: int, panel: Panel | None, budget: int) -> int | None:
    resolved = float(photo_px)
    if panel is not None:
        # All sub-pixels together show all views, so a view has about this share of the panel's rows
        share = min(1.0, math.sqrt(3 / panel.views))
        resolved = min(resolved, _SQUARE * share * min(panel.width_px, panel.height_px))
    affordable = [factor for factor in _FACTORS if count(config, factor) <= budget]
    enough = [factor for factor in affordable if factor * config.image_size_px >= resolved]
    return enough[0] if enough else affordable[-1] if affordable else None
