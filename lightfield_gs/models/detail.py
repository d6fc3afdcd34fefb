"""Add the photo's resolution to the network's Gaussians: a sheet of small Gaussians over the visible surface.

The network's Gaussians are a translucent cloud some pixels deep, whose mean is a good surface and whose picture is
soft. A sheet lies along that surface: factor x factor texels for each pixel of the network's grid, Gaussians with the
photo's colours and opacities. The cloud in front of the sheet fades, since the photo shows it already. The cloud behind
the sheet stays, and shows where other views look past the sheet.

Everything is done on the grid of pixels, without a rasterizer: shapes depend on no values, so that CUDA can capture it
as a graph, and everything has gradients. For inference models/sheet.py makes the same texels natively.
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
from lightfield_gs.models.initializer import Pixels
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

# Variance in px^2 by which the rasterizer widens every Gaussian (Kerbl et al. 2023)
_WIDENING = 0.3
# A texel's blur on the screen, its own and the rasterizer's, as a variance in texels^2, and the least of its own
_BLUR, _LEAST_BLUR = 0.36, 0.2
# Optical depth of the sheet, -log of what shines through it: high enough to cover the cloud, low enough that of texels
# that overlap not only the nearest is seen, whose colour is that of a neighbour half the time
_OPTICAL_DEPTH, _MOST_OPAQUE = 1.8, 0.98
_MOST_OF_SHEET = -math.expm1(-_OPTICAL_DEPTH)  # the opacity of the sheet where the object is whole
_THICKNESS = 0.3  # standard deviation along the normal, texels
# How much of what blur takes from the photo is put back beforehand, of colours and of outlines
_SHARPER_COLOUR, _SHARPER_OUTLINE = 1.0, 2.0
# Opacities of a photo's pixels up to which they are the haze of a cut-out, and from which on they are the object
_HAZE, _OBJECT = 0.1, 0.3
# The cloud is averaged over its pixels with this deviation, in pixels: its Gaussians take turns in blocks of pixels
_AVERAGED = 2.0
_SOFTNESS = 1.5  # depth over which the cloud before the sheet fades, footprints
_STEEPEST = 3.0  # footprints of depth from texel to texel up to which the sheet closes
# Neighbours up to this many footprints nearer or farther are of the same surface; from twice as many on, of another.
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
    """The sheet, then the network's Gaussians, faded where they lie before it: N = (factor^2 + layers) * H * W.

    cloud: [B, layers * H * W, ...] as the network's composer gives it, in the axes of the photo's camera. pixels: those
    of the network's input, [B,.,H,W]; texels: those of the photo at [B,.,factor * H,factor * W], whose footprint is as
    much smaller. texel_px: width of a texel in pixels where it will be drawn. Differentiable.
    """
    surface, faded = sheet_surface(cloud, pixels, layers)
    disparity, harmonics = surface.disparity, surface.harmonics
    sheet = _sheet(along_surface(disparity, disparity, pixels.footprint, factor), texels, texel_px)
    if harmonics.shape[1]:
        rest = _flat(along_surface(harmonics, disparity, pixels.footprint, factor)).unflatten(2, (-1, 3))
        sheet = (*sheet[:4], torch.cat([sheet[4], rest], 2))
    return from_tensors(torch.cat(pair, dim=1) for pair in zip(sheet, faded.fields().values()))


class SheetSurface(NamedTuple):
    """Where the sheet lies on the network's grid: disparities 1/z [B,1,H,W], and harmonics beyond the first
    [B,3(K-1),H,W]."""

    disparity: Tensor
    harmonics: Tensor


def sheet_surface(cloud: Gaussians, pixels: Pixels, layers: int) -> tuple[SheetSurface, Gaussians]:
    """Where the sheet of with_detail lies, and the cloud under it, faded where it lies before it."""
    disparity, harmonics = visible_surface(cloud, pixels, layers)
    opacities = _faded(cloud, disparity, pixels.mask, layers, pixels.footprint)
    return SheetSurface(disparity, harmonics), replace(cloud, opacities=opacities)


def surface_look() -> _core.SurfaceLook:
    """What the native stage of sheet_surface has to know of this file."""
    return _core.SurfaceLook(averaged=_AVERAGED, softness=_SOFTNESS)


def sheet_look(texel_px: float) -> _core.SheetLook:
    """What the native stage of the texels has to know of it."""
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


def visible_surface(cloud: Gaussians, pixels: Pixels, layers: int) -> tuple[Tensor, Tensor]:
    """What the photo's camera sees of the cloud on average: disparities 1/z [B,1,H,W], and harmonics beyond the first
    [B,3(K-1),H,W].

    Near each pixel a layer is taken for a fog whose density along the line of sight is a normal distribution, so that
    the optical depth before each Gaussian is known in closed form, and with it how much of it is seen.
    """
    height, width = pixels.mask.shape[2:]
    values = torch.cat([1 / cloud.means[..., 2:], cloud.sh[:, :, 1:].flatten(2)], 2).transpose(1, 2)
    grids = [field.unflatten(2, (height, width)) for field in values.chunk(layers, 2)]
    areas = (cloud.opacities * _areas(cloud, pixels))[:, None].chunk(layers, 2)
    sizes = [area.unflatten(2, (height, width)) * pixels.mask + 1e-9 for area in areas]
    fogs = [_fog(size, grid[:, :1]) for size, grid in zip(sizes, grids)]
    total = torch.zeros_like(torch.cat([grids[0], sizes[0]], 1))
    for size, grid in zip(sizes, grids):
        # Nearer is of a larger disparity
        before = sum(thick * torch.special.ndtr((mean - grid[:, :1]) / spread) for thick, mean, spread in fogs)
        seen = size * torch.exp(-before)
        total = total + seen * torch.cat([grid, torch.ones_like(size)], 1)
    means = blurred(total, _AVERAGED)
    means = means[:, :-1] / means[:, -1:]
    return means[:, :1], means[:, 1:]


def _fog(size: Tensor, disparity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Optical depth, mean disparity and its standard deviation of a layer near each pixel, [B,1,H,W] each."""
    thick, first, second = blurred(torch.cat([size, size * disparity, size * disparity.square()], 1), _AVERAGED).split(
        1, 1
    )
    mean = first / thick
    return thick, mean, (second / thick - mean.square()).clamp_min(1e-8).sqrt()


