"""Photos of scenes on panels of another shape: the rig, and a margin around the photo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import FITS, Fit
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.photo.inpainting import complete
from lightfield_gs.photo.subject import subject_box

Margin = Literal["texture", "blur"]


@dataclass(frozen=True)
class MarginConstants:
    """Sizes of margins.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    depth_tail: float = 0.05  # fraction of the pixels before the near depth of the zero plane, and behind the far one
    side_quantiles: tuple[float, float] = (0.02, 0.98)  # of the depths along the photo's left and right sides
    middle: float = 0.75  # quantile of the depths in the middle that a subject there is nearer than
    more_px: int = 4  # pixels in addition to the look of the outermost views past the photo
    widest: float = 1.5  # margin on each side, in photos, at most
    nearer: float = 1.05  # ratio of disparities from which on a thing stands before the border
    fewest: float = 0.05  # fraction of the photo that has to remain as a source
    # distances from the photo at which its depths are smooth over as many pixels
    blurs_px: tuple[int, int, int] = (8, 32, 128)
    # the same for the colours of a blurred margin, as fractions of the photo's longer side
    colour_blurs: tuple[float, float, float] = (0.015, 0.06, 0.2)
    darkest: float = 0.45  # brightness of a blurred margin far from the photo, by the photo's
    dark_at: float = 0.12  # distance at which it is as dark, as a fraction of the photo's longer side
    most_cropped: float = 0.34  # of a photo without a whole subject; if cropping would take more, all of it is shown


_C = MarginConstants()


class PanelFit(NamedTuple):
    """A photo on a panel.

    Attributes:
        rig: Shows the photo on the panel.
        margin_px: (left, top, right, bottom), pixels of the photo that its views show beyond it.
        cropped: Fraction 0..1 of the photo that is cropped.
        made_up: Fraction 0..1 of the panel's centre view that is margin.
        fit: "cover" or "contain".
    """

    rig: Rig
    margin_px: tuple[int, int, int, int]
    cropped: float
    made_up: float
    fit: Fit


