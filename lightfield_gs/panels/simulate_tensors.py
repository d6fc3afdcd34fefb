"""The picture that an eye sees, in torch: differentiable in the image on the panel and in the numbers of the panel."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs.base.checks import expect, real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.cells import PERIOD
from lightfield_gs.panels.optics import Optics
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import FWHM_TO_SIGMA, SPREADS, cell_borders, check_geometry, checked_eye, eye_path


def simulate_with_gradients(
    image: Tensor, panel: Panel, eye_mm: Sequence[float], spread_subpixels: float = 1.0, optics: Optics | None = None
) -> Tensor:
    """Return the pictures that one eye perceives, [..., round(3 H / P_e), round(3 W / P_e), 3]: `simulate` in torch.

    It is differentiable in the image and in `optics`, on the device of the image. The light of a lens moves smoothly
    over the sub-pixels, whatever views they show. It takes some 100 bytes a sub-pixel.

    Args:
        image: The light-field images [..., H, W, 3] of this panel, float32 or float64.
        panel: The panel; its line number also says how many samples a picture has.
        eye_mm: See simulate.
        spread_subpixels: See simulate.
        optics: Numbers of the panel as tensors, in place of its own. Numbers of a rig do not matter.

    Raises:
        InputError: An argument is invalid, or the panel lacks a measure.
    """
    expect("image", image, Tensor)
    expect("optics", optics, Optics, type(None))
    check_geometry(panel)
    size = panel.height_px, panel.width_px
    if image.dim() < 3 or tuple(image.shape[-3:]) != (*size, 3) or image.dtype not in (torch.float32, torch.float64):
        raise InputError(
            f"image: expected float32 or float64 [..., {size[0]}, {size[1]}, 3] of panel {panel.name}, got "
            f"{image.dtype} {list(image.shape)}"
        )
    eye = checked_eye(eye_mm)
    spread = real_number("spread_subpixels", spread_subpixels, *SPREADS)
    light = _light(panel, eye, spread, optics or Optics(), image)
    lit, weight = (_blurred(_cell_sums(values, panel)) for values in (light * image, light))
    return lit / weight


def _light(panel: Panel, eye: tuple[float, float, float], spread: float, optics: Optics, like: Tensor) -> Tensor:
    """Return the brightness of the sub-pixels, [H, W, 3], of the dtype and on the device of `like`."""
    optics.panel(panel)  # raises InputError where a number is out of its range
    lens = optics.lens_numbers(panel)
    path = eye_path(panel, eye, lens.line_number, lens.slant_tan, lens.phase, optics.half_cone_tan(panel))
    rows, columns = torch.arange(panel.height_px), torch.arange(panel.width_px)
    along = 3 * columns[:, None] + lens.offsets[:, columns % PERIOD] + (lens.phase - path.middle)
    turns = (path.slope * along + path.shift).to(like.device)[rows % PERIOD]
    turns = turns + (path.slope * 3 * lens.slant_tan * rows).to(like.device)[:, None, None]
    turns = turns - turns.detach().floor() - 0.5
    sigma = (spread * FWHM_TO_SIGMA / lens.line_number).to(like.device)
    faint = 1e-20  # a cell keeps a colour even if all its sub-pixels are dark
    return torch.exp(-((turns / (sigma * math.sqrt(2))) ** 2)).to(like.dtype) + faint


def _cell_sums(values: Tensor, panel: Panel) -> Tensor:
    """Return the sums [..., h, w, 3] of values [..., H, W, 3] over cells about one lens wide."""
    for axis, size in ((-3, panel.height_px), (-2, panel.width_px)):
        borders = cell_borders(size, panel.line_number)
        cells = torch.from_numpy(np.repeat(np.arange(len(borders) - 1), np.diff(borders))).to(values.device)
        shape = list(values.shape)
        shape[axis] = len(borders) - 1
        values = values.new_zeros(shape).index_add(axis, cells, values)
    return values


def _blurred(cells: Tensor) -> Tensor:
    """Return cells [..., h, w, 3], each joined with its neighbours by the weights 1 2 1 both ways."""
    padded = functional.pad(cells, (0, 0, 1, 1, 1, 1))
    across = padded[..., :-2, :] + 2 * padded[..., 1:-1, :] + padded[..., 2:, :]
    return across[..., :-2, :, :] + 2 * across[..., 1:-1, :, :] + across[..., 2:, :, :]
