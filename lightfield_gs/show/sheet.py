"""Pictures of one size side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def in_rows(pictures: Sequence[np.ndarray], columns: int = 4) -> np.ndarray:
    """One or more pictures [h, w, 3] in rows of `columns`, from the left and from the top; what is left of the last row
    is black. A single picture stays as it is."""
    columns = min(columns, len(pictures))
    missing = -len(pictures) % columns
    every = [*pictures, *[np.zeros_like(pictures[0])] * missing]
    return np.concatenate([np.concatenate(every[i : i + columns], 1) for i in range(0, len(every), columns)])
