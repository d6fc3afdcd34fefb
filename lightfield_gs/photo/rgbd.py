"""Photos with depth maps as 3D Gaussians: a whole scene, without the network."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import to_tensor
from lightfield_gs.base.checks import expect, is_row, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.photo.depth import FARTHEST
from lightfield_gs.photo.depth_edges import (
    STEEPEST,
    coverage_to_opacity,
    edges,
    find_matte,
    merge_slivers,
    slopes,
    snap_mixed,
)
from lightfield_gs.photo.hidden import Hidden, fill_hidden, find_hidden
from lightfield_gs.photo.image_filters import max_filter
from lightfield_gs.photo.margin import Margin, extend_with_margin
from lightfield_gs.photo.second_eye import SecondEye
from lightfield_gs.rasterizer.quality import OPACITY_CUT
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

FIELD_OF_VIEW_DEG = 60.0  # of the longer side, where nothing is known of the camera: a phone's main lens has 60 to 70
MAX_PIXELS = 1 << 24
_MOST_WITH_MARGIN = 4 * MAX_PIXELS
NEAREST = 1e-12  # scene units


@dataclass(frozen=True)
class RgbdConstants:
    """Shapes of the Gaussians of a photo.

    All are chosen by hand and not tuned on a data set, unless a comment says otherwise.
    """

    # standard deviation in pixels, at which neighbours close into a surface: 99 % opaque when magnified
    std_px: float = 0.65
    thickness_px: float = 0.1  # standard deviation across the surface, in pixels
    steepest_hidden: float = 60.0  # slope up to which a hidden surface stays closed
    # slope of the last pixels before an edge: steeper ones would look like spikes from the side
    steepest_rim: float = 1.0
    opacity: float = 0.99  # opacity of an opaque pixel: the rasterizer makes no more of any


_C = RgbdConstants()
STD_PX, THICKNESS_PX, STEEPEST_RIM, OPAQUE = _C.std_px, _C.thickness_px, _C.steepest_rim, _C.opacity


def focal_length_px(field_of_view_deg: float, height_px: float, width_px: float) -> float:
    """Return the focal length of square pixels at which the longer side of the image takes an angle.

    Args:
        field_of_view_deg: The angle, 0..180 exclusive.
        height_px: Height of the image.
        width_px: Width of the image.

    Raises:
        InputError: The angle is out of its range.
    """
    if not 0 < field_of_view_deg < 180:
        raise InputError(f"field of view: expected degrees between 0 and 180, got {field_of_view_deg}")
    return max(height_px, width_px) / 2 / math.tan(math.radians(field_of_view_deg) / 2)


def known_camera(
    focal_px: Sequence[float] | None, principal_point_px: Sequence[float] | None, height: int, width: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return focal lengths and principal point of a photo, with the defaults of from_depth; raise InputError."""
    focal = _pair("focal_px", focal_px, (focal_length_px(FIELD_OF_VIEW_DEG, height, width),) * 2)
    if min(focal) <= 0:
        raise InputError(f"focal_px: expected pixels > 0, got {focal}")
    return focal, _pair("principal_point_px", principal_point_px, (width / 2, height / 2))