def _areas(cloud: Gaussians, pixels: Pixels) -> Tensor:
    """The integral [B,N] over the photo of each Gaussian of the height 1, in pixels of the network's grid."""
    x, y, z = cloud.means.unbind(2)
    axes = rotations(F.normalize(cloud.quaternions, dim=2)) * cloud.scales[:, :, None]
    # The slopes x/z and y/z change by these for a standard deviation along each axis of the Gaussian
    across, down = (axes[:, :, row] - (place / z)[..., None] * axes[:, :, 2] for row, place in ((0, x), (1, y)))
    determinant = across.square().sum(2) * down.square().sum(2) - (across * down).sum(2).square()
    return 2 * math.pi * determinant.clamp_min(1e-20).sqrt() / (z * pixels.footprint[:, :, 0, 0]).square()


def _faded(cloud: Gaussians, disparity: Tensor, cover: Tensor, layers: int, footprint: Tensor) -> Tensor:
    """Opacities [B,N] of the cloud, those before the sheet fainter, as far as it covers [B,1,H,W] its pixel."""
    depth = (1 / disparity).flatten(1).repeat(1, layers)
    behind = (cloud.means[..., 2] / depth - 1) / footprint[:, :, 0, 0]
    return (cloud.opacities * (1 - cover.flatten(1).repeat(1, layers) * torch.sigmoid(-behind / _SOFTNESS))).clamp(0, 1)


