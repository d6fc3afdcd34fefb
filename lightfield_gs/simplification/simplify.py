"""A scene with fewer Gaussians: a panel shows almost the same light field."""

from __future__ import annotations

from lightfield_gs.base.checks import whole_number
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.simplification.footprints import Eyes
from lightfield_gs.simplification.merging import MergedScene
from lightfield_gs.simplification.pruning import contributions


def merge_to_count(gaussians: Gaussians, panel: Panel, rig: Rig, count: int, antialiased: bool = False) -> Gaussians:
    """Return a scene of at most `count` Gaussians by merging and dropping, the cheapest for the light field first.

    Args:
        gaussians: one scene, [N, ...].
        panel: the panel of the image.
        rig: the viewpoints.
        count: largest number of Gaussians, 1 or more.
        antialiased: for scenes trained with anti-aliasing, see `render`.

    Raises:
        InputError: for arguments of other types or values.
    """
    count = whole_number("count", count, 1, 1 << 31)
    weights = contributions(gaussians, panel, rig, antialiased) / 3  # three sub-pixels of a pixel
    merged = MergedScene(gaussians.detach().to(dtype=gaussians.dtype), weights, Eyes.of(panel, rig, gaussians.device))
    merged.reduce(count)
    return merged.scene()
