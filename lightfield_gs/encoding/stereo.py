"""A scene to the pictures of two eyes, and both in one image: side by side, one above the other, or as an anaglyph."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, decode_srgb, encode_srgb, to_bytes
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import StereoLayout
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.stereo_screen import LEFT_RIGHT
from lightfield_gs.scene.gaussians import Gaussians

# Red for the left eye, cyan for the right one: the least squares of what filters and screen let through (Dubois, "A
# projection method to generate anaglyph stereo images", ICASSP 2001), of linear colours
_ANAGLYPH = (
    ((0.4561, 0.500484, 0.176381), (-0.0400822, -0.0378246, -0.0157589), (-0.0152161, -0.0205971, -0.00546856)),
    ((-0.0434706, -0.0879388, -0.00155529), (0.378476, 0.73364, -0.0184503), (-0.0721527, -0.112961, 1.2264)),
)


@torch.no_grad()
def render_eyes(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    view_filter: float = 0.0,
    device: str | None = None,
) -> Tensor:
    """Render the pictures of the left and the right eye, uint8 [2, H, W, 3].

    Args:
        gaussians: One scene.
        panel: Of a StereoScreen.
        rig: In the coordinates of the scene.
        background: See `encode`, also for antialiased, view_filter and device.

    Raises:
        InputError: For arguments of other types or values.
    """
    pictures = render_views(
        gaussians,
        panel,
        rig,
        LEFT_RIGHT,
        background=background,
        antialiased=antialiased,
        view_filter=view_filter,
        device=device,
    )
    return to_bytes(pictures)


def join_eyes(eyes: Tensor, layout: StereoLayout) -> Tensor:
    """Return the pictures of two eyes, uint8 [2, H, W, 3], in one image, uint8; the left eye is left or on top.

    Args:
        eyes: The left eye's first; W is even.
        layout: "sbs" [H, 2 W, 3], "half-sbs" [H, W, 3], "tab" [2 H, W, 3] or "anaglyph" [H, W, 3].

    Raises:
        InputError: The layout keeps two pictures.
    """
    if layout == "sbs":
        return torch.cat([*eyes], 1)
    if layout == "half-sbs":
        pairs = eyes.float().unflatten(2, (-1, 2)).mean(3)
        return torch.cat([*pairs.round().to(torch.uint8)], 1)
    if layout == "tab":
        return torch.cat([*eyes], 0)
    if layout == "anaglyph":
        return _anaglyph(eyes)
    raise InputError(f"stereo: expected sbs, half-sbs, tab or anaglyph for one image, got {layout}")


def _anaglyph(eyes: Tensor) -> Tensor:
    table = torch.from_numpy(decode_srgb(np.arange(256) / 255)).float().to(eyes.device)
    left, right = (table[eye.long()] @ table.new_tensor(matrix).T for eye, matrix in zip(eyes, _ANAGLYPH))
    # The code of linear light by a table of 12 bits, as the colours of a picture are rounded anyway
    codes = torch.from_numpy(encode_srgb(np.arange(4096) / 4095)).float().to(eyes.device)
    return to_bytes(codes[((left + right).clamp(0, 1) * 4095).round().long()])
