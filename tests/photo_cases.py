"""A photo, a panel and a small network for the tests of photos."""

import numpy as np
import torch
from panel_cases import template_panel

from lightfield_gs.models import ModelConfig, SplatterNet

PANEL = template_panel(397, 231, 24, phase=-2161.2)
TINY = {
    "image_size_px": 32,
    "features": 16,
    "unet": {"base_channels": 8, "multipliers": [1, 2], "blocks": 1, "attention_px": [16], "heads": 2},
}


def tiny_net(**changes: object) -> SplatterNet:
    """Return a small network with some relief, unlike an untrained one; changes: of its configuration."""
    torch.manual_seed(0)
    net = SplatterNet(ModelConfig.from_dict(TINY | changes))
    torch.nn.init.normal_(net.head.weight, std=0.02)
    return net.eval()


def photo(height: int, width: int, colour: tuple[float, float, float] = (0.9, 0.4, 0.1)) -> np.ndarray:
    """Return RGBA [H,W,4] float32 of an ellipse off the middle whose colour varies."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = (x + 0.5) / width - 0.45, (y + 0.5) / height - 0.55
    alpha = ((x / 0.4) ** 2 + (y / 0.35) ** 2 < 1).astype(np.float32)
    shade = 0.6 + 0.4 * np.sin(9 * x) * np.cos(7 * y)
    return np.stack([*(channel * shade for channel in colour), alpha], 2).astype(np.float32)


def psnr_db(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the PSNR of two 8-bit images."""
    return float(-10 * torch.log10(((a.cpu().double() - b.cpu().double()) / 255).square().mean()))