@torch.no_grad()
def from_depth(
    image: np.ndarray | Tensor,
    depth: np.ndarray | Tensor,
    focal_px: Sequence[float] | None = None,
    principal_point_px: Sequence[float] | None = None,
    *,
    margin_px: tuple[int, int, int, int] = (0, 0, 0, 0),
    margin: Margin = "texture",
    second: SecondEye | None = None,
    texture: bool = True,
) -> Gaussians:
    """Return the Gaussians of a photo with known depths: one per pixel, in its camera's axes (OpenCV, at the origin).

    Each Gaussian lies in the surface, with a standard deviation of 0.65 pixels as its own camera sees it. Its
    covariance is the pixel's, mapped by the inverse of the projection's Jacobian (EWA splatting, Zwicker et al. 2002,
    inverted). So a slanted surface stays closed when seen from the side. A surface seen at less than 5 degrees is torn
    instead; smoothed edges of the depth map are made sharp first. Behind an edge the far side continues in a second
    layer, with a smooth depth and the picture's texture (photo/hidden.py, photo/inpainting.py). Outlines are soft where
    the photo's are (photo/depth_edges.py).

    Args:
        image: [H, W, 3], or [H, W, 4] with straight alpha, floating point in 0..1, an array or a tensor; the work is
            done on its device.
        depth: [H, W], the view-space z of each pixel (not its distance along the ray), scene units. Values outside
            1e-12..1e12 count as not measured.
        focal_px: (fx, fy), pixels; None: the longer side takes 60 degrees.
        principal_point_px: (cx, cy), pixels from the outer corner of the first pixel; None: the middle.
        margin_px: (left, top, right, bottom), pixels around the photo that are made of its texture, as
            `lightfield_gs.photo.margin.fit_to_panel` returns them for a panel.
        margin: "texture": the margin has the photo's texture; "blur": blurred and darker colours of its border.
        second: The other eye of a stereo pair, whose colours and depths count where it sees behind edges.
        texture: Whether the far side gets the picture's texture. False: it continues in smooth colours, which takes a
            fraction of the time and does not flicker from picture to picture.

    Returns:
        Float32 Gaussians of SH degree 0. First come the pixels with a depth and an opacity, row by row; then outlines,
        the hidden layer and the margin.

    Raises:
        InputError: Shapes, types or values are invalid, or no pixel has a depth.
    """
    image, depth = _checked_image(image), _checked_depth(depth)
    expect("texture", texture, bool)
    if margin not in get_args(Margin):
        raise InputError(f"margin: expected {' or '.join(get_args(Margin))}, got {shown(margin)}")
    margin_px = _checked_margin(margin_px, image.shape[0], image.shape[1])
    height, width = depth.shape
    check_depth_size("depth", depth, image)
    depth = depth.to(image.device)
    opacity = _C.opacity * image[..., 3] if image.shape[2] == 4 else torch.full_like(depth, _C.opacity)
    measured = (depth >= NEAREST) & (depth <= FARTHEST) & (opacity >= OPACITY_CUT)
    depth = torch.where(measured, depth, torch.nan)
    if not bool(measured.any()):
        raise InputError("depth: expected distances > 0, no opaque pixel of the photo has one")
    focal, centre = known_camera(focal_px, principal_point_px, height, width)
    depth = merge_slivers(snap_mixed(depth, focal), image, focal)
    found = find_hidden(image[..., :3], depth, focal)
    behind = fill_hidden(found, depth) if texture else found.image
    if second is not None:
        found, behind = second.fill(found, behind, depth)
    parts = surface_layers(image, depth, opacity, found, behind, focal, centre)
    if any(margin_px):
        colours, z, outside = extend_with_margin(behind, 1 / found.disparity, margin_px, margin)
        corner = centre[0] + margin_px[0], centre[1] + margin_px[1]
        full = torch.full_like(z, _C.opacity)
        parts.append(_surface_gaussians(outside.nonzero(), z, full, colours, focal, corner, torn=False))
    return from_tensors(torch.cat(fields) for fields in zip(*parts))


def surface_layers(
    image: Tensor,
    depth: Tensor,
    opacity: Tensor,
    found: Hidden,
    behind: Tensor,
    focal: tuple[float, float],
    centre: tuple[float, float],
) -> list[tuple[Tensor, ...]]:
    """Return the Gaussians of the visible surface, of the soft outlines before it, and of the hidden layer.

    Args:
        image: [H, W, 3 or 4].
        depth: [H, W], sharp at its edges, NaN where nothing was measured.
        opacity: [H, W].
        found: The hidden layer.
        behind: [H, W, 3], its colours.
        focal: (fx, fy), pixels.
        centre: (cx, cy), pixels.

    Returns:
        Three lists of the fields of Gaussians, as from_tensors takes them.
    """
    colours = image[..., :3].clone()
    matte = find_matte(colours, depth, edges(depth, focal))
    is_near, rows, columns = matte.is_near, matte.rows, matte.columns
    colours[rows, columns] = torch.where(is_near[:, None], matte.near, matte.far)
    front_opacity = opacity.clone()
    # A pixel is transparent only where the surface behind it is known
    soft = is_near & found.hole[rows, columns]
    front_opacity[rows[soft], columns[soft]] *= (
        coverage_to_opacity(matte.alpha[soft], _C.std_px, _C.opacity) / _C.opacity
    )
    parts = [_surface_gaussians(torch.isfinite(depth).nonzero(), depth, front_opacity, colours, focal, centre)]
    before = ~is_near & (matte.alpha > 0)
    r, c = rows[before], columns[before]
    rim, front, cover = depth.clone(), colours.clone(), opacity.clone()
    rim[r, c], front[r, c] = matte.depth[before], matte.near[before]
    cover[r, c] *= coverage_to_opacity(matte.alpha[before], _C.std_px, _C.opacity) / _C.opacity
    parts.append(_surface_gaussians(torch.stack([r, c], 1), rim, cover, front, focal, centre))
    # Its slopes are its own: what covers it stands beside it where it ends
    z = torch.where(found.hole, 1 / found.disparity, torch.nan)
    parts.append(_surface_gaussians(found.hole.nonzero(), z, opacity, behind, focal, centre, torn=False))
    return parts