def fit_to_panel(
    depth: Tensor,
    focal_px: tuple[float, float],
    principal_point_px: tuple[float, float],
    panel: Panel,
    fit: Fit = "cover",
    *,
    widest_tan: float | None = None,
    zoom: float = 1.0,
    pan: tuple[float, ...] = (0.0, 0.0),
    on_near: bool = False,
    about_middle: bool = False,
) -> PanelFit:
    """Return the rig of the photo's camera that shows it on the panel, and the margin that all of its views need.

    A point at z moves by f tan(cone/2) (1 - Z0/z) pixels of the photo in the outermost views.

    Args:
        depth: [H, W], z of the photo, scene units.
        focal_px: (fx, fy), pixels of the photo.
        principal_point_px: (cx, cy), pixels of the photo.
        panel: The panel.
        fit: "cover": the photo fills the panel, and the rest is cropped; "contain": the whole photo is on the panel;
            "auto": cover about the subject, or contain if the subject would be cropped. Without a subject, or with one
            that both sides of the photo cut off, contain if more than a third of the photo would be.
        widest_tan: tan(cone / 2) of the outermost views; None: the panel's.
        zoom: Factor of the size of the picture, which the margin allows for.
        pan: Shift of the picture to the right and down, in widths and heights of the panel; likewise.
        on_near: Whether the zero plane may move to a subject afterwards, which is anywhere from near to the depth of
            the picture's middle; the margin is enough for that.
        about_middle: Whether "auto" crops about the photo's middle, as for a picture of a video. It is contain if that
            would crop the subject.

    Raises:
        InputError: `fit` is invalid.
    """
    if fit not in FITS:
        raise InputError(f"fit: expected {' or '.join(FITS)}, got {fit!r}")
    height, width = depth.shape
    scales = panel.width_px / width * focal_px[0] / focal_px[1], panel.height_px / height
    middle = width / 2, height / 2
    if fit == "auto":
        fit, middle = _choose_fit(depth, scales, about_middle)
    scale = max(scales) if fit == "cover" else min(scales)
    sizes = scale * focal_px[1] / focal_px[0], scale
    focal = sizes[0] * focal_px[0], sizes[1] * focal_px[1]
    centre = (
        panel.width_px / 2 + sizes[0] * (principal_point_px[0] - middle[0]),
        panel.height_px / 2 + sizes[1] * (principal_point_px[1] - middle[1]),
    )
    measured = depth[torch.isfinite(depth)].double().cpu().numpy()
    near, far = np.quantile(measured, [_C.depth_tail, 1 - _C.depth_tail])
    zero = 2 / (1 / near + 1 / far)
    tan = math.tan(math.radians(panel.cone_deg) / 2) if widest_tan is None else widest_tan
    sides = torch.cat([depth[:, 0], depth[:, -1]])
    known = sides[torch.isfinite(sides)].double().cpu().numpy()
    zeros = np.array([zero, near, _middle_depth(depth, near)] if on_near else [zero])[:, None]
    moves = np.abs(1 - zeros / np.quantile(known, _C.side_quantiles)).max() if len(known) else 0.0
    shown = panel.width_px / sizes[0] / zoom, panel.height_px / sizes[1] / zoom
    beyond = focal_px[0] * tan * moves + _C.more_px, _C.more_px
    seen = [at - moved * part for at, moved, part in zip(middle, pan, shown)]
    before = [part / 2 - at + more for part, at, more in zip(shown, seen, beyond)]
    after = [part / 2 + at - size + more for part, at, size, more in zip(shown, seen, (width, height), beyond)]
    most = (_C.widest * width, _C.widest * height) * 2
    margin = [math.ceil(min(max(part, 0), limit)) for part, limit in zip((*before, *after), most)]
    kept = min(1.0, shown[0] / width) * min(1.0, shown[1] / height)
    made_up = max(0.0, 1 - kept * width * height / (shown[0] * shown[1]))  # rounding may go below
    rig = Rig(np.eye(4), focal, centre, float(zero))
    return PanelFit(rig, (margin[0], margin[1], margin[2], margin[3]), 1 - kept, made_up, fit)


