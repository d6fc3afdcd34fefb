"""Uniform random numbers of many objects, taken one after the other."""

from __future__ import annotations

import numpy as np


class Numbers:
    """Uniform numbers in [0, 1), a row per object, taken one after the other."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows, self.count, self._taken = rows, len(rows), 0

    def __call__(self, *shape: int) -> np.ndarray:
        """[B, *shape]."""
        start, self._taken = self._taken, self._taken + int(np.prod(shape))
        return self.rows[:, start : self._taken].reshape(self.count, *shape)

    def between(self, low: float, high: float, *shape: int) -> np.ndarray:
        return low + (high - low) * self(*shape)

    def chosen(self, values: list[float], weights: list[float], *shape: int) -> np.ndarray:
        """Some of the values, as often as their weights (which sum to 1) say."""
        return np.asarray(values)[np.searchsorted(np.cumsum(weights)[:-1], self(*shape), side="right")]
