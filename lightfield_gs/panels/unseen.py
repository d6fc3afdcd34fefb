"""What the centre camera of a rig sees, and where the outermost views look past what the scene knows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, reduced
from lightfield_gs.panels.visibility import check_single, plain
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.gaussians import Gaussians

_SIZE_PX = 256  # width of the pictures that are compared
_OPAQUE = 0.5  # alpha from which on a pixel shows a surface; half the largest where none is so opaque
_DEPTH_TAIL = 0.01  # share of the pixels that is left out at either end of the depths
_HOLES = 0.01  # share of the centre view that may be background where a scene fills it
_MUCH_UNSEEN = 0.02  # share of an outermost view that nobody overlooks


@dataclass(frozen=True)
class Seen:
    """near, far: view-space z, scene units, that 1 % of the surfaces in the centre view are nearer and farther than.
    unseen: for views 0 and N-1, how much of where the scene goes on they show as background, 0..1.
    """

    near: float
    far: float
    unseen: tuple[float, float]


def look_at(gaussians: Gaussians, panel: Panel, rig: Rig) -> Seen:
    """What is seen by the cameras of the rig, of pictures 256 pixels wide. gaussians: in the rig's coordinates.

    Neighbouring pixels of a row whose surfaces the centre view sees, and which stand apart in an outermost view, have
    surface between them: the scene goes on there, as it does beyond the edge of the picture behind a pixel at the edge.
    What is transparent there is what was never seen, of a photo for example.
    Raises InputError where nothing is seen.
    """
    check_single(gaussians)
    small_rig = reduced(panel, rig, _SIZE_PX)[1]
    outermost = [0.5, panel.views - 0.5]
    alpha, depth = _pictures(gaussians, panel, rig, [panel.views / 2, *outermost])
    opaque = min(_OPAQUE, float(alpha[0].max()) / 2)
    surface = (alpha[0] >= opaque) & (depth > 0)
    if not surface.any():
        raise InputError(
            "the centre camera sees nothing of the scene; look at the pose of the rig, the zoom and the pan"
        )
    near, far = np.quantile(depth[surface], [_DEPTH_TAIL, 1 - _DEPTH_TAIL])
    shares = []
    for x, seen in zip(outermost, alpha[1:]):
        factor = small_rig.focal_px[0] * float(small_rig.offset(x, panel))
        moves = factor * (1 / rig.zero_depth - 1 / np.where(surface, depth, 1))
        goes_on = _between(surface, moves)
        shares.append(float((goes_on & (seen < opaque)).sum() / max(1, goes_on.sum())))
    return Seen(float(near), float(far), (shares[0], shares[1]))


def share_past(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """How much of an outermost view is background, 0..1, the larger share of the two, where the scene fills the centre
    view. None where it does not: what is background in a view of an object alone may well be air.

    One picture 256 pixels wide tells the latter, three the former. gaussians: in the rig's coordinates.
    """
    check_single(gaussians)
    centre, _ = _pictures(gaussians, panel, rig, [panel.views / 2])
    if (centre < _OPAQUE).mean() > _HOLES:
        return None
    outermost, _ = _pictures(gaussians, panel, rig, [0.5, panel.views - 0.5])
    return float((outermost < _OPAQUE).mean((1, 2)).max())


def words_on_past(share: float) -> str | None:
    """What to change where that much of an outermost view is background; None where nobody would see it."""
    if share <= _MUCH_UNSEEN:
        return None
    return (
        f"the outermost views look past what the scene knows: {share:.1%} of the scene's place is background there; "
        "give a smaller --cone or --depth-amount, or a larger --zoom"
    )


def _pictures(gaussians: Gaussians, panel: Panel, rig: Rig, places: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Alpha [n, H, W] of small pictures at these view coordinates, and depth [H, W] of the first one."""
    small_panel, small_rig = reduced(panel, rig, _SIZE_PX)
    with torch.no_grad():
        _, alphas, depths = render(
            plain(gaussians.detach()), small_rig.cameras_at(small_panel, places), alpha=True, depth=True
        )
    return alphas.double().cpu().numpy(), depths[0].double().cpu().numpy()


def _between(surface: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Which pixels lie between two neighbours of a row that both show surfaces, bool [H, W], after each has moved.

    surface: bool [H, W]; moves: by how many pixels each goes to the right, [H, W].
    """
    height, width = surface.shape
    places = np.clip(np.arange(width) + 0.5 + moves, 0, width)
    # Beyond the edges of the picture the scene goes on as far as anyone looks
    places = np.pad(places, ((0, 0), (1, 1)), constant_values=((0, 0), (0, width)))
    there = np.pad(surface, ((0, 0), (1, 1)), mode="edge")
    rows, columns = np.nonzero(there[:, :-1] & there[:, 1:])
    ends = np.sort(np.stack([places[rows, columns], places[rows, columns + 1]]), 0)
    first, beyond = np.ceil(ends[0] - 0.5).astype(int), np.floor(ends[1] - 0.5).astype(int) + 1
    changes = np.zeros((height, width + 1), int)
    np.add.at(changes, (rows, first), 1)
    np.add.at(changes, (rows, np.maximum(first, beyond)), -1)
    return changes.cumsum(1)[:, :-1] > 0
