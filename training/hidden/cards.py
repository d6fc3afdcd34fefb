"""Planes of compositions: walls and floors without an end, and cards cut to the shapes of blobs and bars.

Each wears a picture, repeated in mirror images. A smooth relief bends the walls a little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from training.data.uniform import Numbers
from training.hidden.pictures import PIECE_PX

WALL, SIDE, FLOOR, BLOB = range(4)  # the places of a scene's cards; the last one is a blob or a bar
CARDS = 4
CARD_NUMBERS = 48  # uniform numbers that a card takes, at most
_HARMONICS = 5  # of a blob's outline
_FARTHEST = 200.0  # z beyond which a plane is not drawn
_MIP_FACTORS = (1, 4, 16)  # reductions of a picture between which a far part of a plane is mixed


@dataclass(frozen=True)
class Cards:
    """B scenes of CARDS planes, float32 unless stated.

    Attributes:
        exists: bool [B,C].
        normals, points: [B,C,3], in the camera's axes.
        across, down: [B,C,3], unit axes within the plane.
        pieces: int64 [B,C], numbers of pictures.
        density: [B,C], pictures per scene unit.
        place: [B,C,2], of the plane's point, in pictures.
        order: int64 [B,C,3], the channel that each channel shows.
        gain: [B,C,3], gamma: [B,C], colour = gain * own^gamma.
        radius: [B,C], of blobs and bars, scene units; infinite: without an end.
        outline: [B,C,2,_HARMONICS], amplitudes and phases of a blob's radius.
        length: [B,C], of bars by their radius; 0: a blob.
        relief: [B,C,6], amplitude, wave numbers along x and y, and phases.
    """

    exists: Tensor
    normals: Tensor
    points: Tensor
    across: Tensor
    down: Tensor
    pieces: Tensor
    density: Tensor
    place: Tensor
    order: Tensor
    gain: Tensor
    gamma: Tensor
    radius: Tensor
    outline: Tensor
    length: Tensor
    relief: Tensor


def draw_cards(u: Numbers, pictures: int, farthest: np.ndarray, focal_px: float, size_px: int) -> Cards:
    """Draw the planes of B scenes.

    Args:
        u: Numbers of B CARDS rows.
        pictures: How many pictures there are.
        farthest: [B], z of the wall in the picture's middle; the nearest thing is at about 1.
        focal_px, size_px: Of the pictures.
    """
    shape = (len(farthest), CARDS)
    exists = u().reshape(shape) < np.array([1.0, 0.35, 0.5, 0.5])
    # The point of the plane that the middle of the picture, or a place of a card in it, sees
    at = u.between(-0.35, 0.35, 2).reshape(*shape, 2) * np.array([0, 0, 0, 1])[:, None]
    z = np.repeat(farthest[:, None], CARDS, 1)
    card_depth = np.exp(u().reshape(shape) * np.log(0.9 * z))
    z = np.where(np.arange(CARDS) == BLOB, np.maximum(card_depth, 0.9), z)
    rays = np.concatenate([at * size_px / focal_px, np.ones((*shape, 1))], -1)
    points = rays * z[..., None]
    half = size_px / 2 / focal_px
    yaw, pitch = (np.radians(u.between(-50, 50)).reshape(shape) * (u().reshape(shape) ** 1.5) for _ in range(2))
    # The corners of the picture still see the wall, at ten times its distance at most
    yaw, pitch = (np.clip(angle, -np.arctan(0.45 / half), np.arctan(0.45 / half)) for angle in (yaw, pitch))
    normals = np.stack([np.sin(yaw), np.sin(pitch), -np.ones(shape)], -1)
    side, up = np.where(u().reshape(shape) < 0.5, -1, 1), u.between(0.3, 1.0).reshape(shape)
    lean = u.between(0.1, 0.6).reshape(shape)
    floor = np.stack([np.zeros(shape), -np.ones(shape), -lean * half], -1)
    wall = np.stack([-side, np.zeros(shape), -lean * half], -1)
    normals[:, FLOOR], normals[:, SIDE] = floor[:, FLOOR], wall[:, SIDE]
    # A floor goes through a line low in the picture, at a depth before the wall
    before = z * u.between(0.6, 0.95).reshape(shape)
    points[:, FLOOR] = (np.stack([0 * up, up * half, np.ones(shape)], -1) * before[..., None])[:, FLOOR]
    points[:, SIDE] = (np.stack([side * up * half, 0 * up, np.ones(shape)], -1) * before[..., None])[:, SIDE]
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    turn = np.where(u() < 0.5, u.between(-np.pi, np.pi), np.radians(u.between(-6, 6))).reshape(shape)
    basis = np.cross(normals, np.where(np.abs(normals[..., 1:2]) > 0.8, [1.0, 0, 0], [0, 1.0, 0]))
    basis /= np.linalg.norm(basis, axis=-1, keepdims=True)
    other = np.cross(normals, basis)
    cos, sin = np.cos(turn)[..., None], np.sin(turn)[..., None]
    texel = points[..., 2] / focal_px * np.exp(u.between(np.log(0.5), np.log(1.6)).reshape(shape))
    recolour = u().reshape(shape)[..., None] < 0.6
    radius = np.exp(u.between(np.log(0.03), np.log(0.35)).reshape(shape)) * size_px / focal_px * z
    is_bar = u().reshape(shape) < 0.4
    radius = np.where(np.arange(CARDS) == BLOB, np.where(is_bar, 0.3 * radius, radius), np.inf)
    waves = np.stack([u(_HARMONICS).reshape(*shape, -1), u.between(-np.pi, np.pi, _HARMONICS).reshape(*shape, -1)], -2)
    waves[..., 0, :] *= 0.5 / np.arange(1, _HARMONICS + 1)
    relief = np.concatenate([0.04 * u(1), u.between(1, 8, 2), u.between(-np.pi, np.pi, 3)], -1).reshape(*shape, 6)
    relief[..., 0] *= (np.arange(CARDS) == WALL) * (u().reshape(shape) < 0.5)
    return Cards(
        torch.from_numpy(exists),
        *(_floats(part) for part in (normals, points, cos * basis + sin * other, cos * other - sin * basis)),
        torch.from_numpy(np.floor(pictures * u()).astype(np.int64).reshape(shape)),
        _floats(1 / (texel * PIECE_PX)),
        _floats(u.between(0, 2, 2).reshape(*shape, 2)),
        torch.from_numpy(np.where(recolour, np.argsort(u(3).reshape(*shape, 3), -1), np.arange(3))),
        _floats(np.where(recolour, 0.6 + 0.5 * u(3).reshape(*shape, 3), 1)),
        _floats(np.where(recolour[..., 0], np.exp(u.between(-0.6, 0.5).reshape(shape)), 1)),
        _floats(radius),
        _floats(waves),
        _floats(np.where(is_bar, u.between(4, 60).reshape(shape), 0)),
        _floats(relief),
    )


def render_cards(cards: Cards, pictures: Tensor, focal_px: float, size_px: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the planes, each by itself.

    Args:
        pictures: uint8 [T,3,PIECE_PX,PIECE_PX].
        focal_px, size_px: Of the pictures.

    Returns:
        Colours [B,C,3,S,S], 0..1, not premultiplied; coverage [B,C,S,S]; z, infinite where nothing is, [B,C,S,S].
    """
    count = cards.exists.shape[0]
    grid = (torch.arange(size_px, device=pictures.device) + 0.5 - size_px / 2) / focal_px
    x, y = (part.expand(size_px, size_px) for part in (grid[None], grid[:, None]))
    rays = torch.stack([x, y, torch.ones_like(x)], -1)
    normals = cards.normals[:, :, None, None]
    facing = (normals * rays).sum(-1)
    z = (cards.normals * cards.points).sum(-1)[..., None, None] / facing
    amplitude, kx, ky, px, py, _ = (part[..., None, None] for part in cards.relief.unbind(-1))
    half = size_px / 2 / focal_px
    z = z * (1 + amplitude * torch.sin(kx * x / half + px) * torch.sin(ky * y / half + py))
    local = rays * z[..., None] - cards.points[:, :, None, None]
    across, down = ((local * axis[:, :, None, None]).sum(-1) for axis in (cards.across, cards.down))
    alpha = _coverage(cards, across, down, z / focal_px)
    alpha = torch.where((z > 0) & (z < _FARTHEST) & cards.exists[..., None, None], alpha, 0)
    place = torch.stack([across, down], -1) * cards.density[..., None, None, None]
    # Pictures per pixel, for the mean of the texels that a pixel of a slanted plane covers
    wide = cards.density[..., None, None] * z / focal_px / facing.abs().clamp_min(1e-3).sqrt()
    colours = _looked_up(
        pictures[cards.pieces.flatten()], (place + cards.place[:, :, None, None]).flatten(0, 1), wide.flatten(0, 1)
    ).unflatten(0, (count, CARDS))
    colours = colours.gather(2, cards.order[..., None, None].expand_as(colours))
    colours = cards.gain[..., None, None] * colours.clamp_min(1e-4).pow(cards.gamma[..., None, None, None])
    return colours.clamp(0, 1), alpha, torch.where(alpha > 0, z, torch.inf)


