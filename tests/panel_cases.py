"""Small panels for tests of every room: with the lens of the default panel, and with a plain one."""

from typing import Any

from lightfield_gs.panels.panel import Panel

TEMPLATE_LENS = dict(line_number=9.848282191911, slant_tan=1 / 6)  # of 65-inch 8K panels, as the default one has it
PLAIN_LENS = dict(line_number=9.8, slant_tan=0.1)


def template_panel(width_px: int, height_px: int, views: int, **others: Any) -> Panel:
    """With the template's lens, and a cone of 40 degrees unless another is given."""
    return Panel(**{**TEMPLATE_LENS, "cone_deg": 40, **others}, width_px=width_px, height_px=height_px, views=views)


def plain_panel(width_px: int, height_px: int, views: int = 8, **others: Any) -> Panel:
    """With the plain lens, and a cone of 40 degrees unless another is given."""
    return Panel(**{**PLAIN_LENS, "cone_deg": 40, **others}, width_px=width_px, height_px=height_px, views=views)
