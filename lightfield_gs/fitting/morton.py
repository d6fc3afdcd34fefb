"""The order of Gaussians along a Morton curve, on which neighbours in space lie near each other in memory too (Morton,
"A computer oriented geodetic data base", 1966); drawing and updating them then reads less from afar.
"""

from __future__ import annotations

from torch import Tensor

_BITS = 21  # an axis: three of them fill 63 bits
_OUTSIDE = 0.005  # of the Gaussians lie beyond the box on either side, for a few stray ones would make it too coarse
# What spreads the bits of a number so that each has two free places before it: shifts, and the bits that stay
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def order_of(means: Tensor) -> Tensor:
    """[N] int64: which Gaussian comes where if they follow the curve; equal codes keep their order. means [N,3]."""
    return codes(means).argsort(stable=True)


def codes(means: Tensor) -> Tensor:
    """[N] int64: the bits of x, y and z of means [N,3] by turns, z first; each of 21 bits over the box of the middle
    99 % along that axis, beyond which the outermost number stands."""
    ordered = means.double().sort(0).values
    outside = int(_OUTSIDE * len(means))
    low, high = ordered[outside], ordered[len(means) - 1 - outside]
    share = (means.double() - low) / (high - low).clamp_min(1e-300)
    x, y, z = _spread((share * 2**_BITS).clamp(0, 2**_BITS - 1).long()).unbind(1)
    return x | y << 1 | z << 2


def _spread(numbers: Tensor) -> Tensor:
    """Bit k of each number at bit 3 k."""
    for shift, kept in _SPREAD:
        numbers = (numbers | numbers << shift) & kept
    return numbers
