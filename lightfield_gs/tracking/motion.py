"""The motion of two eyes: their positions without noise, and where they will be a moment later."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

# Seconds over which positions are averaged: x, y, z of the middle between the eyes, then of half the way between them.
# Distances are noisy, since they come of the few pixels between the eyes; the way between two eyes hardly changes.
_SMOOTHING_S = np.array([0.02, 0.02, 0.1, 0.3, 0.3, 0.3])
_LONGEST_GAP_S = 0.5  # without a position, after which the motion begins anew
_FARTHEST_MM = 250.0  # from where the eyes should be, beyond which they are those of another face
_MOST_AHEAD_S = 0.2  # that is foretold: a head does not keep its speed for longer


@dataclass(frozen=True)
class EyeSample:
    """What a source of positions tells at a time.

    Attributes:
        taken: When, seconds of time.monotonic.
        eyes_mm: float64 [2, 3], the left and the right eye, mm from the panel's centre: x right, y up, z towards the
            viewer. None: no eyes were seen.
    """

    taken: float
    eyes_mm: np.ndarray | None


class EyeMotion:
    """A g-h filter for eyes that move at constant speed for a while, critically damped.

    Of each coordinate it keeps position x and speed v. A measure m after dt seconds changes them by the residual
    r = m - (x + v dt): x = x + v dt + g r, v = v + h r/dt, with g = 1 - w^2, h = (1 - w)^2, w = exp(-dt/smoothing).
    That is the least squares fit of a line to all measures, of which older ones count exponentially less. (Brookner,
    "Tracking and Kalman filtering made easy", 1998, section 1.2, the fading-memory filter.)
    """

    def __init__(self) -> None:
        self._state = np.zeros(6)
        self._speed = np.zeros(6)
        self._taken: float | None = None

    def update(self, taken: float, eyes_mm: np.ndarray) -> None:
        """Take a measure [2, 3] of the time `taken`; one that is older than the last is left out."""
        measure = np.concatenate([eyes_mm.mean(0), (eyes_mm[1] - eyes_mm[0]) / 2])
        step = math.inf if self._taken is None else taken - self._taken
        if step <= 0:
            return
        if step > _LONGEST_GAP_S or math.dist(measure[:3], self._state[:3]) > _FARTHEST_MM:
            self._state, self._speed, self._taken = measure, np.zeros(6), taken
            return
        fading = np.exp(-step / _SMOOTHING_S)
        foretold = self._state + self._speed * step
        residual = measure - foretold
        self._state = foretold + (1 - fading**2) * residual
        self._speed = self._speed + (1 - fading) ** 2 * residual / step
        self._taken = taken

    def at(self, when: float) -> np.ndarray:
        """Return the eyes [2, 3] at a time, after at least one measure; a while after the last one they stay."""
        assert self._taken is not None
        ahead = min(max(0.0, when - self._taken), _MOST_AHEAD_S)
        state = self._state + self._speed * ahead
        return np.stack([state[:3] - state[3:], state[:3] + state[3:]])
