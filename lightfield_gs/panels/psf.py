"""How brightly an eye sees the sub-pixels beside the one that is meant for it: a lens's measured spread of light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import is_row, real_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.text_files import read_text

_MOST_BYTES, _MOST_POINTS = 1 << 20, 4096
_MOST_SUBPIXELS, _MOST_LIGHT = 1e4, 1e12


@dataclass(frozen=True)
class Psf:
    """A measured spread of light, its crosstalk included.

    offsets: 2..4096 places in sub-pixels along a row, ascending: how far another sub-pixel lies to the right of the one
    that, seen by the eye, is exactly behind the lens. light: how brightly the eye sees it, >= 0, in any unit; between
    the offsets it is interpolated linearly, and there is none beyond them. Raises InputError.
    """

    offsets: tuple[float, ...]
    light: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, limits in (("offsets", (-_MOST_SUBPIXELS, _MOST_SUBPIXELS)), ("light", (0.0, _MOST_LIGHT))):
            values = getattr(self, name)
            if not is_row(values) or not 2 <= len(values) <= _MOST_POINTS:
                raise InputError(f"psf: {name} must be 2..{_MOST_POINTS} numbers")
            object.__setattr__(self, name, tuple(real_number(f"psf: {name}", value, *limits) for value in values))
        if len(self.offsets) != len(self.light):
            raise InputError(f"psf: expected a light for each of {len(self.offsets)} offsets, got {len(self.light)}")
        if any(after <= before for before, after in zip(self.offsets, self.offsets[1:])):
            raise InputError("psf: offsets must ascend")
        if not max(self.light) > 0:
            raise InputError("psf: all light is 0, so that nothing would be seen")

    @staticmethod
    def load(path: str | Path) -> Psf:
        """From a text file with an offset and its light in each line, a comma or blanks between them; lines that begin
        with # are comments. Raises InputError."""
        lines = read_text(path, _MOST_BYTES, "text of a spread of light").splitlines()
        rows = [(number, line.strip()) for number, line in enumerate(lines, 1)]
        with named(path):
            pairs = [_pair(number, line) for number, line in rows if line and not line.startswith("#")]
            return Psf(tuple(offset for offset, _ in pairs), tuple(light for _, light in pairs))

    def seen(self, offsets: np.ndarray, lens: float) -> np.ndarray:
        """Light of sub-pixels at these offsets from the middle of their lenses, float32; lens: its width in sub-pixels.

        Sub-pixels of other lenses that the table reaches send their light through this one, and seen by the eye they
        lie at the same place of their own lens: their light is added. Divided by the largest light, so that a table
        of any unit serves.
        """
        total = np.zeros(offsets.shape)
        low = math.ceil((self.offsets[0] - lens / 2) / lens)
        high = math.floor((self.offsets[-1] + lens / 2) / lens)
        for other in range(low, high + 1):
            total += np.interp(offsets + other * lens, self.offsets, self.light, left=0.0, right=0.0)
        return (total / max(self.light)).astype(np.float32)


def _pair(number: int, line: str) -> tuple[float, float]:
    """The two numbers of a line."""
    words: Sequence[str] = line.replace(",", " ").replace(";", " ").split()
    try:
        offset, light = (float(word) for word in words)
    except ValueError:
        raise InputError(f"line {number}: expected an offset in sub-pixels and its light, got {line[:40]!r}") from None
    return offset, light
