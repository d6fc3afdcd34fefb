"""Choose the resolution of the photo on the network's Gaussians: as fine as the panel shows, within a budget."""

from __future__ import annotations

import math

from lightfield_gs.base.checks import shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DETAILS, Detail
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.models.detail import DetailLevel
from lightfield_gs.panels.panel import Panel

DEFAULT_BUDGET = 1_500_000  # Gaussians
_FACTORS = (1, 2, 4)
# Side of a photo's square as a fraction of the panel's height: framing fills 0.92, without the margins
_SQUARE = 0.92 * 1.16


def detail_level(
    detail: Detail | None, config: ModelConfig, photo_px: int, panel: Panel | None = None, budget: int = DEFAULT_BUDGET
) -> DetailLevel | None:
    """Choose the level of detail of a photo.

    Args:
        detail: 1, 2 or 4 texels per side of a pixel. "auto": the fewest that resolve all that a view of the panel and
            the photo do, within the budget. None: the network's own Gaussians.
        config: of the network.
        photo_px: longer side of the photo.
        panel: the panel that shows it; None: texels are displayed a pixel wide.
        budget: Gaussians at most, for "auto".

    Returns:
        The level; None for detail None, and for "auto" where even factor 1 exceeds the budget.

    Raises:
        InputError: for other values of detail or budget.
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
    """Return the number of Gaussians of a photo at this factor, including invisible Gaussians."""
    return config.image_size_px**2 * (factor**2 + config.layers)


def view_fraction(panel: Panel) -> float:
    """Return the rows that a view of a panel has, by the panel's: all sub-pixels together show all views."""
    return min(1.0, math.sqrt(3 / panel.views))


def _automatic(config: ModelConfig, photo_px: int, panel: Panel | None, budget: int) -> int | None:
    resolved = float(photo_px)
    if panel is not None:
        resolved = min(resolved, _SQUARE * view_fraction(panel) * min(panel.width_px, panel.height_px))
    affordable = [factor for factor in _FACTORS if count(config, factor) <= budget]
    enough = [factor for factor in affordable if factor * config.image_size_px >= resolved]
    return enough[0] if enough else affordable[-1] if affordable else None
