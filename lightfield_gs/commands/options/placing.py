"""How a photo with depths fills a panel of another shape: --fit, its rig, and the margin that is made up."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from lightfield_gs.base.options import FITS
from lightfield_gs.commands.options.estimated import is_estimated
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from torch import Tensor

    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.photo.margin import Placed
    from lightfield_gs.scene.gaussians import Gaussians

_MOST_CROPPED = 0.34  # share of the photo beyond which all of it is shown when nothing was said
_TRANSPARENT = 0.5  # alpha below which a pixel of the photo's border is cut out: nothing is made up around a cut-out


def add_fit(add: Callable[..., argparse.Action]) -> None:
    add(
        "--fit",
        choices=FITS,
        help="how a photo with depths fills a panel of another shape: cover crops it, contain shows all of it and "
        "makes up the rest of its own texture (default: cover, unless more than a third would be cropped)",
    )


def place_photo(
    args: argparse.Namespace,
    panel: Panel,
    image: Tensor,
    depth: Tensor,
    focal: tuple[float, float],
    centre: tuple[float, float],
) -> tuple[tuple[int, int, int, int], list[str]]:
    """The margin that from_depth makes up, and words on it; the rig is kept in args.placed for `photo_rig`.

    image: [H, W, 4]; depth: [H, W], z. Of a photo whose border is cut out nothing is made up.
    """
    args.placed = None
    alpha = image[..., 3]
    border = min(float(part.min()) for part in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))
    if border < _TRANSPARENT or not bool(((depth > 0) & depth.isfinite()).any()):
        return (0, 0, 0, 0), []
    from lightfield_gs.photo.margin import place

    def placed(fit: str) -> Placed:
        return place(
            depth,
            focal,
            centre,
            panel,
            fit,
            widest_tan=_widest_tan(args, panel),
            zoom=getattr(args, "zoom", None) or 1,
            on_near=is_estimated(args),
        )

    fit = args.fit or FITS[0]
    found = placed(fit)
    if args.fit is None and found.cropped > _MOST_CROPPED:
        fit = FITS[1]
        found = placed(fit)
    args.placed = found
    words = f"fit {fit}: {found.cropped:.0%} of it cropped, {found.made_up:.0%} of the panel made up"
    return found.margin_px, [words + ("" if args.fit else " (assumed; --fit cover, --fit contain)")]


def photo_rig(args: argparse.Namespace, panel: Panel, gaussians: Gaussians) -> Rig:
    """The rig of a photo: as it was placed, or fitted to what it shows; of one whose depths are a network's, whose
    scale means little, with the panel in the subject. Raises InputError."""
    from lightfield_gs.panels import framing

    placed: Placed | None = getattr(args, "placed", None)
    rig = framing.frame_photo(gaussians, panel) if placed is None else placed.rig
    return framing.on_subject(rig, gaussians, panel) if is_estimated(args) else rig


def _widest_tan(args: argparse.Namespace, panel: Panel) -> float:
    """tan(cone / 2) of the outermost views, as --cone and --depth-amount have it."""
    cone = panel.cone_deg if getattr(args, "cone", None) is None else args.cone
    amount = 1.0 if getattr(args, "depth_amount", None) is None else args.depth_amount
    return amount * math.tan(math.radians(cone) / 2)
