"""Add the photo's resolution to the network's Gaussians: a sheet of small Gaussians over the visible surface.

The network's Gaussians are a translucent cloud some pixels deep, whose mean is a good surface and whose picture is
soft. A sheet lies along that surface: factor x factor texels for each pixel of the network's grid, Gaussians with the
photo's colours and opacities. Where the surface ends before another, models/ramps.py keeps both apart. The cloud in
front of the sheet fades, since the photo shows it already. The cloud behind the sheet shows where other views look past
the sheet, and is made more solid for that.

Everything is computed on the grid of pixels, without a rasterizer, and has gradients. Shapes depend on no values, so
that CUDA can capture it as a graph. For inference models/sheet.py makes the same texels natively.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.harmonics import SH_CONSTANT, rotations
from lightfield_gs.models.initializer import Pixels, flat
from lightfield_gs.models.ramps import least_step, snap_ramps, upsample_covered
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

# Variance in px^2 by which the rasterizer widens every Gaussian (Kerbl et al. 2023)
_WIDENING = 0.3
# Variance in texels^2 of a displayed texel, with the rasterizer's widening; and the least without it
_BLUR, _LEAST_BLUR = 0.36, 0.2
# Optical depth of the sheet, -log of its transmittance. It is high enough to cover the cloud, and low enough that all
# overlapping texels are visible: the nearest is a neighbour's half the time
_OPTICAL_DEPTH, _MOST_OPAQUE = 1.8, 0.98
_MOST_OF_SHEET = -math.expm1(-_OPTICAL_DEPTH)  # opacity of the sheet where the object is opaque
_THICKNESS = 0.3  # standard deviation along the normal, texels
# Strength of the sharpening against the blur, of colours and of outlines
_SHARPER_COLOUR, _SHARPER_OUTLINE = 1.0, 2.0
# Opacities of a photo's pixels: at most _HAZE is haze of a cut-out, at least _OBJECT is the object
_HAZE, _OBJECT = 0.1, 0.3
# Standard deviation in pixels of the cloud's average, since its Gaussians alternate in blocks of pixels
_AVERAGED = 2.0
_MOST_CLOUD = 0.999  # opacity of a Gaussian of the cloud at most, since its logarithm is taken
_SOFTNESS = 1.5  # depth over which the cloud in front of the sheet fades, footprints
# The cloud is translucent where the network is unsure of the outline, and its large Gaussians make soft edges. Its
# optical depths are multiplied by the square of their sum over _SOLID, at most by _MOST_SOLID: thin parts vanish, thick
# ones become opaque. Its Gaussians shrink by _SHRUNK, and go back by _BACK footprints, a pixel of parallax at 15
# degrees, so that the outline from there stays in place. The first layer is in the sheet and would show through it as
# beads: it only vanishes. Chosen and reported on nine photos of the development data and 24 textured objects of 512 px
_SOLID, _MOST_SOLID, _SHRUNK, _BACK = 3.0, 6.0, 0.75, 1 / math.tan(math.radians(15))
_STEEPEST = 3.0  # footprints of depth between texels: steeper gaps of the sheet stay open
# Depth in footprints between neighbours of one surface; from twice this depth on they belong to two surfaces.
SAME_SURFACE = 3.0


@dataclass(frozen=True)
class DetailLevel:
    """Resolution of the sheet that with_detail lays over the network's Gaussians.

    Attributes:
        factor: texels per side of each pixel of the network's grid.
        texel_px: width of a texel where it is displayed, in pixels.
    """

    factor: int
    texel_px: float = 1.0


def with_detail(
    cloud: Gaussians, pixels: Pixels, texels: Pixels, layers: int, factor: int, texel_px: float = 1.0
) -> Gaussians:
    """Add the sheet to the network's Gaussians. Differentiable.

    Args:
        cloud: [B, layers * H * W, ...] from the composer, in the axes of the photo's camera.
        pixels: of the network's input, [B,.,H,W].
        texels: of the photo, [B,.,factor * H,factor * W], with a smaller footprint in proportion.
        layers: of the cloud.
        factor: texels per side of a pixel.
        texel_px: width of a texel where it is displayed, in pixels.

    Returns:
        N = (factor^2 + layers) * H * W Gaussians: the sheet, then the cloud, faded in front of the sheet.
    """
    surface, faded = sheet_surface(cloud, pixels, layers)
    disparity, harmonics = surface.disparity, surface.harmonics
    fine = upsample_covered(disparity, pixels.mask, factor)
    fine = snap_ramps(fine, texels.colour, texels.mask, texels.footprint, factor)
    sheet = _sheet(fine, texels, texel_px)
    if harmonics.shape[1]:
        rest = flat(upsample_along_surface(harmonics, disparity, pixels.footprint, factor)).unflatten(2, (-1, 3))
        sheet = (*sheet[:4], torch.cat([sheet[4], rest], 2))
    return from_tensors(torch.cat(pair, dim=1) for pair in zip(sheet, faded.fields().values()))


class SheetSurface(NamedTuple):
    """The surface of the sheet on the network's grid.

    Attributes:
        disparity: 1/z, [B,1,H,W].
        harmonics: coefficients beyond the first, [B,3(K-1),H,W].
    """

    disparity: Tensor
    harmonics: Tensor


def sheet_surface(cloud: Gaussians, pixels: Pixels, layers: int) -> tuple[SheetSurface, Gaussians]:
    """Return the surface of the sheet of with_detail, and the cloud, faded in front of it.

    Args:
        cloud, pixels, layers: see with_detail.
    """
    disparity, harmonics, thickness = visible_surface(cloud, pixels, layers)
    cloud = _solid(cloud, thickness, layers, pixels.footprint)
    opacities = _faded(cloud, disparity, pixels.mask, layers, pixels.footprint)
    return SheetSurface(disparity, harmonics), replace(cloud, opacities=opacities)


def surface_look() -> _core.SurfaceLook:
    """Return the constants of the native stage of sheet_surface."""
    return _core.SurfaceLook(
        averaged=_AVERAGED, softness=_SOFTNESS, solid=_SOLID, most_solid=_MOST_SOLID, shrunk=_SHRUNK, back=_BACK
    )


def sheet_look(texel_px: float) -> _core.SheetLook:
    """Return the constants of the native stage of the texels."""
    own, blur = _blurs(texel_px)
    return _core.SheetLook(
        deviation=math.sqrt(own),
        thickness=_THICKNESS,
        blur=math.sqrt(blur),
        opacity=_opacity(blur),
        most_opaque=_MOST_OPAQUE,
        most_of_sheet=_MOST_OF_SHEET,
        sharper_colour=_SHARPER_COLOUR,
        sharper_outline=_SHARPER_OUTLINE,
        haze=_HAZE,
        object=_OBJECT,
        same_surface=SAME_SURFACE,
        steepest=_STEEPEST,
    )


def visible_surface(cloud: Gaussians, pixels: Pixels, layers: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the average surface of the cloud as the photo's camera sees it.

    Near each pixel a layer is taken as a fog whose density along the line of sight is a normal distribution. So the
    optical depth in front of each Gaussian is known in closed form, and with it the Gaussian's visibility.

    Args:
        cloud: [B, layers * H * W, ...].
        pixels: [B,.,H,W].
        layers: of the cloud.

    Returns:
        Disparities 1/z [B,1,H,W], harmonics beyond the first [B,3(K-1),H,W], and the optical depth [B,1,H,W] of the
        cloud near each pixel.
    """
    height, width = pixels.mask.shape[2:]
    values = torch.cat([1 / cloud.means[..., 2:], cloud.sh[:, :, 1:].flatten(2)], 2).transpose(1, 2)
    grids = [field.unflatten(2, (height, width)) for field in values.chunk(layers, 2)]
    areas = (cloud.opacities * _areas(cloud, pixels))[:, None].chunk(layers, 2)
    sizes = [area.unflatten(2, (height, width)) * pixels.mask + 1e-9 for area in areas]
    fogs = [_fog(size, grid[:, :1]) for size, grid in zip(sizes, grids)]
    total = torch.zeros_like(torch.cat([grids[0], sizes[0]], 1))
    for size, grid in zip(sizes, grids):
        # Nearer means larger disparity
        before = sum(thick * torch.special.ndtr((mean - grid[:, :1]) / spread) for thick, mean, spread in fogs)
        visibility = size * torch.exp(-before)
        total = total + visibility * torch.cat([grid, torch.ones_like(size)], 1)
    means = blur(total, _AVERAGED)
    means = means[:, :-1] / means[:, -1:]
    return means[:, :1], means[:, 1:], torch.stack([thick for thick, _, _ in fogs]).sum(0)