def _middle_depth(depth: Tensor, near: float) -> float:
    """Return a depth that most of the middle of the picture [H, W] is nearer than; near where it is not known."""
    height, width = depth.shape
    middle = depth[height // 4 : height - height // 4, width // 4 : width - width // 4]
    known = middle[torch.isfinite(middle)].double().cpu().numpy()
    return max(near, float(np.quantile(known, _C.middle))) if len(known) else near


def _choose_fit(depth: Tensor, scales: tuple[float, float], about_middle: bool) -> tuple[Fit, tuple[float, float]]:
    """Return "cover" or "contain", and the point x, y of the photo that comes to the panel's middle.

    Args:
        depth: [H, W], z of the photo.
        scales: Pixels of the panel by pixels of the photo at which the photo is as wide and as high as the panel.
        about_middle: See fit_to_panel.
    """
    sizes = depth.shape[1], depth.shape[0]
    whole = sizes[0] / 2, sizes[1] / 2
    may_crop = 1 - min(scales) / max(scales) <= _C.most_cropped
    box = subject_box(depth)
    if box is None:
        return ("cover" if may_crop else "contain"), whole
    middle = []
    for size, scale, centre, low, high in zip(sizes, scales, whole, box[:2], box[2:]):
        half = size * scale / max(scales) / 2
        at = centre if about_middle else min(max((low + high) / 2, half), size - half)
        is_whole = at - half <= low + 1e-6 and at + half >= high - 1e-6
        is_cut_off = low <= 0 and high >= size  # by the photo itself
        if not is_whole and not (may_crop and is_cut_off):
            return "contain", whole
        middle.append(at)
    return "cover", (middle[0], middle[1])


def extend_with_margin(
    image: Tensor, depth: Tensor, margin_px: tuple[int, int, int, int], kind: Margin = "texture"
) -> tuple[Tensor, Tensor, Tensor]:
    """Extend an image and its depths by a margin of the same texture, or of its blurred, darker colours.

    The depths continue the photo's border, and become smoother with the distance from it.

    Args:
        image: [H, W, 3], of the surfaces behind the things in front, as hidden.fill_hidden returns it.
        depth: [H, W], of the same surfaces.
        margin_px: (left, top, right, bottom).
        kind: "texture" or "blur".

    Returns:
        The larger image and depth map, and the pixels of the margin, bool.
    """
    left, top, right, bottom = margin_px
    height, width = depth.shape
    rows = torch.arange(-top, height + bottom, device=image.device)
    columns = torch.arange(-left, width + right, device=image.device)
    within = rows.clamp(0, height - 1)[:, None], columns.clamp(0, width - 1)[None]
    distance = torch.maximum((rows[:, None] - within[0]).abs(), (columns[None] - within[1]).abs()).to(depth)
    outside = distance > 0
    measured = torch.isfinite(depth)
    disparity = torch.where(measured, 1 / depth, _middle(1 / depth, measured))[within]
    smooth, reached = disparity, 0
    for blur in _C.blurs_px:
        fraction = ((distance - reached) / (blur - reached)).clamp(0, 1)
        smooth = torch.lerp(smooth, _blur(disparity, blur), fraction)
        reached = blur
    known = torch.where(outside, smooth, disparity)
    if kind == "blur":
        colours = torch.where(outside[..., None], _blurred(image[within], distance, max(height, width)), image[within])
        return colours, torch.where(outside, 1 / known, depth[within]), outside
    # A thing before everything at the photo's border stands alone and must not appear twice
    source = ~outside & measured[within] & (known <= _C.nearer * known[outside].max())
    if int(source.sum()) < _C.fewest * depth.numel():
        source = ~outside & measured[within]
    colours = complete(_mirror(image, rows, columns), outside, source, known.log())
    colours = torch.where(outside[..., None], colours.clamp(0, 1), image[within])
    return colours, torch.where(outside, 1 / known, depth[within]), outside


def _middle(values: Tensor, known: Tensor) -> Tensor:
    """Return the median of the known values, []; nothing waits for the device."""
    if not values.is_cuda:
        return values[known].median()  # a tenth of the time of sorting
    ordered = torch.where(known, values, torch.inf).flatten().sort().values
    return ordered.gather(0, ((known.sum() - 1) // 2).clamp(min=0)[None])[0]


def _blurred(colours: Tensor, distance: Tensor, longer_px: int) -> Tensor:
    """Return colours [H, W, 3], the blurrier and the darker the farther from the photo they are.

    Args:
        colours: The photo, its border continued.
        distance: From the photo, [H, W], pixels.
        longer_px: The photo's longer side.
    """
    blurred, reached = colours, 0
    for part in _C.colour_blurs:
        blur = max(reached + 1, round(part * longer_px))
        fraction = ((distance - reached) / (blur - reached)).clamp(0, 1)
        smooth = torch.stack([_blur(channel, blur) for channel in colours.unbind(2)], 2)
        blurred = torch.lerp(blurred, smooth, fraction[..., None])
        reached = blur
    dark = (distance / max(1.0, _C.dark_at * longer_px)).clamp(0, 1)
    return blurred * (1 - (1 - _C.darkest) * dark * dark * (3 - 2 * dark))[..., None]


def _mirror(image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Return the image, reflected at its edges as often as necessary."""
    height, width = image.shape[:2]

    def reflect(positions: Tensor, size: int) -> Tensor:
        positions = positions.remainder(2 * size)
        return torch.minimum(positions, 2 * size - 1 - positions)

    return image[reflect(rows, height)[:, None], reflect(columns, width)[None]]


def _blur(values: Tensor, size: int) -> Tensor:
    """Return a map [H, W], smoothed over this number of pixels."""
    small = functional.avg_pool2d(values[None, None], size, ceil_mode=True, count_include_pad=False)
    large = functional.interpolate(small, scale_factor=size, mode="bilinear", align_corners=False)
    return large[0, 0, : values.shape[0], : values.shape[1]]
