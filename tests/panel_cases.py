"""Small panels for tests of every room: with the lens of the default panel, or a plain one."""

from typing import Any

from lightfield_gs.panels.panel import Panel

TEMPLATE_LENS = dict(line_number=9.848282191911, slant_tan=1 / 6)  # of 65-inch 8K panels, as the default one has it
PLAIN_LENS = dict(line_number=9.8, slant_tan=0.1)


def template_panel(width_px: int, height_px: int, views: int, **others: Any) -> Panel:
    """Return a panel with the template's lens, and by default a cone of 40 degrees."""
    return Panel(**{**TEMPLATE_LENS, "cone_deg": 40, **others}, width_px=width_px, height_px=height_px, views=views)


def plain_panel(width_px: int, height_px: int, views: int = 8, **others: Any) -> Panel:
    """Return a panel with the plain lens, and by default a cone of 40 degrees."""
    return Panel(**{**PLAIN_LENS, "cone_deg": 40, **others}, width_px=width_px, height_px=height_px, views=views)
