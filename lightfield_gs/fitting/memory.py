"""The memory that a fit needs: photographs are reduced until it suffices, or a fit is refused before it begins.

With N Gaussians of K harmonics, V photographs of H x W pixels in a step, and C photographs in all, in bytes:

    photographs    C H W 4: colours and masks; 5 where masks are the target of alpha; none where they stay on the host
    parameters     4 N (11 + 3 K) x 3: values and two moments; twice while the density changes
    gradients      4 N (11 + 3 K)
    work           V (450 N + 90 H W)

The factors of work are from a step on one H100. Projecting, sorting and drawing 1 M Gaussians at 1600 x 1066 took
471 MB. For each pixel there are the images, their gradients and the derivatives of the loss.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from lightfield_gs.base.device import free_memory
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.base.system import free_host_memory
from lightfield_gs.fitting.settings import FitSettings

REMEDIES = "use a smaller cap_max=, a smaller scale= or a lower sh_degree="
_SHRINK = 0.8  # factor from one size of photographs to the next smaller one
_SPARE = 0.8  # of the free memory that a fit with reduced photographs may take
_NUMBER_BYTES, _SHAPE_NUMBERS, _COPIES = 4, 11, 6  # of means, scales, quaternions and opacity; see above
_WORK_PER_GAUSSIAN, _WORK_PER_PIXEL = 450, 90
_MOST_PHOTOGRAPHS = 0.5  # of the free memory of a GPU
_TOLERANCE = 1.1  # the estimate may be too high by this factor


class MemoryEstimate(NamedTuple):
    """Bytes by their use."""

    photographs: int
    parameters: int
    gradients: int
    work: int

    @property
    def total(self) -> int:
        return sum(self)


def estimate_memory(settings: FitSettings, photographs: int, width_px: int, height_px: int) -> MemoryEstimate:
    """Return the memory of a fit with settings.cap_max Gaussians.

    Args:
        settings: of the fit.
        photographs: their number, fitted and held out.
        width_px: of each.
        height_px: of each.
    """
    pixels = width_px * height_px
    numbers = _SHAPE_NUMBERS + 3 * SH_COEFFICIENTS[settings.sh_degree]
    parameters = _NUMBER_BYTES * settings.cap_max * numbers
    work = settings.batch_size * (_WORK_PER_GAUSSIAN * settings.cap_max + _WORK_PER_PIXEL * pixels)
    photos = photographs * pixels * (5 if settings.masks == "alpha" else 4)
    return MemoryEstimate(photos, _COPIES * parameters, parameters, work)


def smaller_sizes(longest_px: int, least_px: int) -> list[int]:
    """Return the sizes that photographs are reduced to, pixels of the longer side, the largest first."""
    sizes = [longest_px]
    while (size := round(_SHRINK * sizes[-1])) >= least_px:
        sizes.append(size)
    return sizes[1:]


def suffices(need: MemoryEstimate, device: str) -> bool:
    """Return whether the memory of a device, and of the host for photographs that stay there, clearly suffices.

    True where the system does not state it.
    """
    on_host = need.photographs if keeps_photos_on_host(need, device) else 0
    needs = {device: need.total - on_host, **({"cpu": on_host} if on_host else {})}
    return all((free := free_bytes(where)) is None or bytes_ <= _SPARE * free for where, bytes_ in needs.items())


def keeps_photos_on_host(need: MemoryEstimate, device: str) -> bool:
    """Return whether photographs take too much of a GPU's memory and should stay in the host's memory.

    A step then copies its own, a tenth of a millisecond for a megapixel.
    """
    free = None if device == "cpu" else free_bytes(device)
    return free is not None and need.photographs > _MOST_PHOTOGRAPHS * free


def check_memory(need: MemoryEstimate, device: str, is_certain: bool) -> str:
    """Return the needed memory in words.

    Args:
        need: the estimate.
        device: of the fit.
        is_certain: whether the fit will need it, or only may need it.

    Raises:
        InputError: the need is certain, and clearly less is free.
    """
    free = free_bytes(device)
    words = (
        f"{to_words(need.total)} of memory (photographs {to_words(need.photographs)}, Gaussians and moments "
        f"{to_words(need.parameters)}, gradients {to_words(need.gradients)}, work {to_words(need.work)})"
    )
    if free is None:
        return words
    if is_certain and need.total > _TOLERANCE * free:
        raise InputError(f"the fit needs {words}, and {device} has {to_words(free)} free; {REMEDIES}")
    return f"{words} of {to_words(free)} free"


def free_bytes(device: str) -> int | None:
    """Return the free memory of a device, or of the host for "cpu"; None if the system does not state it."""
    return free_host_memory() if device == "cpu" else free_memory(torch.device(device))


def to_words(count: int) -> str:
    """Return a number of bytes in words, as 1.5 GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