def _surface_gaussians(
    pixels: Tensor,
    depth: Tensor,
    opacity: Tensor,
    colours: Tensor,
    focal: tuple[float, float],
    centre: tuple[float, float],
    torn: bool = True,
) -> tuple[Tensor, ...]:
    """Return the Gaussians of pixels of a surface.

    Args:
        pixels: [M, 2] (row, column).
        depth: [H, W].
        opacity: [H, W].
        colours: [H, W, 3].
        focal: (fx, fy), pixels.
        centre: (cx, cy), pixels.
        torn: Whether the surface is open at edges.
    """
    rows, columns = pixels.unbind(1)
    steepest = STEEPEST if torn else _C.steepest_hidden
    z, across, down = (
        values[rows, columns]
        for values in (depth, slopes(depth, focal[0], steepest), slopes(depth.T, focal[1], steepest).T)
    )
    if torn:
        rim = max_filter(edges(depth, focal), 1)  # the pixels with another surface beside them, and their neighbours
        limit = torch.where(rim[rows, columns], _C.steepest_rim, torch.inf)
        across, down = (torch.minimum(torch.maximum(slope, -limit), limit) for slope in (across, down))
    slope_x, slope_y = (columns + 0.5 - centre[0]) / focal[0], (rows + 0.5 - centre[1]) / focal[1]
    rays = torch.stack([slope_x, slope_y, torch.ones_like(slope_x)], 1)
    x, y = torch.eye(3, device=z.device)[:2]
    tangents = (x + across[:, None] * rays, focal[0] / focal[1] * (y + down[:, None] * rays))
    return flat_gaussians(rays * z[:, None], tangents, z / focal[0], opacity[rows, columns], colours[rows, columns])


def flat_gaussians(
    means: Tensor, tangents: tuple[Tensor, Tensor], footprint: Tensor, opacities: Tensor, colours: Tensor
) -> tuple[Tensor, ...]:
    """Return fields of flat Gaussians [M, ...] with the covariance (std_px footprint)^2 (t_u t_u^T + t_v t_v^T).

    Args:
        means: [M, 3].
        tangents: t_u and t_v [M, 3], the steps in the surface from column to column and row to row, in footprints.
        footprint: [M], the width of a pixel there, scene units.
        opacities: [M].
        colours: [M, 3].
    """
    normal = torch.nn.functional.normalize(torch.linalg.cross(*tangents), dim=1)
    # The shortest turn of the z-axis to the normal. It points away from the camera, and so never at -z.
    turn = torch.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], torch.zeros_like(normal[:, 0])], 1)
    turn = torch.nn.functional.normalize(turn, dim=1)
    (a, b), (c, d) = ([(axis * tangent).sum(1) for tangent in tangents] for axis in _plane_axes(normal))
    # Eigenvectors and eigenvalues of the 2 x 2 covariance within the plane.
    xx, xy, yy = a * a + b * b, a * c + b * d, c * c + d * d
    angle, middle, radius = 0.5 * torch.atan2(2 * xy, xx - yy), (xx + yy) / 2, torch.hypot((xx - yy) / 2, xy)
    area = (a * d - b * c).abs()
    long = (middle + radius).sqrt()
    scales = footprint[:, None] * torch.stack(
        [_C.std_px * long, _C.std_px * area / long, torch.full_like(long, _C.thickness_px)], 1
    )
    cos, sin = torch.cos(angle / 2), torch.sin(angle / 2)
    w, x, y, _ = turn.unbind(1)
    quaternions = torch.stack([w * cos, x * cos + y * sin, y * cos - x * sin, w * sin], 1)
    return means, quaternions, scales, opacities, ((colours - 0.5) / SH_CONSTANT)[:, None]


