"""Scores of held-out photographs by their angle from the centre of a cone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.evaluate import Scores

# Degrees at which the angles are parted: fine where panels are, coarse beyond
EDGES_DEG = (0, 5, 10, 15, 20, 25, 30, 45, 90, 180)


@dataclass(frozen=True)
class Angles:
    """Of held-out photographs: angles_deg [T], 0..180, from the photograph `centre`, as they are seen from the pivot of
    a cone of this full angle."""

    centre: str
    cone_deg: float
    angles_deg: list[float]

    def to_dict(self, scores: Scores) -> dict[str, Any]:
        """For JSON: scores by angle, and the angle of each photograph."""
        angles = {name: round(angle, 3) for name, angle in zip(scores.names, self.angles_deg)}
        return {"centre": self.centre, "cone_deg": self.cone_deg, "rows": self.rows(scores), "angles_deg": angles}

    def rows(self, scores: Scores) -> list[dict[str, float | str]]:
        """See by_angle."""
        return by_angle(self.angles_deg, scores.psnr_db, scores.ssim, self.cone_deg)

    def table(self, scores: Scores) -> str:
        """A row for each part of the angles that has photographs."""
        head = f"{'views':<16} {'photographs':>11} {'PSNR dB':>8} {'SSIM':>7}"
        rows = (
            f"{row['views']:<16} {row['photographs']:>11} {row['psnr_db']:>8.2f} {row['ssim']:>7.4f}"
            for row in self.rows(scores)
        )
        return "\n".join([head, *rows])


def by_angle(
    angles_deg: Sequence[float] | np.ndarray,
    psnr_db: Sequence[float] | np.ndarray,
    ssim: Sequence[float] | np.ndarray,
    cone_deg: float,
) -> list[dict[str, float | str]]:
    """Means of scores [T] of photographs at these angles 0..180 [T] from the centre of a cone of this full angle.

    Rows of views, photographs, psnr_db and ssim, for JSON: "inside the cone" (up to half of it), "outside", and every
    part from EDGES_DEG[i] up to the next, "5-10 degrees"; a row without photographs is left out. Means of decibels are
    not decibels of means. Raises InputError for rows of other lengths.
    """
    angles, psnr, similar = (np.asarray(values, np.float64) for values in (angles_deg, psnr_db, ssim))
    if not angles.shape == psnr.shape == similar.shape or angles.ndim != 1:
        raise InputError(f"expected scores of {angles.shape} photographs, got {psnr.shape} and {similar.shape}")
    inside = angles <= cone_deg / 2
    parts = [("inside the cone", inside), ("outside", ~inside)]
    for low, high in zip(EDGES_DEG, EDGES_DEG[1:]):
        last = high == EDGES_DEG[-1]
        parts.append((f"{low}-{high} degrees", (angles >= low) & ((angles < high) | last)))
    return [
        {
            "views": name,
            "photographs": int(chosen.sum()),
            "psnr_db": float(psnr[chosen].mean()),
            "ssim": float(similar[chosen].mean()),
        }
        for name, chosen in parts
        if chosen.any()
    ]