def _sheet(disparity: Tensor, texels: Pixels, texel_px: float) -> tuple[Tensor, ...]:
    """Means, quaternions, scales, opacities and constant harmonics of the texels at these disparities [B,1,H,W]."""
    depth = 1 / disparity
    size = texels.footprint * depth
    own, blur = _blurs(texel_px)
    axes, stretch = _tangents(disparity, texels)
    deviation = math.sqrt(own) * size
    scales = torch.cat([deviation * stretch, deviation, _THICKNESS * size], 1)
    mask, colour = _sharpened(texels, math.sqrt(blur))
    opacity = (_opacity(blur) * mask).clamp(0, _MOST_OPAQUE)
    means = torch.cat([texels.rays * depth, depth], 1)
    constant = (_flat(colour)[:, :, None] - 0.5) / SH_CONSTANT
    return _flat(means), _flat(axes), _flat(scales), opacity.flatten(1), constant


def _blurs(texel_px: float) -> tuple[float, float]:
    """Variances in texels^2 of a texel, and of it as it is drawn."""
    widening = _WIDENING / texel_px**2
    own = max(_BLUR - widening, _LEAST_BLUR)
    return own, own + widening


def _opacity(blur: float) -> float:
    """Of a texel whose pixel is covered in full."""
    return min(_OPTICAL_DEPTH / (2 * math.pi * blur), _MOST_OPAQUE)


def _sharpened(texels: Pixels, deviation: float) -> tuple[Tensor, Tensor]:
    """Optical depths of the texels, 1 where the object is whole, and colours, which are about those of the photo when
    they are blurred with this deviation in texels."""
    mask = texels.mask
    # What overlaps adds up as optical depth, and only that may be blurred and sharpened: half an opacity takes much
    # less than half the depth of a whole one. It gets less yet, for what spreads beyond the outline cannot be taken
    # back there.
    depth = -torch.log1p(-_MOST_OF_SHEET * mask) / _OPTICAL_DEPTH * mask
    soft = blurred(torch.cat([texels.colour * mask, mask, depth], 1), deviation)
    near = soft[:, :3] / soft[:, 3:4].clamp_min(1e-3)
    colour = texels.colour + _SHARPER_COLOUR * (texels.colour - near)
    outline = (depth + _SHARPER_OUTLINE * (depth - soft[:, 4:])).clamp_min(0)
    there = ((mask - _HAZE) / (_OBJECT - _HAZE)).clamp(0, 1)
    return outline * there, torch.where(there > 0, colour, texels.colour).clamp(0, 1)


def _tangents(disparity: Tensor, texels: Pixels) -> tuple[Tensor, Tensor]:
    """Rotations [B,4,H,W] to the surface's direction of descent, its level direction and its normal; and by how much
    [B,1,H,W] texels lie farther apart along the first than across the line of sight."""
    # dz/du in footprints, for z = 1/disparity; of both neighbours the less steep, so that edges stay open
    slopes = []
    for axis in (3, 2):
        ahead = disparity.diff(dim=axis)
        none = torch.zeros_like(disparity.narrow(axis, 0, 1))
        step = minmod(torch.cat([ahead, none], axis), torch.cat([none, ahead], axis))
        slopes.append((-step / (disparity * texels.footprint)).clamp(-_STEEPEST, _STEEPEST))
    across, down = slopes
    ray = torch.cat([texels.rays, torch.ones_like(disparity)], 1)
    unit = torch.eye(3, dtype=ray.dtype, device=ray.device)[:, None, :, None, None]
    tangent_x, tangent_y = unit[0] + across * ray, unit[1] + down * ray
    # A surface that is level all over descends to the right: the small number decides, and keeps gradients finite
    right = torch.where(across < 0, across - 1e-4, across + 1e-4)
    length = (right.square() + down.square()).sqrt()
    turn_x, turn_y = right.abs() / length, torch.where(across < 0, -down, down) / length
    descent = turn_x * tangent_x + turn_y * tangent_y
    stretch = descent.square().sum(1, keepdim=True).sqrt()
    first, third = descent / stretch, F.normalize(torch.linalg.cross(tangent_x, tangent_y, dim=1), dim=1)
    return _quaternions(first, torch.linalg.cross(third, first, dim=1), third), stretch


