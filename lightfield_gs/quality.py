"""How much of a light-field image may be given up for time: knobs, and named settings of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from lightfield_gs import _core
from lightfield_gs.errors import InputError, expect
from lightfield_gs.panel import real_number

OPACITY_CUT, TRANSMITTANCE_STOP, COLOUR_ERROR = 1 / 255, 1e-4, 5e-5


@dataclass(frozen=True)
class Quality:
    """Knobs of run time against error, all of them errors of colours in 0..1. As they are made: nothing given up.

    opacity_cut: 1/255..0.5; a Gaussian leaves samples alone where its alpha is below. A sample that K Gaussians with
        alpha between 1/255 and the cut would have reached changes by at most 1 - (1 - cut)^K.
    transmittance_stop: 1e-4..0.5; a sample ends before its transmittance would fall below, and the Gaussian that ends
        it takes what light is left: an error of at most the stop.
    colour_error: 0..1; of the polynomials that stand for spherical harmonics over the rig, hence of the image.
    rough_alpha: alpha to a relative error of 4e-3 instead of 4e-5; errors of at most 4e-3 times the sum of alpha times
        transmittance, hence at most 4e-3.
    lattice_error: 0..1; where the light field is smooth it is evaluated on a coarse lattice in (x, y, view) only, and
        interpolated. The middle of every cell of the lattice is evaluated too: nowhere there is the error larger than
        this, nor its root mean square over a run of tiles larger than a fifth; else the lattice is refined, split
        or given up. Between corners and middles it is what a smooth field leaves it, not bounded. Colours on a lattice
        end at 0 and 1. 0: no lattice. CPU only.
    Raises InputError for numbers out of their ranges.
    """

    opacity_cut: float = OPACITY_CUT
    transmittance_stop: float = TRANSMITTANCE_STOP
    colour_error: float = COLOUR_ERROR
    rough_alpha: bool = False
    lattice_error: float = 0.0

    def __post_init__(self) -> None:
        for name, low, high in (("opacity_cut", OPACITY_CUT, 0.5), ("transmittance_stop", TRANSMITTANCE_STOP, 0.5),
                                ("colour_error", 0.0, 1.0), ("lattice_error", 0.0, 1.0)):
            real_number(f"quality: {name}", getattr(self, name), low, high)
        expect("quality: rough_alpha", self.rough_alpha, bool)

    @staticmethod
    def of(quality: str | Quality) -> Quality:
        """The setting of that name, or the object itself. Raises InputError."""
        if isinstance(quality, Quality):
            return quality
        if not isinstance(quality, str) or quality not in QUALITIES:
            raise InputError(f"quality must be one of {', '.join(QUALITIES)} or a Quality, got {quality!r}")
        return QUALITIES[quality]

    @property
    def is_exact(self) -> bool:
        """Whether nothing is given up."""
        return self == EXACT

    @cached_property
    def native(self) -> Any:
        return _core.Quality(opacity_cut=self.opacity_cut, transmittance_stop=self.transmittance_stop,
                             lattice=self.lattice_error, rough=self.rough_alpha)


EXACT = Quality()
QUALITIES = {
    "exact": EXACT,
    "high": Quality(opacity_cut=1 / 128, transmittance_stop=1e-2, colour_error=1e-3, rough_alpha=True,
                    lattice_error=0.02),
    "fast": Quality(opacity_cut=1 / 40, transmittance_stop=5e-2, colour_error=4e-3, rough_alpha=True,
                    lattice_error=0.06),
    "draft": Quality(opacity_cut=1 / 16, transmittance_stop=1e-1, colour_error=1e-2, rough_alpha=True,
                     lattice_error=0.15),
}
