"""Levels of detail: a scene in chunks, each with fewer and fewer Gaussians, and the error of every level.

A level is for all viewpoints at the distance where its Gaussians are about a pixel large. So merging is judged by
images from the sides of a chunk, with pixels of that size, and not by the rig of a panel: that rig sees one side, would
drop all that is hidden from it, and its pixels are too fine for whoever stands farther away.

The error of a level is measured, by images of the chunk alone with pixels of several sizes. Whoever draws the scene
knows the size of a pixel at the chunk, and finds the level that is good enough. In the scene, other chunks may hide
this one: then the error is smaller.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.assumptions import Loss, assume
from lightfield_gs.base.harmonics import rotations
from lightfield_gs.io.scenes.scene_arrays import Fields, header_losses
from lightfield_gs.io.scenes.streamed_sog import WrittenChunk, write
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.simplification.footprints import Sides
from lightfield_gs.simplification.merging import MergedScene
from lightfield_gs.simplification.pruning import summed_weights

CHUNK = 16384  # most Gaussians of a chunk's finest level
RATIO = 0.5  # of the Gaussians of a level, those of the next
_WIDEST_PX = 512  # of an image of a chunk
_STEP = 4.0  # between sizes of pixels
_SIZES = 5
_WHOLE = 0.5  # smallest pixel of images of a whole chunk, in typical standard deviations of the finest level
_WINDOW_PX = 384  # of images with finer pixels, which show parts of it
_SPREAD = 0.01  # fraction of a chunk's centres on each side that its images may leave out
# Turns from the axes of the scene to those of a camera: six sides
_SIDES = [
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
]


LEVELS = 6


def write_levels(
    gaussians: Gaussians,
    path: Path,
    levels: int = LEVELS,
    comments: Sequence[str] = (),
    antialiased: bool = False,
    progress: Callable[[int, int], None] = lambda done, chunks: None,
) -> list[int]:
    """Write a scene in levels of detail as streamed SOG, the whole folder or nothing.

    Args:
        gaussians: one scene, [N, ...], float32.
        path: FOLDER/lod-meta.json; the folder is absent or empty.
        levels: how many, 1 or more; each has RATIO of the Gaussians of the one before.
        comments: lines as in the header of a .ply.
        antialiased: for scenes trained with anti-aliasing, see `render`.
        progress: called with the number of chunks so far, and of all.

    Returns:
        The numbers of Gaussians by level.

    Raises:
        InputError: the folder is not empty, or it cannot be written.
    """
    for words in header_losses(path, gaussians.origin, ()):
        assume(f"{path}: {words}", Loss)
    tree = split(gaussians.means)
    rows = list(leaves_of(tree))
    chunks = (build_chunk(gaussians[own], levels, antialiased) for own in rows)
    return write(path, chunks, tree, comments, lambda done: progress(done, len(rows)))


def split(means: Tensor) -> list:
    """Split centres [N,3] at the median of their widest axis, until CHUNK are left; return nested pairs of rows."""

    def part(rows: Tensor) -> list:
        if len(rows) <= CHUNK:
            return [rows]
        own = means[rows]
        axis = int(own.std(0).argmax())
        order = own[:, axis].argsort(stable=True)
        return [part(rows[half]) for half in order.tensor_split(2)]

    return part(torch.arange(len(means), device=means.device))


def leaves_of(tree: list) -> Iterator[Tensor]:
    """Yield the rows of the leaves in order."""
    for branch in tree:
        if isinstance(branch, Tensor):
            yield branch
        else:
            yield from leaves_of(branch)


@torch.no_grad()
def build_chunk(gaussians: Gaussians, levels: int, antialiased: bool = False) -> WrittenChunk:
    """Return the levels of one chunk, float32, and their errors."""
    scene, found = gaussians, [gaussians]
    typical = _typical_size(gaussians)
    for number in range(1, levels):
        target = max(1, round(gaussians.count * RATIO**number))
        if target < scene.count:
            pixel = typical * RATIO ** (-number / 2)
            weights = _weights(scene, pixel, antialiased)
            merged = MergedScene(scene, weights, Sides.of(pixel, gaussians.device))
            merged.reduce(target)
            scene = merged.scene()
        found.append(scene)
    pixels, errors, energies = _measure(found, typical, antialiased)
    bounds = torch.stack([_bound(scene) for scene in found])
    bound = torch.stack([bounds[:, 0].amin(0), bounds[:, 1].amax(0)])
    return WrittenChunk([_arrays(scene) for scene in found], bound.cpu().double().numpy(), pixels, errors, energies)


def _arrays(gaussians: Gaussians) -> Fields:
    return {name: field.cpu().numpy() for name, field in gaussians.fields().items()}


def _typical_size(gaussians: Gaussians) -> float:
    """Return the median over Gaussians of the standard deviation of their largest side, scene units."""
    sizes = gaussians.scales.sort(-1).values
    return float((sizes[:, 1] * sizes[:, 2]).sqrt().median().clamp_min(1e-9))


def _bound(gaussians: Gaussians) -> Tensor:
    """Return [2,3], least and greatest coordinates of what is drawn of Gaussians."""
    axes = rotations(gaussians.quaternions) * gaussians.scales[:, None]
    reach = (2 * (255 * gaussians.opacities).clamp_min(1).log()).sqrt()[:, None] * axes.norm(dim=-1)
    return torch.stack([(gaussians.means - reach).amin(0), (gaussians.means + reach).amax(0)])


def whole_sides(gaussians: Gaussians, pixel: float) -> Cameras:
    """Return orthographic cameras that show the centres, but for outliers, from six sides."""
    low, high = (gaussians.means.quantile(one, 0) for one in (_SPREAD, 1 - _SPREAD))
    side = math.ceil(float((high - low).max()) / pixel) + 8
    return _side_cameras(gaussians, ((low + high) / 2).expand(len(_SIDES), 3), pixel, min(side, _WIDEST_PX))


def _side_cameras(gaussians: Gaussians, middles: Tensor, pixel: float, side_px: int) -> Cameras:
    """Return orthographic cameras from six sides, each with a point [6,3] in its middle, before all centres."""
    means = gaussians.means
    turns = torch.tensor(_SIDES, dtype=torch.float32, device=means.device)
    poses = torch.eye(4, device=means.device).repeat(len(turns), 1, 1)
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = -(turns @ middles[:, :, None])[..., 0]
    poses[:, 2, 3] = 1.0 - (means @ turns[:, 2].T).amin(0)
    focal = torch.full((len(turns), 2), 1 / pixel, device=means.device)
    centre = torch.full((len(turns), 2), side_px / 2, device=means.device)
    return Cameras(poses, focal, centre, side_px, side_px, model="orthographic")


def _weights(gaussians: Gaussians, pixel: float, antialiased: bool) -> Tensor:
    """Return [N], how much of each Gaussian shows from a side, averaged over the sides, pixels of an opaque image."""
    cameras = whole_sides(gaussians, pixel)
    summed = summed_weights(gaussians, lambda scene: render(scene, cameras, antialiased=antialiased).image)
    return summed / 3 / len(_SIDES)


def _measure(levels: list[Gaussians], typical: float, antialiased: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels, errors and energies of a WrittenChunk.

    With the finest pixels, parts of the chunk are drawn: they tell how the error grows from the next pixels on.
    """
    finest, count = levels[0], len(levels)
    extent = finest.means.quantile(1 - _SPREAD, 0) - finest.means.quantile(_SPREAD, 0)
    whole = max(_WHOLE * typical, float(extent.max()) / (_WIDEST_PX - 8))
    pixels = whole * _STEP ** np.arange(-1, _SIZES - 1)
    errors, energies = np.zeros((count, _SIZES)), np.zeros(count)
    for k, pixel in enumerate(pixels[1:].tolist(), 1):
        errors[:, k], own = _errors(levels, whole_sides(finest, pixel), antialiased)
        errors[:, k] *= pixel**2
        energies = own if k == 1 else energies
    picked = torch.randint(finest.count, (len(_SIDES),), generator=torch.Generator().manual_seed(0))
    middles = finest.means[picked.to(finest.device)]
    fine, coarse = (
        _errors(levels, _side_cameras(finest, middles, float(pixel), side), antialiased)[0] * pixel**2
        for pixel, side in ((pixels[0], _WINDOW_PX), (pixels[1], int(_WINDOW_PX / _STEP)))
    )
    growth = np.divide(fine, coarse, out=np.ones(count), where=coarse > 0)
    errors[:, 0] = errors[:, 1] * np.maximum(growth, 1.0)
    return pixels, np.maximum.accumulate(errors, 0), np.maximum.accumulate(energies)


def _errors(levels: list[Gaussians], cameras: Cameras, antialiased: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return [L], squared errors summed over the pixels of the worst side, and the energies by these images."""
    truth = _drawn(levels[0], cameras, antialiased)
    scale = truth.double().square().sum().clamp_min(1e-12)
    errors, energies = [0.0], [0.0]
    for scene in levels[1:]:
        difference = _drawn(scene, cameras, antialiased) - truth
        colour, alpha = difference[..., :3], difference[..., 3:]
        square = (colour.square() + (colour - alpha).square()).mean(-1) / 2
        errors.append(float(square.double().sum((1, 2)).amax()))
        energies.append(float(difference.double().square().sum() / scale))
    return np.array(errors), np.array(energies)


def _drawn(gaussians: Gaussians, cameras: Cameras, antialiased: bool) -> Tensor:
    """Return [C,H,W,4], colours times alpha, and alpha."""
    drawn = render(gaussians, cameras, background=(0.0, 0.0, 0.0), alpha=True, antialiased=antialiased)
    assert drawn.alpha is not None
    return torch.cat([drawn.image, drawn.alpha.reshape(*drawn.image.shape[:3], 1)], -1)
