"""The settings of a fit under gsplat's names, and how its schedules change from step to step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from lightfield_gs.base.checks import check_fields, checked_field, expect, is_row, real_number, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DENSITIES, LOSSES, MASKS, Density, LossName, Masks

RECIPE_STEPS = 30_000  # of the published recipes; shorter and longer fits scale their schedules
_MOST_STEPS = 10_000_000
PRUNE_START_ITER = 3000  # before, a huge Gaussian may only be there for want of smaller ones
_RECOVERY = 1000  # recipe steps that opacities need after a reset
FORMER_NAMES = {  # of settings in checkpoints of earlier versions
    "gaussians": "cap_max",
    "views": "batch_size",
    "ssim_share": "ssim_lambda",
    "rate_means": "means_lr",
    "means_decay": "means_lr_decay",
    "rate_log_scales": "scales_lr",
    "rate_quaternions": "quats_lr",
    "rate_logits": "opacities_lr",
    "rate_sh_dc": "sh0_lr",
    "rate_sh_rest": "shN_lr",
    "rate_exposure": "exposure_lr",
    "rate_poses": "poses_lr",
    "initial_opacity": "init_opa",
    "initial_scale": "init_scale",
    "sh_every": "sh_degree_interval",
    "refine_from": "refine_start_iter",
    "refine_until": "refine_stop_iter",
    "noise_rate": "noise_lr",
    "opacity_share": "opacity_reg",
    "scale_share": "scale_reg",
    "settle_from": "noise_stop_iter",
    "absolute_gradients": "absgrad",
    "grow_gradient": "grow_grad2d",
    "clone_scale": "grow_scale3d",
    "prune_scale": "prune_scale3d",
}


def decay_rate(rate: float, decay: float, step: int, steps: int) -> float:
    """Return the learning rate at a step: an exponential fall from `rate` to decay * rate over `steps`."""
    return rate * math.exp(math.log(decay) * step / steps)


def _whole(default: int | None, low: int = 0, high: int = _MOST_STEPS) -> Any:
    """Return a field of whole numbers low..high; also None where the default is None."""
    return checked_field(whole_number, low, high, default=default)


def _real(default: float | None, low: float = 0.0, high: float = 1e9) -> Any:
    """Return a field of real numbers low..high; also None where the default is None."""
    return checked_field(real_number, low, high, default=default)


def _choice(default: str, choices: tuple[str, ...]) -> Any:
    """Return a field that takes one of `choices`."""
    return checked_field(_one_of, choices, default=default)


def _flag(default: bool) -> Any:
    """Return a field that takes True or False."""
    return checked_field(_boolean, default=default)


def _one_of(name: str, value: Any, choices: tuple[str, ...]) -> Any:
    if value not in choices:
        raise InputError(f"{name}: expected {' or '.join(choices)}, got {shown(value)}")
    return value


def _boolean(name: str, value: Any) -> Any:
    expect(name, value, bool)
    return value


@dataclass(frozen=True)
class FitSettings:
    """The settings of a fit. Numbers of steps are for a fit of 30,000 steps, and scale with `steps`.

    Sources: Kerbl et al. 2023 and their program; Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte
    Carlo", 2024, for `mcmc`; Ye et al., "AbsGS", 2024, for `absgrad`.

    Raises:
        InputError: a value is outside its range.
    """

    steps: int = _whole(30_000, 1)
    cap_max: int = _whole(300_000, 1, 2**31 - 1)  # the final number of Gaussians for mcmc, the most for adaptive
    density: Density = _choice("mcmc", DENSITIES)
    sh_degree: int = _whole(3, 0, 3)
    batch_size: int = _whole(1, 1, 1024)  # photographs in each step
    seed: int = _whole(0, 0, 2**63 - 1)
    antialiased: bool = _flag(False)
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)  # None: a random colour in each step
    masks: Masks = _choice("ignore", MASKS)  # pixels outside a mask are ignored, or are to be transparent
    exposure: bool = _flag(False)  # fit an affine change of colours for each photograph
    poses: bool = _flag(False)  # refine the cameras' poses

    # l1-ssim: (1 - ssim_lambda) L1 + ssim_lambda (1 - SSIM); wd: and texture, see wasserstein.py
    loss: LossName = _choice("l1-ssim", LOSSES)
    ssim_lambda: float = _real(0.2, 0.0, 1.0)
    # The largest fraction of Gaussians that a step leaves out, see random.py; it rises from 0 and falls to 0 again
    dropout: float = _real(0.0, 0.0, 0.9)
    # Learning rates of Adam. means_lr is in units of the scene's extent and falls by means_lr_decay over the fit
    means_lr: float = _real(1.6e-4)
    means_lr_decay: float = _real(0.01, 1e-9, 1.0)
    scales_lr: float = _real(5e-3)
    quats_lr: float = _real(1e-3)
    opacities_lr: float = _real(5e-2)
    sh0_lr: float = _real(2.5e-3)
    shN_lr: float = _real(2.5e-3 / 20)
    exposure_lr: float = _real(1e-2)  # falls to a tenth
    poses_lr: float = _real(1e-5)  # extents and radians; falls to a hundredth

    # The first Gaussians; scales are factors of the distance to neighbours. init_opa None: the default of `density`
    init_opa: float | None = _real(None, 1e-6, 1.0)
    init_scale: float = _real(0.3, 1e-6, 1e6)  # chosen on three captures, see docs/benchmarks.md

    sh_degree_interval: int = _whole(1000)
    # Density control, every refine_every steps between refine_start_iter and refine_stop_iter
    refine_start_iter: int = _whole(500)
    refine_stop_iter: int | None = _whole(None)  # None: 25,000 for mcmc, 15,000 for adaptive
    refine_every: int = _whole(100)
    min_opacity: float = _real(0.005, 1e-6, 0.4)  # fainter Gaussians are dead
    # mcmc
    growth: float = _real(1.05, 1.0, 1e3)  # factor of the number of Gaussians, each time
    noise_lr: float = _real(5e5)
    opacity_reg: float = _real(0.01)
    scale_reg: float = _real(0.01)
    noise_stop_iter: int = _whole(25_000)  # noise and regularisers are zero from here on
    # adaptive
    absgrad: bool = _flag(False)
    grow_grad2d: float | None = _real(None)  # in halves of the image; None: 2e-4, or 6e-4 with absgrad
    grow_scale3d: float = _real(0.01)  # in extents; smaller Gaussians are cloned, larger ones are split
    # In extents; larger ones are removed after PRUNE_START_ITER, none if None: see docs/benchmarks.md
    prune_scale3d: float | None = _real(None)
    reset_every: int = _whole(0)  # steps between resets of opacities; 0: none, see docs/benchmarks.md
    # steps between sorts of the Gaussians along a Morton curve, while the density changes
    morton_every: int = _whole(5000)

    def __post_init__(self) -> None:
        check_fields(self)
        if self.background is not None:
            if not is_row(self.background, 3):
                raise InputError(f"background: expected red, green and blue, or none, got {shown(self.background)}")
            colours = tuple(real_number("background", value, 0.0, 1.0) for value in self.background)
            object.__setattr__(self, "background", colours)

    @property
    def steady_background(self) -> tuple[float, float, float]:
        """The background of scores and pictures: black where steps have random ones."""
        return self.background or (0.0, 0.0, 0.0)

    def scaled(self, recipe_step: int) -> int:
        """Return the step of this fit for a step of a recipe of 30,000 steps; at least 1."""
        return max(1, round(recipe_step * self.steps / RECIPE_STEPS))

    def degree_at(self, step: int) -> int:
        """Return the degree of the harmonics at a step, counted from 0."""
        return min(self.sh_degree, step // self.scaled(self.sh_degree_interval))

    def refines_after(self, step: int) -> bool:
        """Tell whether the density changes once `step` steps are done."""
        is_due = step % self.scaled(self.refine_every) == 0
        return is_due and self.scaled(self.refine_start_iter) < step < self.refine_end

    @property
    def refine_end(self) -> int:
        """The step after which the density does not change."""
        return self.scaled(self.refine_stop_iter or (25_000 if self.density == "mcmc" else 15_000))

    def rounds_from(self, step: int) -> int:
        """Count the changes of density from a step on, including that step."""
        every, first = self.scaled(self.refine_every), max(step, self.scaled(self.refine_start_iter) + 1)
        return max(0, min(self.steps, self.refine_end - 1) // every - (first - 1) // every)

    def resets_after(self, step: int) -> bool:
        """Tell whether opacities are reset once `step` steps are done.

        The last reset leaves enough steps for opacities to recover.
        """
        if self.density != "adaptive" or self.reset_every == 0:
            return False
        return step % self.scaled(self.reset_every) == 0 and step <= self.refine_end - self.scaled(_RECOVERY)

    def sorts_after(self, step: int) -> bool:
        """Tell whether Gaussians are sorted once `step` steps are done: every morton_every, and at refine_end."""
        return step == self.refine_end or (step < self.refine_end and step % self.scaled(self.morton_every) == 0)

    def means_lr_at(self, step: int) -> float:
        """Return the learning rate of means at a step, in extents: an exponential fall from means_lr."""
        return decay_rate(self.means_lr, self.means_lr_decay, step, self.steps)
