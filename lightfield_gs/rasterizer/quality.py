"""The quality of a light-field image: knobs that trade accuracy for time, and named settings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from lightfield_gs import _core
from lightfield_gs.base.checks import check_fields, checked_field, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import QualityName

OPACITY_CUT, TRANSMITTANCE_STOP, COLOUR_ERROR = 1 / 255, 1e-4, 5e-5
_APPROXIMATE = 0.02  # kApproximateError in csrc/math/quality.h


@dataclass(frozen=True)
class Quality:
    """Knobs that trade errors of colours in 0..1 for run time. The defaults are exact.

    Attributes:
        opacity_cut: 1/255..0.5. A Gaussian skips the samples where its alpha is below the cut. Opacities rise by cut
            - 1/255 (to 0.99 at most), which keeps the integral of alpha. A sample that K Gaussians would have reached
            changes by at most K cut. Approximate evaluation skips whole patches of samples, and raises opacities by
            less: the same cut then costs about 6 dB less.
        transmittance_stop: 1e-4..0.5. A sample ends before its transmittance would fall below the stop. The last
            Gaussian takes the light that is left: an error of at most the stop. Pays in deep opaque scenes.
        colour_error: 0..1. Polynomials replace spherical harmonics over the rig. Their interpolation may err by this,
            and the omitted highest powers by the same amount again. Near the cameras, where no polynomial is so good,
            colours are exact. 0: all colours are exact.
        lattice_error: 0..1. Where the light field is smooth, it is evaluated on a coarse lattice in (x, y, view) and
            interpolated. As a check the middle of every cell is evaluated too. Nodes are moved by two thirds of the
            errors round them, on CUDA only if these errors are too large: so bends err to both sides. A lattice is
            accepted under three conditions. No error in a middle is larger than this. The root mean square of these
            errors over a run of tiles (on CUDA: a tile) is at most a fifth of this. No node was moved farther than
            this. Else the lattice is refined, split or given up. Elsewhere the error has no bound. Colours on a lattice
            end at 0 and 1; on the CPU its nodes have 8 bits. On CUDA panels with sub-pixel cells and anti-aliased
            scenes have no lattices. 0: none.
        contribution_cut: 0..1. A Gaussian is left out if the sum of its alphas over all sub-pixels, without occlusion,
            is less than contribution_cut * sub-pixels / Gaussians. A sample changes by at most the sum of the alphas
            left out there. The mean of all samples changes by at most this, unless Gaussians are few, for integrals
            replace the sums. Pays in captures of many small Gaussians, not where all are alike. `prune` also takes
            occlusion into account, once for a scene, and leaves out more for the same error. 0: none.
        evaluation_error: 0..1, error of the arithmetic. From 0.02 on samples may be evaluated approximately, with some
            60 dB. On CUDA numbers then have 16 bits, two at a time. On the CPU there are fewer operations, and samples
            end at a transmittance of 0.002. Colours above 1 lose at most that fraction. 0: float32.

    Raises:
        InputError: a number is out of its range.
    """

    opacity_cut: float = checked_field(real_number, OPACITY_CUT, 0.5, default=OPACITY_CUT)
    transmittance_stop: float = checked_field(real_number, TRANSMITTANCE_STOP, 0.5, default=TRANSMITTANCE_STOP)
    colour_error: float = checked_field(real_number, 0.0, 1.0, default=COLOUR_ERROR)
    lattice_error: float = checked_field(real_number, 0.0, 1.0, default=0.0)
    contribution_cut: float = checked_field(real_number, 0.0, 1.0, default=0.0)
    evaluation_error: float = checked_field(real_number, 0.0, 1.0, default=0.0)

    def __post_init__(self) -> None:
        check_fields(self, "quality: ")

    @staticmethod
    def of(quality: QualityName | Quality) -> Quality:
        """Return the setting of that name, or the object itself. Raises InputError."""
        if isinstance(quality, Quality):
            return quality
        if not isinstance(quality, str) or quality not in QUALITIES:
            raise InputError(f"quality must be one of {', '.join(QUALITIES)} or a Quality, got {shown(quality)}")
        return replace(EXACT, **QUALITIES[quality]) if QUALITIES[quality] else EXACT

    @property
    def is_exact(self) -> bool:
        """Whether nothing is given up."""
        return self == EXACT

    @property
    def is_approximate(self) -> bool:
        """Whether samples may be evaluated approximately: approximate() in csrc/math/quality.h."""
        return self.evaluation_error >= _APPROXIMATE

    def __getstate__(self) -> dict[str, object]:
        """Return what copies and pickles take: all but the core's own, which is made again."""
        return {name: value for name, value in vars(self).items() if name != "native"}

    @cached_property
    def native(self) -> _core.Quality:
        return _core.Quality(
            opacity_cut=self.opacity_cut,
            transmittance_stop=self.transmittance_stop,
            lattice=self.lattice_error,
            contribution=self.contribution_cut,
            evaluation=self.evaluation_error,
        )


EXACT = Quality()
# On the 8K frames of `bench pareto`, scenes and photos, high reaches a PSNR of at least 50 dB, fast 40 dB, draft 33 dB.
# The opacity cuts are made for photos, in which many faint Gaussians overlap; scenes that are less deep bear cuts four
# times as high.
QUALITIES: dict[str, dict[str, float]] = {  # the knobs of each name that are not those of EXACT
    "exact": {},
    "high": {"opacity_cut": 1 / 128, "colour_error": 1e-3, "lattice_error": 0.02, "evaluation_error": 0.02},
    "fast": {"opacity_cut": 1 / 64, "colour_error": 4e-3, "lattice_error": 0.08, "evaluation_error": 0.02},
    "draft": {"opacity_cut": 1 / 20, "colour_error": 1e-2, "lattice_error": 0.2, "evaluation_error": 0.02},
}
