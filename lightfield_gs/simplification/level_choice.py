"""The level of detail of each chunk that a panel needs: the fewest Gaussians for a bound of the light field's error.

The coarsest level tells where the content of a chunk is. Its Gaussians in view count by their area; at each, a pixel
covers depth / focal length in the scene, and the file knows the squared error of each level with such pixels. A chunk
that no camera of the rig sees is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lightfield_gs import _core
from lightfield_gs.io.scenes.streamed_sog import Leaf
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

PSNR_DB = 45.0  # aimed at, as `simplify` does
_MARGIN_DB = 1.0  # so that views from in between the sides are no worse; chosen on a guitar, 480 to 3840 pixels wide
_CAMERAS = 9  # of a rig, whose frusta overlap
_BESIDE = 0.15  # fraction of the image beyond each edge from where Gaussians may reach into it
_HALVINGS = 60
_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(8, 3)


def choose_levels(
    leaves: Sequence[Leaf],
    coarsest: Gaussians,
    leaf_of: np.ndarray,
    panel: Panel,
    rigs: Sequence[Rig],
    most: int | None = None,
) -> list[int | None]:
    """Return the level of each leaf, None for those out of view.

    The predicted PSNR of the light field against the finest levels is at least PSNR_DB. It is no proof: chunks were
    measured from six sides, and their errors add up as if none hid another.

    Args:
        leaves: with bounds and errors.
        coarsest: Gaussians of their coarsest levels, on the CPU.
        leaf_of: [N], the leaf of each.
        panel: the panel.
        rigs: in the coordinates of the Gaussians; the levels are good enough for each.
        most: the most Gaussians; where they are too few for the PSNR, the error is the least that they allow.
    """
    means = coarsest.means.double().numpy()
    sizes = np.sort(coarsest.scales.double().numpy(), 1)
    areas = coarsest.opacities.double().numpy() * sizes[:, 1] * sizes[:, 2]
    shares = areas / np.maximum(np.bincount(leaf_of, areas, len(leaves)), 1e-300)[leaf_of]
    levels = max(max(leaf.parts) for leaf in leaves) + 1
    counts = np.array([[leaf.at(level)[2] for level in range(levels)] for leaf in leaves], np.float64)
    seen, errors = np.zeros(len(leaves), bool), np.zeros((len(leaves), levels))
    for rig in rigs:
        seen |= are_seen(leaves, panel, rig)
        errors = np.maximum(errors, _errors(leaves, means, leaf_of, shares, panel, rig, levels))
    counts, errors = counts[seen], errors[seen]
    rows = np.arange(len(counts))
    allowed = 10 ** (-(PSNR_DB + _MARGIN_DB) / 10) * panel.width_px * panel.height_px
    _, price = _bisected(lambda price: errors[rows, _by_price(counts, errors, price)].sum() <= allowed)
    found = _by_price(counts, errors, price)
    if most is not None and counts[rows, found].sum() > most:
        price, _ = _bisected(lambda price: counts[rows, _by_price(counts, errors, price)].sum() > most)
        found = _by_price(counts, errors, price)
    chosen = iter(found.tolist())
    return [next(chosen) if one else None for one in seen]


def are_seen(leaves: Sequence[Leaf], panel: Panel, rig: Rig) -> np.ndarray:
    """Return [L] bool: whether the box of a leaf reaches into the frustum of a camera of the rig."""
    bounds = np.stack([leaf.bound for leaf in leaves if leaf.bound is not None])
    corners = np.where(_CORNERS[None] == 1, bounds[:, 1:], bounds[:, :1])  # [L,8,3]
    x, y, z = np.moveaxis(corners @ rig.world_to_camera[:3, :3].T + rig.world_to_camera[:3, 3], -1, 0)
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    half = rig.half_width(panel)
    down = (fy * y + cy * z >= 0).any(1) & (fy * y + (cy - panel.height_px) * z <= 0).any(1)
    across = np.zeros_like(down)
    for offset in np.linspace(-half, half, _CAMERAS):
        left = fx * (x - offset) + (cx + fx * offset / rig.zero_depth) * z
        across |= (left >= 0).any(1) & (left - panel.width_px * z <= 0).any(1)
    return down & across & (z > _core.NEAR_DEPTH).any(1)


def _errors(
    leaves: Sequence[Leaf],
    means: np.ndarray,
    leaf_of: np.ndarray,
    shares: np.ndarray,
    panel: Panel,
    rig: Rig,
    levels: int,
) -> np.ndarray:
    """Return [L, levels], the squared error of each level of each leaf, summed over the pixels of a view."""
    x, y, z = (means @ rig.world_to_camera[:3, :3].T + rig.world_to_camera[:3, 3]).T
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    z = np.maximum(z, _core.NEAR_DEPTH)
    parallax = rig.half_width(panel) * fx * np.abs(1 / rig.zero_depth - 1 / z)
    u, v = fx * x / z + cx - panel.width_px / 2, fy * y / z + cy - panel.height_px / 2
    reach = 0.5 + _BESIDE
    inside = (np.abs(u) <= reach * panel.width_px + parallax) & (np.abs(v) <= reach * panel.height_px)
    z, leaf_of, shares = z[inside], leaf_of[inside], shares[inside]
    pixel = z / (fx * fy) ** 0.5
    sizes = np.stack([leaf.pixels for leaf in leaves if leaf.pixels is not None])
    tables = np.stack([_extended(leaf, levels) for leaf in leaves])
    steps = np.log(sizes[:, 1] / sizes[:, 0])[leaf_of]
    place = np.clip(np.log(pixel / sizes[leaf_of, 0]) / steps, 0, sizes.shape[1] - 1)
    first = np.minimum(place.astype(np.int64), sizes.shape[1] - 2)
    part = (place - first)[:, None]
    logs = np.log(np.maximum(tables, 1e-30))
    between = logs[leaf_of, :, first] * (1 - part) + logs[leaf_of, :, first + 1] * part
    each = shares[:, None] * np.exp(between) / pixel[:, None] ** 2
    return np.stack([np.bincount(leaf_of, column, len(leaves)) for column in each.T], 1)


def _extended(leaf: Leaf, levels: int) -> np.ndarray:
    """Return the errors [levels,S] of a leaf; where it lacks a level, those of the one that takes its place."""
    assert leaf.errors is not None
    own = sorted(leaf.parts)
    places = [min((one for one in own if one >= level), default=own[-1]) for level in range(levels)]
    return leaf.errors[places]


def _bisected(holds: Callable[[float], bool]) -> tuple[float, float]:
    """Return two near prices: it does not hold at the lower one, and does at the higher one, or at the ends."""
    low, high = -80.0, 80.0  # logarithms of Gaussians by squared error
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return low, high


def _by_price(counts: np.ndarray, errors: np.ndarray, price: float) -> np.ndarray:
    """Return the level [L] of each leaf that costs least, Gaussians and errors together."""
    costs = counts + np.exp(price) * errors
    return costs.shape[1] - 1 - costs[:, ::-1].argmin(1)  # of equal ones the coarsest
