"""The memory that a fit needs, said before it begins, and refused where there is clearly less.

With N Gaussians of K harmonics, V photographs of H x W pixels in a step, and C photographs in all, in bytes:

    photographs    C H W 4: colours, and masks where there are any; 5 where masks are the target of alpha;
                   none where they stay with the host
    fields         4 N (11 + 3 K) x 3: values and two moments; twice while the density changes
    gradients      4 N (11 + 3 K)
    work           V (450 N + 90 H W)

The numbers of work are a step's on one H100: what projecting, sorting and drawing 1 M Gaussians at 1600 x 1066 took
(471 MB), and the images, their gradients and the derivatives of the loss for each pixel.
"""

from __future__ import annotations

import os
from typing import NamedTuple

import torch

from lightfield_gs.base.cuda import free_memory
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_COEFFICIENTS
from lightfield_gs.fitting.settings import FitSettings

REMEDIES = "use fewer --gaussians, a smaller --scale or a lower --sh-degree"
_NUMBER_BYTES, _SHAPE_NUMBERS, _COPIES = 4, 11, 6  # of means, scales, quaternions and opacity; see above
_WORK_PER_GAUSSIAN, _WORK_PER_PIXEL = 450, 90
_MOST_PHOTOGRAPHS = 0.5  # of the free memory of a GPU
_CLEARLY = 1.1  # the estimate may be so much too high


class Need(NamedTuple):
    """Bytes, by what they are for."""

    photographs: int
    fields: int
    gradients: int
    work: int

    @property
    def total(self) -> int:
        return sum(self)


def needed(settings: FitSettings, photographs: int, width_px: int, height_px: int) -> Need:
    """What a fit with as many Gaussians as its settings allow needs; photographs: fitted and held out."""
    pixels = width_px * height_px
    numbers = _SHAPE_NUMBERS + 3 * SH_COEFFICIENTS[settings.sh_degree]
    field = _NUMBER_BYTES * settings.cap_max * numbers
    work = settings.batch_size * (_WORK_PER_GAUSSIAN * settings.cap_max + _WORK_PER_PIXEL * pixels)
    return Need(photographs * pixels * (5 if settings.masks == "alpha" else 4), _COPIES * field, field, work)


def stays_on_host(need: Need, device: str) -> bool:
    """Whether the photographs would take so much of a GPU's memory that they are better kept in the host's: a step then
    copies its own, a tenth of a millisecond for a megapixel."""
    free = None if device == "cpu" else free_bytes(device)
    return free is not None and need.photographs > _MOST_PHOTOGRAPHS * free


def check(need: Need, device: str, is_certain: bool) -> str:
    """What is needed, in words. is_certain: whether it will be, and not only may: raises InputError where that is
    clearly more than the device has free."""
    free = free_bytes(device)
    words = (
        f"{_shown(need.total)} of memory (photographs {_shown(need.photographs)}, Gaussians and moments "
        f"{_shown(need.fields)}, gradients {_shown(need.gradients)}, work {_shown(need.work)})"
    )
    if free is None:
        return words
    if is_certain and need.total > _CLEARLY * free:
        raise InputError(f"the fit needs {words}, and {device} has {_shown(free)} free; {REMEDIES}")
    return f"{words} of {_shown(free)} free"


def free_bytes(device: str) -> int | None:
    """What a device, or the host for "cpu", can still give; None where the system does not tell."""
    if device != "cpu":
        return free_memory(torch.device(device))
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            lines = dict(line.split(":", 1) for line in file)
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def _shown(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"
