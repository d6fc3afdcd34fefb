"""The 3D filter of Mip-Splatting (Yu et al., 2024), which its trainer stores beside the Gaussians it belongs to."""

from __future__ import annotations

import numpy as np

PROPERTY = "filter_3D"  # standard deviation of a Gaussian's filter, scene units
NOTE = (
    f"the property {PROPERTY} of Mip-Splatting was applied to scales and opacities; its scenes are trained with "
    "anti-aliasing: --antialiased (Python: antialiased=True) draws them as they were"
)


def filtered(scales: np.ndarray, opacities: np.ndarray, widths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales [N, 3] and opacities [N] after the filter, float32: Gaussians become larger, and fainter by as much.

    widths: of the filters, [N].
    """
    with np.errstate(over="ignore"):
        wide = np.hypot(scales, widths[:, None].astype(np.float32))
    share = np.divide(scales, wide, out=np.ones(wide.shape), where=wide > 0).prod(1)
    return wide, (opacities * share).astype(np.float32)