def _plane_axes(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Return the x-axis and the y-axis after the shortest turn of the z-axis to the normal [M, 3], [M, 3] each."""
    nx, ny, nz = normal.unbind(1)
    shared = -nx * ny / (1 + nz)
    return (
        torch.stack([1 - nx * nx / (1 + nz), shared, -nx], 1),
        torch.stack([shared, 1 - ny * ny / (1 + nz), -ny], 1),
    )


def _checked_image(image: np.ndarray | Tensor) -> Tensor:
    """Return the photo as float32 [H, W, 3 or 4]; raise InputError."""
    image = to_tensor("photo", image)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or 0 in image.shape:
        raise InputError(f"photo: expected [H, W, 3] or [H, W, 4], got {list(image.shape)}")
    if not image.is_floating_point():
        raise InputError(f"photo: expected floating point values in 0..1, got {image.dtype}; divide by 255")
    check_photo_size("photo", image.shape[0], image.shape[1])
    if not bool(torch.isfinite(image).all()) or float(image.min()) < 0 or float(image.max()) > 1:
        raise InputError("photo: expected values in 0..1, got values outside or not finite")
    return image.to(torch.float32)


def check_photo_size(name: str, height: int, width: int) -> None:
    """Raise InputError where a photo has more pixels than may become Gaussians; name: of the photo."""
    if height * width > MAX_PIXELS:
        raise InputError(
            f"{name}: {width} x {height} pixels, each a Gaussian; expected at most {MAX_PIXELS}; make photo and depth "
            "map smaller"
        )


def check_depth_size(name: str, depth: np.ndarray | Tensor, photo: np.ndarray | Tensor) -> None:
    """Raise InputError where a depth map [H, W] differs in size from its photo [H, W, C]; name: of the map."""
    (height, width), expected = depth.shape, photo.shape[:2]
    if (height, width) != tuple(expected):
        raise InputError(
            f"{name}: expected a depth map of the photo's size {expected[1]} x {expected[0]}, got {width} "
            f"x {height}; resize one of them (the map without smoothing: it would join far and near)"
        )


def _checked_depth(depth: np.ndarray | Tensor) -> Tensor:
    depth = to_tensor("depth", depth)
    if depth.ndim != 2 or not depth.is_floating_point():
        raise InputError(f"depth: expected floating point [H, W], got {depth.dtype} {list(depth.shape)}")
    return depth.to(torch.float32)


def _checked_margin(margin_px: Sequence[int], height: int, width: int) -> tuple[int, int, int, int]:
    if not is_row(margin_px, 4):
        raise InputError(f"margin_px: expected pixels left, above, right and below, got {shown(margin_px)}")
    left, top, right, bottom = (whole_number("margin_px", part, 0, MAX_PIXELS) for part in margin_px)
    if (width + left + right) * (height + top + bottom) > _MOST_WITH_MARGIN:
        raise InputError(
            f"margin_px: {left}, {top}, {right}, {bottom} around a photo of {width} x {height}; expected at most "
            f"{_MOST_WITH_MARGIN} pixels in all; make both smaller, or leave the margin out (fit=cover)"
        )
    return left, top, right, bottom


def _pair(name: str, given: Sequence[float] | None, default: tuple[float, float]) -> tuple[float, float]:
    if given is None:
        return default
    try:
        expect(name, given, Sequence, np.ndarray)
        x, y = (float(value) for value in given)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: expected two numbers, got {type(given).__name__}") from None
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f"{name}: expected finite numbers, got {x}, {y}")
    return x, y
