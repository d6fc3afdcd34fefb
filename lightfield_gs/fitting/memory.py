"""The memory that a fit needs, by its uses.

With N Gaussians of K harmonics, V photographs of H x W pixels in a step, and C photographs in all, in bytes:

    photographs    C H W (3 + masks): colours; a mask where there are any, and one more where it is the target of alpha
    read ahead     (8 + V) H W (3 + masks), where photographs are not on the device
    parameters     4 N (15 + 3 K): values, and the scales and opacities that are drawn
    moments        8 N (11 + 3 K), the two of Adam
    gradients      4 N (11 + 3 K)
    work           V (a N + (b + c) H W): projecting, sorting and drawing; images, their gradients, derivatives of the
                   loss; c = 5000 for the loss wd, for the activations of VGG-16
    copies         parameters and moments once more, while the density changes

On a CPU copies take the place of gradients and work; on a GPU a graph of the step holds those.

    CUDA    a = 450, b = 90     one H100, 1 M Gaussians at 1600 x 1066
    CPU     a = 130, b = 70     0.02 to 1 M Gaussians at 656 x 492 and 1312 x 984; resident sizes are within 10 %
    c       4400 on a CPU at 640 x 480; on CUDA by the count of activations, 1420 that stay and 2000 at a time; the
            memory of the graph takes the place of that of the first step; not measured
"""

from __future__ import annotations

from typing import NamedTuple

from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.fitting.photo_storage import AHEAD
from lightfield_gs.fitting.settings import FitSettings

_SHRINK = 0.8  # factor from one size of photographs to the next smaller one
_NUMBER_BYTES, _RAW_NUMBERS, _DRAWN_NUMBERS = 4, 11, 4  # of a Gaussian, but for its harmonics; see above
_MOMENTS = 2
_LOSS_WORK = {"l1-ssim": 0, "wd": 5000}  # of a pixel, see above
_WORK = {"cuda": (450, 90), "cpu": (130, 70)}  # of a Gaussian and of a pixel


class MemoryEstimate(NamedTuple):
    """Bytes by their use."""

    photographs: int
    read_ahead: int
    parameters: int
    moments: int
    gradients: int
    work: int
    parameter_copies: int = 0
    moment_copies: int = 0

    def words(self) -> str:
        """Return the uses in words, but for photographs that are read ahead."""
        uses = {
            "photographs": self.photographs,
            "Gaussians": self.parameters,
            "Adam's moments": self.moments,
            "gradients": self.gradients,
            "work": self.work,
            "copies while the density changes": self.parameter_copies + self.moment_copies,
        }
        return ", ".join(f"{name} {to_words(bytes_)}" for name, bytes_ in uses.items())


def estimate_memory(
    settings: FitSettings, device: str, photographs: int, width_px: int, height_px: int, is_masked: bool
) -> MemoryEstimate:
    """Return the memory of a fit with settings.cap_max Gaussians.

    Args:
        settings: of the fit.
        device: "cpu", or a GPU.
        photographs: their number, fitted and held out.
        width_px: of each.
        height_px: of each.
        is_masked: whether some have masks.
    """
    pixels, count = width_px * height_px, settings.cap_max
    photo = pixels * (3 + is_masked * (2 if settings.masks == "alpha" else 1))
    raw = _NUMBER_BYTES * count * (_RAW_NUMBERS + 3 * SH_COEFFICIENTS[settings.sh_degree])
    parameters, moments = raw + _NUMBER_BYTES * count * _DRAWN_NUMBERS, _MOMENTS * raw
    per_gaussian, per_pixel = _WORK["cpu" if device == "cpu" else "cuda"]
    work = settings.batch_size * (per_gaussian * count + (per_pixel + _LOSS_WORK[settings.loss]) * pixels)
    copies = (max(0, parameters + moments - raw - work), 0) if device == "cpu" else (parameters, moments)
    ahead = (AHEAD + settings.batch_size) * photo
    return MemoryEstimate(photographs * photo, ahead, parameters, moments, raw, work, *copies)


def smaller_sizes(longest_px: int, least_px: int) -> list[int]:
    """Return the sizes that photographs are reduced to, pixels of the longer side, the largest first."""
    sizes = [longest_px]
    while (size := round(_SHRINK * sizes[-1])) >= least_px:
        sizes.append(size)
    return sizes[1:]


def to_words(count: int) -> str:
    """Return a number of bytes in words, as 1.5 GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
