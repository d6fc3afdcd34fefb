"""Which objects and views a training step sees: views constrained to a cone about the source view.

Everything here is a function of (seed, step): a resumed run draws what the uninterrupted one would have drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lightfield_gs.base.errors import InputError


@dataclass(frozen=True)
class Choice:
    """One training example: object number, source view and target views.

    Views are numbered within the object; targets within the views that its targets are drawn from, where those are
    others.
    """

    object_index: int
    source: int
    targets: tuple[int, ...]


def angles_from_source(camera_to_world: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Return azimuth and elevation [V,2] in degrees of each viewing direction, in the axes of the source camera.

    Azimuth is positive to the right, elevation positive downwards.

    Args:
        camera_to_world: [V,4,4], OpenCV axes.
        source: [4,4], likewise.
    """
    directions = camera_to_world[:, :3, 2] @ source[:3, :3]
    azimuth = np.arctan2(directions[:, 0], directions[:, 2])
    elevation = np.arcsin(np.clip(directions[:, 1], -1, 1))
    return np.degrees(np.stack([azimuth, elevation], axis=-1))


def views_in_cone(
    camera_to_world: np.ndarray, source: np.ndarray, azimuth_deg: float, elevation_deg: float
) -> np.ndarray:
    """Numbers of the views, other than from the source's own place, within +-azimuth_deg and +-elevation_deg of it."""
    angles = np.abs(angles_from_source(camera_to_world, source))
    elsewhere = np.abs(camera_to_world - source).max((1, 2)) > 1e-6
    return np.flatnonzero((angles[:, 0] <= azimuth_deg) & (angles[:, 1] <= elevation_deg) & elsewhere)


def has_neighbour(camera_to_world: np.ndarray, angle_deg: float) -> np.ndarray:
    """Whether another view looks within angle_deg of each view's direction, bool [V]."""
    directions = camera_to_world[:, :3, 2]
    cosines = directions @ directions.T
    np.fill_diagonal(cosines, -np.inf)
    return cosines.max(1) >= np.cos(np.radians(angle_deg)) - 1e-9


class ViewSampler:
    """Draws objects without replacement epoch by epoch, any view as source, targets inside the cone about it.

    Objects and sources come from one stream of random numbers, targets from another. Runs that differ in targets alone
    draw the same sources, if every view with a neighbour also has a target.

    Args:
        poses: camera_to_world [V,4,4] of each object.
        azimuth_deg, elevation_deg: half widths of the cone; 180 and 90 take every view (the full sphere).
        neighbour_deg: only views with another view within this angle are sources.
        target_poses: of the views that are targets, in the same world; None: the object's own.

    Raises:
        InputError: an object has no source with a target.
    """

    def __init__(
        self,
        poses: list[np.ndarray],
        azimuth_deg: float,
        elevation_deg: float,
        targets: int,
        seed: int,
        neighbour_deg: float = 180.0,
        target_poses: list[np.ndarray] | None = None,
    ) -> None:
        self.targets, self.seed, self.cone_deg = targets, seed, (azimuth_deg, elevation_deg)
        self._epoch = lru_cache(maxsize=2)(self._shuffled)
        self.candidates = []  # of each object: its sources, each with the views that may be targets
        for index, (views, pool) in enumerate(zip(poses, target_poses or poses)):
            near = [
                (int(source), found.tolist())
                for source in np.flatnonzero(has_neighbour(views, neighbour_deg))
                if len(found := views_in_cone(pool, views[source], azimuth_deg, elevation_deg))
            ]
            if not near:
                cone = f"+-{azimuth_deg:g} degrees of azimuth and +-{elevation_deg:g} of elevation"
                raise InputError(
                    f"object number {index}: none of its {len(views)} views has a target within {cone} "
                    f"and a neighbour within {neighbour_deg:g} degrees: widen the cone"
                )
            self.candidates.append(near)

    def rng(self, step: int, stream: int = 0) -> np.random.Generator:
        """The random numbers of a step; further streams serve further purposes (augmentation, backgrounds)."""
        return np.random.default_rng((self.seed, step, stream))

    def draw(self, step: int, start: int, count: int, wanted: np.ndarray | None = None) -> list[Choice]:
        """Return the `count` examples of a step, or those with numbers `wanted`; each is the same whatever is wanted.

        Args:
            start: Number of examples drawn by all steps before it.
        """
        numbers = np.arange(count) if wanted is None else wanted
        sources, targets = self.rng(step).random(count), self.rng(step, 2).random((count, self.targets))
        return [
            self._choose(self._object(start + number), source, picks)
            for number, source, picks in zip(numbers.tolist(), sources[numbers].tolist(), targets[numbers].tolist())
        ]

    def _object(self, position: int) -> int:
        """The object at a place of the endless sequence of shuffled epochs."""
        epoch, place = divmod(position, len(self.candidates))
        return int(self._epoch(epoch)[place])

    def _shuffled(self, epoch: int) -> np.ndarray:
        return np.random.default_rng((self.seed, epoch, 1 << 20)).permutation(len(self.candidates))

    def _choose(self, index: int, source_pick: float, target_picks: list[float]) -> Choice:
        """Choose a source view and its targets by numbers in [0, 1); targets repeat only when the cone holds too few.

        It uses plain lists: for a few numbers numpy would hold the interpreter, which threads share, ten times as long.
        """
        near = self.candidates[index]
        source, pool = near[int(source_pick * len(near))]
        if len(pool) < self.targets:
            return Choice(index, source, tuple(pool[int(pick * len(pool))] for pick in target_picks))
        pool = list(pool)
        return Choice(index, source, tuple(pool.pop(int(pick * len(pool))) for pick in target_picks))
