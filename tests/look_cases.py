"""Sheets of Gaussians at some depths before one camera: what depth, size and place of a scene are tested on."""

import numpy as np
import torch
from panel_cases import plain_panel

from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

PANEL = plain_panel(96, 60)
RIG = Rig(np.eye(4), (96.0, 100.0), (45.0, 28.0), zero_depth=2.0)


def sheet(*layers) -> Gaussians:
    """Sheets of Gaussians across the picture: (depth, opacity, left edge, right edge in widths) each."""
    means, opacities = [], []
    for depth, opacity, left, right in layers:
        columns, rows = np.meshgrid(np.arange(left * 96, right * 96, 0.75), np.arange(0, 60, 0.75))
        x, y = (columns - 45) * depth / 96, (rows - 28) * depth / 100
        means.append(np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], 1))
        opacities.append(np.full(x.size, opacity))
    means = torch.from_numpy(np.concatenate(means)).float()
    generator = torch.Generator().manual_seed(0)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        0.007 * means[:, 2:].repeat(1, 3),
        torch.from_numpy(np.concatenate(opacities)).float(),
        torch.randn(len(means), 1, 3, generator=generator),
    )