def _fog(size: Tensor, disparity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return optical depth, mean disparity and its standard deviation of a layer near each pixel, [B,1,H,W] each."""
    moments = torch.cat([size, size * disparity, size * disparity.square()], 1)
    thick, first, second = blur(moments, _AVERAGED).split(1, 1)
    mean = first / thick
    return thick, mean, (second / thick - mean.square()).clamp_min(1e-8).sqrt()


def _areas(cloud: Gaussians, pixels: Pixels) -> Tensor:
    """Return the integral [B,N] over the photo of each Gaussian of height 1, in pixels of the network's grid."""
    x, y, z = cloud.means.unbind(2)
    axes = rotations(F.normalize(cloud.quaternions, dim=2)) * cloud.scales[:, :, None]
    # Change of the slopes x/z and y/z for a standard deviation along each axis of the Gaussian
    across, down = (axes[:, :, row] - (offset / z)[..., None] * axes[:, :, 2] for row, offset in ((0, x), (1, y)))
    determinant = across.square().sum(2) * down.square().sum(2) - (across * down).sum(2).square()
    return 2 * math.pi * determinant.clamp_min(1e-20).sqrt() / (z * pixels.footprint[:, :, 0, 0]).square()


def _solid(cloud: Gaussians, thickness: Tensor, layers: int, footprint: Tensor) -> Gaussians:
    """Return the cloud, opaque or nothing as its optical depth [B,1,H,W] decides, with crisper outlines."""
    first = thickness[0].numel()
    gain = (thickness / _SOLID).square().flatten(1)
    gain = torch.cat([gain.clamp_max(1), gain.clamp_max(_MOST_SOLID).repeat(1, layers - 1)], 1)
    opacities = -torch.expm1(gain * torch.log1p(-cloud.opacities.clamp_max(_MOST_CLOUD)))
    farther = (1 + _BACK * footprint[:, :, 0]).expand(-1, cloud.means.shape[1] - first, 1)
    same = torch.ones_like(cloud.means[:, :first, :1])
    means, scales = (torch.cat([same, factors], 1) for factors in (farther, _SHRUNK * farther))
    return replace(cloud, means=cloud.means * means, scales=cloud.scales * scales, opacities=opacities)


def _faded(cloud: Gaussians, disparity: Tensor, cover: Tensor, layers: int, footprint: Tensor) -> Tensor:
    """Return opacities [B,N] of the cloud, reduced in front of the sheet where `cover` [B,1,H,W] is opaque."""
    depth = (1 / disparity).flatten(1).repeat(1, layers)
    behind = (cloud.means[..., 2] / depth - 1) / footprint[:, :, 0, 0]
    return (cloud.opacities * (1 - cover.flatten(1).repeat(1, layers) * torch.sigmoid(-behind / _SOFTNESS))).clamp(0, 1)


def _sheet(disparity: Tensor, texels: Pixels, texel_px: float) -> tuple[Tensor, ...]:
    """Return means, quaternions, scales, opacities and constant harmonics of the texels at disparities [B,1,H,W]."""
    depth = 1 / disparity
    size = texels.footprint * depth
    own, blur = _blurs(texel_px)
    axes, stretch = _tangents(disparity, texels)
    deviation = math.sqrt(own) * size
    scales = torch.cat([deviation * stretch, deviation, _THICKNESS * size], 1)
    mask, colour = _sharpened(texels, math.sqrt(blur))
    opacity = (_opacity(blur) * mask).clamp(0, _MOST_OPAQUE)
    means = torch.cat([texels.rays * depth, depth], 1)
    constant = (flat(colour)[:, :, None] - 0.5) / SH_CONSTANT
    return flat(means), flat(axes), flat(scales), opacity.flatten(1), constant


def _blurs(texel_px: float) -> tuple[float, float]:
    """Return the variances in texels^2 of a texel, and of its projection with the rasterizer's widening."""
    widening = _WIDENING / texel_px**2
    own = max(_BLUR - widening, _LEAST_BLUR)
    return own, own + widening


def _opacity(blur: float) -> float:
    """Return the opacity of a texel whose pixel is fully covered."""
    return min(_OPTICAL_DEPTH / (2 * math.pi * blur), _MOST_OPAQUE)


def _sharpened(texels: Pixels, deviation: float) -> tuple[Tensor, Tensor]:
    """Sharpen the texels against the blur of their projection, whose standard deviation is in texels.

    Returns:
        Optical depths, 1 where the object is opaque, and colours, which blurred are about the photo's.
    """
    mask = texels.mask
    # Optical depths of overlapping texels add up, so they are blurred and sharpened, not opacities. Half an opacity has
    # much less than half the optical depth. The depth is reduced further, since spread beyond the outline is not
    # undone.
    depth = -torch.log1p(-_MOST_OF_SHEET * mask) / _OPTICAL_DEPTH * mask
    soft = blur(torch.cat([texels.colour * mask, mask, depth], 1), deviation)
    near = soft[:, :3] / soft[:, 3:4].clamp_min(1e-3)
    colour = texels.colour + _SHARPER_COLOUR * (texels.colour - near)
    outline = (depth + _SHARPER_OUTLINE * (depth - soft[:, 4:])).clamp_min(0)
    there = ((mask - _HAZE) / (_OBJECT - _HAZE)).clamp(0, 1)
    return outline * there, torch.where(there > 0, colour, texels.colour).clamp(0, 1)


def _tangents(disparity: Tensor, texels: Pixels) -> tuple[Tensor, Tensor]:
    """Return the frames of the surface at the texels, and their stretch.

    Returns:
        Rotations [B,4,H,W] to the surface's direction of descent, its level direction and its normal. And the ratio
        [B,1,H,W] of the texels' spacing along the first to that across the line of sight.
    """
    # dz/du in footprints, z = 1/disparity: the less steep of both neighbours, so that edges stay open
    slopes = []
    for axis in (3, 2):
        step = least_step(disparity, axis)
        slopes.append((-step / (disparity * texels.footprint)).clamp(-_STEEPEST, _STEEPEST))
    across, down = slopes
    ray = torch.cat([texels.rays, torch.ones_like(disparity)], 1)
    unit = torch.eye(3, dtype=ray.dtype, device=ray.device)[:, None, :, None, None]
    tangent_x, tangent_y = unit[0] + across * ray, unit[1] + down * ray
    # A level surface descends to the right: the small number decides, and keeps gradients finite
    right = torch.where(across < 0, across - 1e-4, across + 1e-4)
    length = (right.square() + down.square()).sqrt()
    turn_x, turn_y = right.abs() / length, torch.where(across < 0, -down, down) / length
    descent = turn_x * tangent_x + turn_y * tangent_y
    stretch = descent.square().sum(1, keepdim=True).sqrt()
    first, third = descent / stretch, F.normalize(torch.linalg.cross(tangent_x, tangent_y, dim=1), dim=1)
    return _quaternions(first, torch.linalg.cross(third, first, dim=1), third), stretch


def _quaternions(first: Tensor, second: Tensor, third: Tensor) -> Tensor:
    """Return quaternions [B,4,H,W], w first, of rotations by less than 180 degrees with these columns [B,3,H,W]."""
    w = (1 + first[:, 0] + second[:, 1] + third[:, 2]).clamp_min(1e-6).sqrt() / 2
    x = (second[:, 2] - third[:, 1]) / (4 * w)
    y = (third[:, 0] - first[:, 2]) / (4 * w)
    z = (first[:, 1] - second[:, 0]) / (4 * w)
    return torch.stack([w, x, y, z], 1)


def blur(channels: Tensor, deviation: float) -> Tensor:
    """Convolve with a Gaussian, with zeros beyond the edges.

    Args:
        channels: [B,C,H,W].
        deviation: standard deviation in pixels.
    """
    reach = math.ceil(3 * deviation)
    offsets = torch.arange(-reach, reach + 1, dtype=channels.dtype, device=channels.device)
    weights = torch.exp(-0.5 * (offsets / deviation).square())
    weights = (weights / weights.sum()).view(1, 1, 1, -1)
    each = channels.flatten(0, 1)[:, None]
    each = F.conv2d(each, weights, padding=(0, reach))
    each = F.conv2d(each, weights.transpose(2, 3), padding=(reach, 0))
    return each[:, 0].view_as(channels)


def upsample_along_surface(channels: Tensor, disparity: Tensor, footprint: Tensor, factor: int) -> Tensor:
    """Upsample bilinearly between pixels of one surface.

    Neighbours whose depths differ by at most three footprints count in full, from six on not at all.

    Args:
        channels: [B,C,H,W].
        disparity: [B,1,H,W].
        footprint: [B,1,1,1], width of a pixel at depth 1.
        factor: of the resolution.

    Returns:
        [B,C,factor*H,factor*W].
    """
    if factor == 1:
        return channels
    fields = torch.cat([channels, disparity.log() / footprint], 1)
    around = {at: _shifted(fields, *at) for at in itertools.product((-1, 0, 1), repeat=2)}
    middle = fields[:, -1:]
    near = {at: (2 - (field[:, -1:] - middle).abs() / SAME_SURFACE).clamp(0, 1) for at, field in around.items()}
    rows = []
    for row in range(factor):
        # A texel lies between its own pixel and three others, towards its corner of the pixel
        side_y, part_y = _between(row, factor)
        texels = []
        for column in range(factor):
            side_x, part_x = _between(column, factor)
            weights = {
                (y, x): weight_y * weight_x * near[y, x]
                for y, weight_y in ((0, 1 - part_y), (side_y, part_y))
                for x, weight_x in ((0, 1 - part_x), (side_x, part_x))
            }
            stacked = torch.stack(list(weights.values()))
            values = torch.stack([around[at][:, :-1] for at in weights])
            texels.append((stacked * values).sum(0) / stacked.sum(0))
        rows.append(torch.stack(texels, -1))
    return torch.stack(rows, 3).flatten(4, 5).flatten(2, 3)


def _between(index: int, factor: int) -> tuple[int, float]:
    """Return the direction of the neighbour nearest to a texel, -1 or 1, and the neighbour's weight."""
    offset = (index + 0.5) / factor - 0.5
    return (1 if offset > 0 else -1), abs(offset)


def _shifted(fields: Tensor, down: int, right: int) -> Tensor:
    """Return fields [B,C,H,W] shifted by at most one pixel down and to the right; edge pixels repeat."""
    height, width = fields.shape[2:]
    padded = F.pad(fields, (1, 1, 1, 1), mode="replicate")
    return padded[:, :, 1 + down : 1 + down + height, 1 + right : 1 + right + width]
