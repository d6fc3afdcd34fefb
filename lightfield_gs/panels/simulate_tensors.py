"""The picture that an eye sees, in torch: differentiable in the image on the panel and in the numbers of the panel."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

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
    given = optics or Optics()
    given.panel(panel)  # raises InputError where a number is out of its range
    return _perceived(image, panel, eye, spread, given, slice(None))


def simulate_rows(
    image: Tensor, panel: Panel, eye_mm: tuple[float, float, float], rows: slice, optics: Optics
) -> Tensor:
    """Return rows of cells of the pictures of simulate_with_gradients, in less memory.

    Args:
        image: As there, and so are the others; they are not checked.
        panel: See there.
        eye_mm: See there.
        rows: Of the pictures.
        optics: See there.
    """
    return _perceived(image, panel, eye_mm, 1.0, optics, rows)


def cell_count(panel: Panel) -> tuple[int, int]:
    """Return the height and width of a simulated picture, in cells."""
    rows, columns = (len(cell_borders(size, panel.line_number)) - 1 for size in (panel.height_px, panel.width_px))
    return rows, columns


def _perceived(
    image: Tensor, panel: Panel, eye: tuple[float, float, float], spread: float, optics: Optics, cells: slice
) -> Tensor:
    """Return the rows of cells `cells` of simulate_with_gradients, whose arguments are checked."""
    down = _cell_weights(panel.height_px, panel.line_number)[cells].to(image)
    across = _cell_weights(panel.width_px, panel.line_number).to(image)
    used = down.any(0).nonzero().flatten()
    rows = slice(int(used[0]), int(used[-1]) + 1)
    light = _light(panel, eye, spread, optics, image, torch.arange(rows.start, rows.stop))
    lit, weight = (
        torch.einsum("hr,...rwc,xw->...hxc", down[:, rows], values, across)
        for values in (light * image[..., rows, :, :], light)
    )
    return lit / weight


def _cell_weights(size_px: int, lens_subpixels: float) -> Tensor:
    """Return the weights [cells, size_px] of pixels in cells: 2 in a cell of their own, 1 in its neighbours."""
    borders = torch.from_numpy(cell_borders(size_px, lens_subpixels))
    own = torch.searchsorted(borders, torch.arange(size_px), right=True) - 1
    apart = (torch.arange(len(borders) - 1)[:, None] - own).abs()
    return (2 - apart).clamp_min(0).double()


def _light(
    panel: Panel, eye: tuple[float, float, float], spread: float, optics: Optics, like: Tensor, rows: Tensor
) -> Tensor:
    """Return the brightness of the sub-pixels of rows, [rows, W, 3], of the dtype and on the device of `like`."""
    lens, columns = optics.lens_numbers(panel), torch.arange(panel.width_px)
    path = eye_path(panel, eye, lens.line_number, lens.slant_tan, lens.phase, optics.half_cone_tan(panel))
    along = 3 * columns[:, None] + lens.offsets[:, columns % PERIOD] + (lens.phase - path.middle)
    turns = (path.slope * along + path.shift).to(like.device)[rows % PERIOD]
    turns = turns + (path.slope * 3 * lens.slant_tan * rows).to(like.device)[:, None, None]
    turns = turns - turns.detach().floor() - 0.5
    sigma = (spread * FWHM_TO_SIGMA / lens.line_number).to(like.device)
    faint = 1e-20  # a cell keeps a colour even if all its sub-pixels are dark
    return torch.exp(-((turns / (sigma * math.sqrt(2))) ** 2)).to(like.dtype) + faint
