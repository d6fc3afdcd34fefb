"""Every number of a fit, and how the numbers change from step to step."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from lightfield_gs.base.checks import expect, is_row, real_number, shown, whole_number
from lightfield_gs.base.errors import InputError

Density = Literal["mcmc", "adaptive"]
Masks = Literal["ignore", "alpha"]
DENSITIES: tuple[Density, ...] = get_args(Density)
MASKS: tuple[Masks, ...] = get_args(Masks)
RECIPE_STEPS = 30_000  # of the recipes that the schedules are from; those of other lengths are scaled
_RECOVERY = 1000  # recipe steps that opacities need after a reset
_STEPS = (0, 10_000_000)  # least and most of what is a number of steps
_RANGES: dict[str, tuple[Any, Any]] = {  # of the others; of numbers that are not here 0 and 1e9
    "steps": (1, 10_000_000),
    "gaussians": (1, 2**31 - 1),
    "sh_degree": (0, 3),
    "views": (1, 1024),
    "seed": (0, 2**63 - 1),
    "ssim_share": (0.0, 1.0),
    "means_decay": (1e-9, 1.0),
    "initial_opacity": (1e-6, 1.0),
    "initial_scale": (1e-6, 1e6),
    "min_opacity": (1e-6, 0.4),
    "growth": (1.0, 1e3),
    "dropout": (0.0, 0.9),
}


@dataclass(frozen=True)
class FitSettings:
    """How a scene is fitted. Step numbers are those of a fit of 30,000 steps, and are scaled to `steps`.

    Sources: Kerbl et al. 2023 and their program; Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte
    Carlo", 2024, for `mcmc`; Ye et al., "AbsGS", 2024, for absolute gradients. Raises InputError for what cannot be.
    """

    steps: int = 30_000
    gaussians: int = 300_000  # mcmc: their number at the end; adaptive: at most so many
    density: Density = "mcmc"
    sh_degree: int = 3
    views: int = 1  # photographs of a step
    seed: int = 0
    antialiased: bool = False
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)  # None: another random one at each step
    masks: Masks = "ignore"  # what they leave out says nothing, or is transparent
    exposure: bool = False  # an affine change of colours for each photograph
    poses: bool = False  # the cameras' poses are refined

    # The loss: (1 - ssim_share) L1 + ssim_share (1 - SSIM)
    ssim_share: float = 0.2
    # The share of the Gaussians that a step leaves out: grows from 0 to this at the end, see dropout.py
    dropout: float = 0.0
    # Rates of Adam. That of positions is in units of the scene's extent, and falls by means_decay over the fit
    rate_means: float = 1.6e-4
    means_decay: float = 0.01
    rate_log_scales: float = 5e-3
    rate_quaternions: float = 1e-3
    rate_logits: float = 5e-2
    rate_sh_dc: float = 2.5e-3
    rate_sh_rest: float = 2.5e-3 / 20
    rate_exposure: float = 1e-2  # falls to a tenth
    rate_poses: float = 1e-5  # extents and radians; falls to a hundredth

    # How it begins: opacity, and scales by the distance to neighbours; None: that of the strategy for density
    initial_opacity: float | None = None
    initial_scale: float | None = None

    # Density, which is looked at every refine_every steps between refine_from and refine_until
    sh_every: int = 1000
    refine_from: int = 500
    refine_until: int | None = None  # None: 25,000 for mcmc, 15,000 for adaptive
    refine_every: int = 100
    min_opacity: float = 0.005  # fainter ones are dead
    # mcmc
    growth: float = 1.05  # of the number of Gaussians, each time
    noise_rate: float = 5e5
    opacity_share: float = 0.01
    scale_share: float = 0.01
    settle_from: int = 25_000  # from here on there is no noise, and the shares are zero
    # adaptive
    absolute_gradients: bool = False
    grow_gradient: float | None = None  # None: 2e-4, or 6e-4 for absolute gradients; in halves of the image
    clone_scale: float = 0.01  # smaller Gaussians are cloned and larger ones split, in units of the extent
    prune_scale: float = 0.1
    reset_every: int = 3000
    # Gaussians are sorted along a Morton curve every so many steps, as long as density changes
    morton_every: int = 5000

    def __post_init__(self) -> None:
        for field in fields(self):
            value, kind = getattr(self, field.name), str(field.type)
            if value is None and kind.endswith(" | None"):
                continue
            if kind.startswith("int"):
                whole_number(field.name, value, *_RANGES.get(field.name, _STEPS))
            elif kind.startswith("float"):
                number = real_number(field.name, value, *_RANGES.get(field.name, (0.0, 1e9)))
                object.__setattr__(self, field.name, number)
            elif kind == "bool":
                expect(field.name, value, bool)
        for name, choices in (("density", DENSITIES), ("masks", MASKS)):
            if getattr(self, name) not in choices:
                raise InputError(f"{name}: expected {' or '.join(choices)}, got {shown(getattr(self, name))}")
        if self.background is not None:
            if not is_row(self.background, 3):
                raise InputError(f"background: expected red, green and blue, or none, got {shown(self.background)}")
            colours = tuple(real_number("background", value, 0.0, 1.0) for value in self.background)
            object.__setattr__(self, "background", colours)

    @property
    def steady_background(self) -> tuple[float, float, float]:
        """What is behind a scene that is scored or shown: black where steps have random ones."""
        return self.background or (0.0, 0.0, 0.0)

    def scaled(self, recipe_step: int) -> int:
        """The step of this fit at which what a recipe of 30,000 steps does at `recipe_step` is due; 1 at least."""
        return max(1, round(recipe_step * self.steps / RECIPE_STEPS))

    def degree_at(self, step: int) -> int:
        """The degree of the harmonics at a step, counted from 0: one more every sh_every steps."""
        return min(self.sh_degree, step // self.scaled(self.sh_every))

    def refines_after(self, step: int) -> bool:
        """Whether the density changes once `step` steps are done."""
        return step % self.scaled(self.refine_every) == 0 and self.scaled(self.refine_from) < step < self.refine_end

    @property
    def refine_end(self) -> int:
        """The step from which on the density stays as it is."""
        return self.scaled(self.refine_until or (25_000 if self.density == "mcmc" else 15_000))

    def rounds_from(self, step: int) -> int:
        """How often the density changes from a step on, that step counted."""
        every, first = self.scaled(self.refine_every), max(step, self.scaled(self.refine_from) + 1)
        return max(0, min(self.steps, self.refine_end - 1) // every - (first - 1) // every)

    def resets_after(self, step: int) -> bool:
        """Whether opacities are reset once `step` steps are done; never so late that they stay faint to the end."""
        due = step % self.scaled(self.reset_every) == 0 and step <= self.refine_end - self.scaled(_RECOVERY)
        return self.density == "adaptive" and due

    def sorts_after(self, step: int) -> bool:
        """Whether Gaussians are sorted once `step` steps are done: now and then, and when their number is final."""
        return step == self.refine_end or (step < self.refine_end and step % self.scaled(self.morton_every) == 0)

    def rate_means_at(self, step: int) -> float:
        """The rate of positions at a step, in units of the extent: from rate_means down, exponentially."""
        return self.rate_means * math.exp(math.log(self.means_decay) * step / self.steps)
