"""Steps of parallax along a film: tracked points move against each other, or the picture moves on as a whole."""

from __future__ import annotations

from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError

# Of the longer side. All are chosen by hand, and small: steps are joined where a film has too many
_PARALLAX = 0.0015  # between points of different depth
_SHIFT = 0.03  # of all points, as where the camera turns or a wall goes by
_QUANTILE = 0.8  # of the points whose parallax counts: fewer may be tracked wrongly
_POINTS, _QUALITY, _APART_PX = 400, 0.01, 8  # see OpenCV's goodFeaturesToTrack
_FEWEST = 12  # tracked points; fewer begin a step
_KEPT = 0.5  # fraction of a step's points that are still tracked; fewer begin a step


class ParallaxSteps:
    """Divides the frames of a film into steps of equal parallax.

    Points are tracked from the first frame of a step on (Lucas and Kanade, "An iterative image registration
    technique", 1981, in pyramids). Parallax is the rest of their motion after the best shift, turn and zoom of the
    picture, which a camera that turns on the spot makes too.
    """

    def __init__(self) -> None:
        self._cv = _cv_library()
        self._before: np.ndarray | None = None
        self._first = self._points = np.zeros((0, 1, 2), np.float32)
        self._begun = 0

    def begins(self, grey: np.ndarray) -> bool:
        """Return whether the next frame, grey uint8 [H,W], begins a step. The first one does."""
        begins = self._before is None or not self._is_same_step(self._before, grey)
        if begins:
            found = self._cv.goodFeaturesToTrack(grey, _POINTS, _QUALITY, _APART_PX)
            self._first = self._points = np.zeros((0, 1, 2), np.float32) if found is None else found
            self._begun = len(self._first)
        self._before = grey
        return begins

    def _is_same_step(self, before: np.ndarray, grey: np.ndarray) -> bool:
        """Track the points into a frame, and return whether it is of the same step."""
        if not self._begun:  # as a lens cap
            return self._cv.goodFeaturesToTrack(grey, _POINTS, _QUALITY, _APART_PX) is None
        points, tracked, _ = self._cv.calcOpticalFlowPyrLK(before, grey, self._points, None)
        kept = tracked.ravel() == 1
        self._first, self._points = self._first[kept], points[kept]
        if len(self._points) < max(_FEWEST, _KEPT * self._begun):
            return False
        model, _ = self._cv.estimateAffinePartial2D(self._first, self._points, method=self._cv.LMEDS)
        if model is None:
            return False
        first, now = self._first[:, 0], self._points[:, 0]
        rest = np.linalg.norm(now - (first @ model[:, :2].T + model[:, 2]), axis=1)
        shift = np.linalg.norm(now - first, axis=1)
        longer = max(grey.shape)
        return bool(np.quantile(rest, _QUANTILE) < _PARALLAX * longer and np.median(shift) < _SHIFT * longer)


def _cv_library() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise InputError(
            f"frames of films are chosen by OpenCV, which cannot be imported ({error}): pip install "
            "'lightfield-gs[sfm,video]'"
        ) from None
    return cv2
