"""The memory that a fit needs, by its uses.

With N Gaussians of K harmonics, V photographs of H x W pixels in a step, and C photographs in all, in bytes:

    photographs    C H W (3 + masks): colours; a mask where there are any, and one more where it is the target of alpha
    read ahead     (8 + V) H W (3 + masks), where photographs are not on the device
    parameters     4 N (15 + 3 K): values, and the scales and opacities that are drawn; twice while the density changes
    moments        8 N (11 + 3 K), the two of Adam; twice while the density changes
    gradients      4 N (11 + 3 K)
    work           V (450 N + 90 H W)

The factors of work are from a step on one H100. Projecting, sorting and drawing 1 M Gaussians at 1600 x 1066 took
471 MB. For each pixel there are the images, their gradients and the derivatives of the loss.
"""

from __future__ import annotations

from typing import NamedTuple

from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.fitting.photo_storage import AHEAD
from lightfield_gs.fitting.settings import FitSettings

_SHRINK = 0.8  # factor from one size of photographs to the next smaller one
_NUMBER_BYTES, _RAW_NUMBERS, _DRAWN_NUMBERS = 4, 11, 4  # of a Gaussian, but for its harmonics; see above
_MOMENTS, _COPIES = 2, 2
_WORK_PER_GAUSSIAN, _WORK_PER_PIXEL = 450, 90


class MemoryEstimate(NamedTuple):
    """Bytes by their use."""

    photographs: int
    read_ahead: int
    parameters: int
    moments: int
    gradients: int
    work: int

    def words(self) -> str:
        """Return the uses in words, but for photographs that are read ahead."""
        return (
            f"photographs {to_words(self.photographs)}, Gaussians {to_words(self.parameters)}, Adam's moments "
            f"{to_words(self.moments)}, gradients {to_words(self.gradients)}, work {to_words(self.work)}"
        )


def estimate_memory(
    settings: FitSettings, photographs: int, width_px: int, height_px: int, is_masked: bool
) -> MemoryEstimate:
    """Return the memory of a fit with settings.cap_max Gaussians.

    Args:
        settings: of the fit.
        photographs: their number, fitted and held out.
        width_px: of each.
        height_px: of each.
        is_masked: whether some have masks.
    """
    pixels = width_px * height_px
    photo = pixels * (3 + is_masked * (2 if settings.masks == "alpha" else 1))
    raw = _NUMBER_BYTES * settings.cap_max * (_RAW_NUMBERS + 3 * SH_COEFFICIENTS[settings.sh_degree])
    drawn = _NUMBER_BYTES * settings.cap_max * _DRAWN_NUMBERS
    return MemoryEstimate(
        photographs=photographs * photo,
        read_ahead=(AHEAD + settings.batch_size) * photo,
        parameters=_COPIES * (raw + drawn),
        moments=_COPIES * _MOMENTS * raw,
        gradients=raw,
        work=settings.batch_size * (_WORK_PER_GAUSSIAN * settings.cap_max + _WORK_PER_PIXEL * pixels),
    )


def smaller_sizes(longest_px: int, least_px: int) -> list[int]:
    """Return the sizes that photographs are reduced to, pixels of the longer side, the largest first."""
    sizes = [longest_px]
    while (size := round(_SHRINK * sizes[-1])) >= least_px:
        sizes.append(size)
    return sizes[1:]


def to_words(count: int) -> str:
    """Return a number of bytes in words, as 1.5 GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
