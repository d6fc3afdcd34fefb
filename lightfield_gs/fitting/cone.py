"""Where the cone of a panel lies in a capture, and how much each photograph counts in it.

A panel shows a scene from places on a line, at most half its cone to either side of a centre camera. Only what these
places see has to be right. Angles here are those between the places of cameras, as they are seen from the pivot: the
point of the centre camera's axis that the panel's own plane goes through.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.angles import Angles
from lightfield_gs.io.captures.capture import Capture

# Photographs within half the cone and this count fully: what is before and behind the zero plane is seen at other
# angles than the pivot is, and views at the cone's edge are between photographs too.
MARGIN_DEG = 5.0
# From there the weight falls as a cosine does, over this angle, to a floor: what stands far outside still says where
# things are, though not how they look from the panel.
FALL_DEG, FLOOR = 20.0, 0.05
_LEAST_SPREAD_DEG = 3.0  # of axes, below which the place where they meet says little
_IN_FRONT = 0.9  # of the cameras must have that place before them
_FEWEST = 3  # cameras, and of points ten times as many, to learn a depth from


@dataclass(frozen=True)
class Cone:
    """name and centre: of the centre photograph, and its index. pivot: [3] float64, coordinates of the capture, on the
    axis of the centre camera, `zero_depth` before it, scene units. cone_deg: full angle. angles_deg: [C] float64,
    0..180, of every photograph from the centre one, seen from the pivot. messages: what was chosen, one line each.
    """

    name: str
    centre: int
    pivot: np.ndarray
    zero_depth: float
    cone_deg: float
    angles_deg: np.ndarray
    messages: tuple[str, ...]

    @property
    def inside(self) -> np.ndarray:
        """[C] bool: which photographs are within half the cone of the centre."""
        return self.angles_deg <= self.cone_deg / 2

    def angles(self, indices: Sequence[int]) -> Angles:
        """Of photographs at these indices of the capture, to score them by; says so where few of them are inside."""
        if (inside := int(self.inside[list(indices)].sum())) < _FEWEST:
            assume(
                f"cone: {inside} of {len(indices)} held-out photographs are inside, whose mean says little; hold out "
                "more of them (--test-every 3, or --test-list)"
            )
        return Angles(self.name, self.cone_deg, self.angles_deg[list(indices)].tolist())

    def weights(self) -> np.ndarray:
        """[C] float64, FLOOR..1: how much each photograph counts."""
        return weights_at(self.angles_deg, self.cone_deg)


def weights_at(angles_deg: np.ndarray, cone_deg: float) -> np.ndarray:
    """Weights FLOOR..1 at angles from the centre: 1 within half the cone and MARGIN_DEG, then half a period of a cosine
    down to FLOOR, FALL_DEG farther out."""
    beyond = np.clip((angles_deg - cone_deg / 2 - MARGIN_DEG) / FALL_DEG, 0, 1)
    return FLOOR + (1 - FLOOR) * (1 + np.cos(np.pi * beyond)) / 2


def place_cone(capture: Capture, cone_deg: float, centre: str | None = None) -> Cone:
    """The cone of this full angle, 1..179 degrees, round a photograph of a capture.

    centre: its name. None: the photograph with the most others within half the cone and MARGIN_DEG, seen from where the
    capture's axes meet; among such the one that these are nearest to (the least mean square of angles).
    The pivot is on the centre camera's axis, at the median depth of the points in the middle third, each way, of its
    photograph: a panel is sharpest there, and the surface of the subject should be. Where such points are few: at the
    depth of the point with the least squared distance to the axes of the cameras within that angle, which lies within
    the subject of a capture from around it. Raises InputError for unknown names, and where neither is known.
    """
    cone_deg = real_number("cone", cone_deg, 1.0, 179.0)
    half = cone_deg / 2 + MARGIN_DEG
    chosen_by = "given"
    middle = _middle_of(capture)
    if centre is None:
        index, others = _most_central(_directions(capture.centres, middle), half)
        chosen_by = f"it has the most others within {half:g} degrees, {others}, seen from the middle of the capture"
    else:
        index = capture.index_of(centre, "centre photograph")
    near = np.flatnonzero(_angles(_directions(capture.centres, middle), index) <= half)
    depth, how = _zero_depth(capture, index, near, middle)
    axis = capture.world_to_camera[index, 2, :3]
    pivot = capture.centres[index] + depth * axis
    angles = _angles(_directions(capture.centres, pivot), index)
    count, full, inside = len(angles), int((angles <= half).sum()), int((angles <= cone_deg / 2).sum())
    messages = (
        f"cone: {cone_deg:g} degrees round {capture.names[index]} ({chosen_by})",
        f"cone: {counted(inside, 'photograph', count, 'are inside')}; {full} within {half:g} degrees of the centre "
        f"count fully, the others less, down to {FLOOR:g}",
        f"cone: zero plane {depth:.4g} scene units before the centre camera, {how}",
    )
    return Cone(capture.names[index], index, pivot, depth, cone_deg, angles, messages)


def meeting_point(centres: np.ndarray, axes: np.ndarray) -> np.ndarray | None:
    """[3]: the point of least squared distance to lines through centres [C,3] along axes [C,3], of length 1.

    None where the lines are fewer than three or too parallel to tell, or where it is not before nine of ten cameras.
    """
    if len(centres) < _FEWEST:
        return None
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    mean = across.mean(0)
    if np.linalg.eigvalsh(mean)[0] < math.sin(math.radians(_LEAST_SPREAD_DEG)) ** 2:
        return None
    point = np.linalg.solve(mean, (across @ centres[..., None]).mean(0)[:, 0])
    return point if (((point - centres) * axes).sum(1) > 0).mean() >= _IN_FRONT else None


def depth_in_the_middle(capture: Capture, index: int) -> float | None:
    """The median depth of the capture's points in the middle third, each way, of a photograph; None where they are few.

    Which points the photograph really shows is not known: some may be hidden.
    """
    pose, (fx, fy, cx, cy) = capture.world_to_camera[index], capture.intrinsics[index]
    x, y, z = (capture.points @ pose[:3, :3].T + pose[:3, 3]).T
    width, height = capture.sizes_px[index]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = fx * x / z + cx - width / 2, fy * y / z + cy - height / 2
    middle = (z > 0) & (abs(u) < width / 6) & (abs(v) < height / 6)
    return float(np.median(z[middle])) if middle.sum() >= 10 * _FEWEST else None


def _middle_of(capture: Capture) -> np.ndarray:
    """[3]: what the whole capture is about: where axes meet, or what the camera in the middle of all looks at."""
    centres, axes = capture.centres, capture.world_to_camera[:, 2, :3]
    if (point := meeting_point(centres, axes)) is not None:
        return point
    index = int(np.linalg.norm(centres - np.median(centres, 0), axis=1).argmin())
    if (depth := depth_in_the_middle(capture, index)) is None:
        raise InputError(
            f"cone: expected photographs of one thing, or points in the middle of {capture.names[index]}: the axes of "
            f"{len(centres)} cameras meet nowhere before them, and there are no such points, so that nothing says at "
            "which depth the panel's plane is"
        )
    return centres[index] + depth * axes[index]


def _zero_depth(capture: Capture, index: int, near: np.ndarray, middle: np.ndarray) -> tuple[float, str]:
    """The depth of the pivot before the centre camera, > 0, and what it is from; near: cameras in the cone."""
    centres, axes = capture.centres, capture.world_to_camera[:, 2, :3]
    centre, axis = centres[index], axes[index]
    if (found := depth_in_the_middle(capture, index)) is not None:
        return found, "at the median depth of the points in the middle of the centre photograph"
    point = meeting_point(centres[near], axes[near])
    if point is not None and (depth := float((point - centre) @ axis)) > 0:
        return depth, f"where the axes of {len(near)} photographs in the cone meet"
    if (depth := float((middle - centre) @ axis)) > 0:
        return depth, "where the axes of the capture meet"
    raise InputError(
        f"cone: {capture.names[index]} looks away from what the other photographs show, and there are no points in its "
        "middle, so that nothing says at which depth the panel's plane is; give another --centre"
    )


def _directions(centres: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """[C,3] of length 1: from the pivot to the cameras."""
    away = centres - pivot
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)


def _angles(directions: np.ndarray, index: int) -> np.ndarray:
    """[C] degrees: of directions from that of `index`; exact near 0 too, where an arc cosine is not."""
    cosines = directions @ directions[index]
    sines = np.linalg.norm(np.cross(directions, directions[index]), axis=1)
    return np.degrees(np.arctan2(sines, cosines))


def _most_central(directions: np.ndarray, half_deg: float) -> tuple[int, int]:
    """The photograph with the most others within this angle, and how many; see place_cone."""
    counts, spreads = [], []
    for index in range(len(directions)):
        angles = _angles(directions, index)
        inside = angles <= half_deg
        counts.append(int(inside.sum()) - 1)
        spreads.append(float(np.square(angles[inside]).mean().round(9)))
    best = min(range(len(counts)), key=lambda index: (-counts[index], spreads[index]))
    return best, counts[best]
