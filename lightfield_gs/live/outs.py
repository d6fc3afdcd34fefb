"""What a live picture's ways out take."""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
from torch import Tensor

from lightfield_gs.base.device import finished_to_numpy
from lightfield_gs.live.sources import Frame


class Drawn:
    """A picture that was drawn.

    Args:
        image: uint8 [H, W, 3], finished, where it was drawn.
    """

    def __init__(self, image: Tensor):
        self.image = image

    @cached_property
    def pixels(self) -> np.ndarray:
        """The picture in the host's memory, copied once for all who ask."""
        return finished_to_numpy(self.image)


class Out(Protocol):
    """A way out."""

    def put(self, frame: Frame, drawn: Drawn) -> None:
        """Take the picture that was drawn of a frame. Raises InputError."""
