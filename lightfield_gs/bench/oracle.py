"""What images of the benchmark are judged by: random sub-pixels of the float64 oracle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.reference import subpixel_colours
from lightfield_gs.scene.gaussians import Gaussians

ORACLE_SAMPLES = 20_000
ORACLE_SEED = 1
PSNR_CAP_DB = 120.0  # of images without any error


@dataclass(frozen=True)
class OracleSamples:
    """Random sub-pixels (rows, columns, channels [M]) and the 8-bit values [M] that they must have."""

    rows: np.ndarray
    columns: np.ndarray
    channels: np.ndarray
    values: np.ndarray

    def errors(self, image: torch.Tensor) -> dict[str, float]:
        """psnr_db, max_error_255 (in 1/255) and share_over_1 (share off by more than 1/255) of an 8-bit image."""
        shown = image[self.rows, self.columns, self.channels].cpu().numpy()
        error = np.abs(shown.astype(np.int64) - self.values)
        mean_square = np.mean((error / 255) ** 2)
        psnr_db = PSNR_CAP_DB if mean_square == 0 else min(PSNR_CAP_DB, -10 * np.log10(mean_square))
        return {"psnr_db": float(psnr_db), "max_error_255": int(error.max()), "share_over_1": float(np.mean(error > 1))}


def oracle_samples(gaussians: Gaussians, panel: Panel, rig: Rig, count: int = ORACLE_SAMPLES) -> OracleSamples:
    """Random sub-pixels of a panel, before a white background, by lightfield_gs.reference."""
    random = np.random.default_rng(ORACLE_SEED)
    rows = random.integers(0, panel.height_px, count)
    columns = random.integers(0, panel.width_px, count)
    channels = random.integers(0, 3, count)
    colours = subpixel_colours(gaussians, panel, rig, rows, columns, channels)
    return OracleSamples(rows, columns, channels, np.rint(255 * np.clip(colours, 0, 1)).astype(np.int64))