def _coverage(cards: Cards, across: Tensor, down: Tensor, footprint: Tensor) -> Tensor:
    """Return how much of each pixel the cards cover, [B,C,S,S]."""
    radius, length = cards.radius[..., None, None], cards.length[..., None, None]
    angle, distance = torch.atan2(down, across), torch.hypot(across, down)
    outline = torch.ones_like(angle)
    for number in range(_HARMONICS):
        amplitude, phase = (cards.outline[..., part, number, None, None] for part in (0, 1))
        outline = outline + amplitude * torch.cos((number + 1) * angle + phase)
    blob = radius * outline.clamp_min(0.15) - distance
    bar = torch.minimum(radius - down.abs(), length * radius - across.abs())
    inside = torch.where(length > 0, bar, blob)
    return torch.where(torch.isinf(radius), 1.0, (inside / footprint + 0.5).clamp(0, 1))


def _looked_up(pictures: Tensor, place: Tensor, wide: Tensor) -> Tensor:
    """Return colours [N,3,S,S] of places [N,S,S,2], in pictures, where a pixel is so wide [N,S,S]."""
    pictures, grid = pictures.float() / 255, (2 * place - 1).nan_to_num(0).clamp(-1e4, 1e4)
    level = (wide.nan_to_num(0).clamp_min(1e-6) * PIECE_PX).log2().clamp(0, 4)[:, None] / 2
    result = 0
    for number, factor in enumerate(_MIP_FACTORS):
        small = F.avg_pool2d(pictures, factor) if factor > 1 else pictures
        seen = F.grid_sample(small, grid, padding_mode="reflection", align_corners=False)
        result = result + (1 - (level - number).abs()).clamp_min(0) * seen
    return result


def _floats(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
