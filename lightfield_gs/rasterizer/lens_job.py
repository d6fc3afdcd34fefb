"""One light-field image to be drawn: what the operator render_lens takes, checked."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from lightfield_gs.rasterizer.lens_view import LensView
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.scene import Scene, check
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import Workspace
from lightfield_gs.rasterizer.workspaces import workspace_of

# Orders of the polynomials for colours that vary over a rig. float64 takes the higher one: it is there to be exact
COLOUR_ORDER, EXACT_COLOUR_ORDER = 8, 16


class LensJob:
    """One light-field image to be drawn.

    fields: means [N,3], quaternions, scales, opacities and sh of one scene. background: [3]. view: what the panel's
    sub-pixels see. antialiased: see encoding.encode. Raises InputError for tensors of other shapes, types or devices.
    """

    def __init__(self, fields: Iterable[Tensor], background: Tensor, view: LensView, antialiased: bool = False):
        self.scene = Scene(*(t.unsqueeze(0) for t in fields))
        self.background = check("background", background, (3,), self.scene)
        self.view, self.antialiased, self.native = view, antialiased, view.native(antialiased)
        self.compensated = antialiased or view.aperture > 0  # whether opacities are lowered for what widens footprints
        self.width, self.height = view.lens.width_px, view.lens.height_px
        exact = background.dtype == torch.float64
        self.colour_order = 0 if self.scene.degree == 0 else EXACT_COLOUR_ORDER if exact else COLOUR_ORDER

    def image(self, as_bytes: bool = False) -> Tensor:
        """Memory for the image [H, W, 3], of the scene's dtype or, with as_bytes, uint8."""
        return self.scene.new(self.height, self.width, 3, dtype=torch.uint8 if as_bytes else None)

    def workspace(self, stats: Stats, threads: int, quality: Quality = EXACT) -> Workspace:
        """The workspace after all stages up to the composite."""
        with self.scene.guard:
            with stats.stage("project"):
                work = workspace_of(
                    self.scene,
                    1,
                    self.width,
                    self.height,
                    stats,
                    threads,
                    lens=True,
                    colour_order=self.colour_order,
                    compensated=self.compensated,
                )
                stats.colour_error = work.project_lens(self.native, quality)
            work.order_and_bin()
        return work
