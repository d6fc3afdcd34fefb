"""A photo of a scene on a panel of another shape: its rig, and what is to be made up around the photo."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import FITS
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.photo.inpainting import complete

_TAIL = 0.05  # share of the pixels that lies before the near depth of the zero plane, and behind the far one
_MORE = 4  # pixels beyond what the outermost views look past the photo
_WIDEST = 1.5  # photos that may be made up on each side of one, the most
_NEARER = 1.05  # ratio of disparities
_FEWEST = 0.05  # share of the photo that is to be left as a source
_BLURS = (8, 32, 128)  # pixels from the photo on at which its depths are smooth to as many pixels


@dataclass(frozen=True)
class PhotoPlacement:
    """rig: that shows the photo on the panel. margin_px: (left, top, right, bottom), pixels of the photo that its views
    show beyond it. cropped, made_up: shares of the photo and of the panel's centre view, 0..1."""

    rig: Rig
    margin_px: tuple[int, int, int, int]
    cropped: float
    made_up: float


def fit_to_panel(
    depth: Tensor,
    focal_px: tuple[float, float],
    principal_point_px: tuple[float, float],
    panel: Panel,
    fit: str = "cover",
    *,
    widest_tan: float | None = None,
    zoom: float = 1.0,
    on_near: bool = False,
) -> PhotoPlacement:
    """The rig of the photo's camera that shows it on the panel, and the margin that all of its views need.

    depth: [H, W], z of the photo, scene units. fit: "cover": the photo fills the panel, what is too high or too wide
    is cropped; "contain": all of it is on the panel. widest_tan: tan(cone / 2) of the outermost views; None: the
    panel's. A point at z moves by f tan(cone/2) (1 - Z0/z) pixels of the photo in them. on_near: the zero plane may be
    put anywhere from near on afterwards; the margin is enough for that.
    """
    if fit not in FITS:
        raise InputError(f"fit: expected {' or '.join(FITS)}, got {fit!r}")
    height, width = depth.shape
    shares = panel.width_px / width * focal_px[0] / focal_px[1], panel.height_px / height
    scale = max(shares) if fit == "cover" else min(shares)
    sizes = scale * focal_px[1] / focal_px[0], scale
    focal = sizes[0] * focal_px[0], sizes[1] * focal_px[1]
    centre = (
        panel.width_px / 2 + sizes[0] * (principal_point_px[0] - width / 2),
        panel.height_px / 2 + sizes[1] * (principal_point_px[1] - height / 2),
    )
    measured = depth[torch.isfinite(depth)].double().cpu().numpy()
    near, far = np.quantile(measured, [_TAIL, 1 - _TAIL])
    zero = 2 / (1 / near + 1 / far)
    tan = math.tan(math.radians(panel.cone_deg) / 2) if widest_tan is None else widest_tan
    sides = torch.cat([depth[:, 0], depth[:, -1]])
    known = sides[torch.isfinite(sides)].double().cpu().numpy()
    zeros = np.array([zero, near] if on_near else [zero])[:, None]
    moves = np.abs(1 - zeros / np.quantile(known, [0.02, 0.98])).max() if len(known) else 0.0
    shown = panel.width_px / sizes[0] / zoom, panel.height_px / sizes[1] / zoom
    across = (shown[0] - width) / 2 + focal_px[0] * tan * moves + _MORE
    down = (shown[1] - height) / 2 + _MORE
    most = _WIDEST * width, _WIDEST * height
    x, y = (math.ceil(min(max(part, 0), limit)) for part, limit in zip((across, down), most))
    seen = min(1.0, shown[0] / width) * min(1.0, shown[1] / height)
    return PhotoPlacement(
        Rig(np.eye(4), focal, centre, float(zero)),
        (x, y, x, y),
        1 - seen,
        1 - seen * width * height / (shown[0] * shown[1]),
    )


def extend_with_margin(
    image: Tensor, depth: Tensor, margin_px: tuple[int, int, int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    """The image [H, W, 3] and depth map [H, W] with a margin (left, top, right, bottom) of the same texture, and the
    pixels that are it, bool.

    image, depth: of the surfaces that lie behind what stands in front, as hidden.filled has them. The depths are those
    of the photo's border, the smoother the farther from it.
    """
    left, top, right, bottom = margin_px
    height, width = depth.shape
    rows = torch.arange(-top, height + bottom, device=image.device)
    columns = torch.arange(-left, width + right, device=image.device)
    within = rows.clamp(0, height - 1)[:, None], columns.clamp(0, width - 1)[None]
    distance = torch.maximum((rows[:, None] - within[0]).abs(), (columns[None] - within[1]).abs()).to(depth)
    outside = distance > 0
    measured = torch.isfinite(depth)
    disparity = torch.where(measured, 1 / depth, (1 / depth[measured]).median())[within]
    smooth, reached = disparity, 0
    for blur in _BLURS:
        share = ((distance - reached) / (blur - reached)).clamp(0, 1)
        smooth = torch.lerp(smooth, _blurred(disparity, blur), share)
        reached = blur
    known = torch.where(outside, smooth, disparity)
    # What stands before all that the photo's border shows is a thing of its own, which is not to be there twice
    source = ~outside & measured[within] & (known <= _NEARER * known[outside].max())
    if int(source.sum()) < _FEWEST * depth.numel():
        source = ~outside & measured[within]
    colours = complete(_mirrored(image, rows, columns), outside, source, known.log())
    colours = torch.where(outside[..., None], colours.clamp(0, 1), image[within])
    return colours, torch.where(outside, 1 / known, depth[within]), outside


def _mirrored(image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """The image, reflected at its edges as often as it takes."""
    height, width = image.shape[:2]

    def back(places: Tensor, size: int) -> Tensor:
        places = places.remainder(2 * size)
        return torch.minimum(places, 2 * size - 1 - places)

    return image[back(rows, height)[:, None], back(columns, width)[None]]


def _blurred(values: Tensor, size: int) -> Tensor:
    """A map [H, W], smooth to as many pixels."""
    small = functional.avg_pool2d(values[None, None], size, ceil_mode=True, count_include_pad=False)
    return functional.interpolate(small, scale_factor=size, mode="bilinear", align_corners=False)[
        0, 0, : values.shape[0], : values.shape[1]
    ]