def _quaternions(first: Tensor, second: Tensor, third: Tensor) -> Tensor:
    """[B,4,H,W], w first, of the rotations with these columns [B,3,H,W], which turn by less than 180 degrees."""
    w = (1 + first[:, 0] + second[:, 1] + third[:, 2]).clamp_min(1e-6).sqrt() / 2
    x = (second[:, 2] - third[:, 1]) / (4 * w)
    y = (third[:, 0] - first[:, 2]) / (4 * w)
    z = (first[:, 1] - second[:, 0]) / (4 * w)
    return torch.stack([w, x, y, z], 1)


def _flat(channels: Tensor) -> Tensor:
    """[B,C,H,W] to [B,H*W,C]."""
    return channels.flatten(2).transpose(1, 2)


def blurred(channels: Tensor, deviation: float) -> Tensor:
    """channels [B,C,H,W] convolved with a Gaussian of this standard deviation in pixels, zeros beyond the edges."""
    reach = math.ceil(3 * deviation)
    places = torch.arange(-reach, reach + 1, dtype=channels.dtype, device=channels.device)
    weights = torch.exp(-0.5 * (places / deviation).square())
    weights = (weights / weights.sum()).view(1, 1, 1, -1)
    each = channels.flatten(0, 1)[:, None]
    each = F.conv2d(each, weights, padding=(0, reach))
    each = F.conv2d(each, weights.transpose(2, 3), padding=(reach, 0))
    return each[:, 0].view_as(channels)


def minmod(one: Tensor, other: Tensor) -> Tensor:
    """The smaller of two steps where both go the same way, else 0."""
    return torch.where(one * other > 0, torch.where(one.abs() < other.abs(), one, other), 0.0)


def along_surface(channels: Tensor, disparity: Tensor, footprint: Tensor, factor: int) -> Tensor:
    """channels [B,C,H,W] at [B,C,factor*H,factor*W]: bilinear between pixels of one surface.

    disparity [B,1,H,W] and footprint [B,1,1,1] (width of a pixel at depth 1) tell which pixels are of one surface:
    neighbours whose depths differ by three footprints at most count in full, from six on not at all.
    """
    if factor == 1:
        return channels
    fields = torch.cat([channels, disparity.log() / footprint], 1)
    around = {at: _shifted(fields, *at) for at in itertools.product((-1, 0, 1), repeat=2)}
    middle = fields[:, -1:]
    near = {at: (2 - (field[:, -1:] - middle).abs() / SAME_SURFACE).clamp(0, 1) for at, field in around.items()}
    rows = []
    for row in range(factor):
        # Every texel lies between its own pixel and three others, towards its corner of the pixel
        side_y, part_y = _between(row, factor)
        texels = []
        for column in range(factor):
            side_x, part_x = _between(column, factor)
            weights = {
                (y, x): share_y * share_x * near[y, x]
                for y, share_y in ((0, 1 - part_y), (side_y, part_y))
                for x, share_x in ((0, 1 - part_x), (side_x, part_x))
            }
            shares = torch.stack(list(weights.values()))
            values = torch.stack([around[at][:, :-1] for at in weights])
            texels.append((shares * values).sum(0) / shares.sum(0))
        rows.append(torch.stack(texels, -1))
    return torch.stack(rows, 3).flatten(4, 5).flatten(2, 3)


def _between(index: int, factor: int) -> tuple[int, float]:
    """For a texel of a pixel: towards which neighbour it lies, -1 or 1, and that neighbour's share."""
    place = (index + 0.5) / factor - 0.5
    return (1 if place > 0 else -1), abs(place)


def _shifted(fields: Tensor, down: int, right: int) -> Tensor:
    """fields [B,C,H,W] of the pixels so far down and to the right, 1 at most; beyond the edges those of the edge."""
    height, width = fields.shape[2:]
    padded = F.pad(fields, (1, 1, 1, 1), mode="replicate")
    return padded[:, :, 1 + down : 1 + down + height, 1 + right : 1 + right + width]
