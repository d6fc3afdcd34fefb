"""The arms of `bench fit`: our fits, and those of gsplat's strategies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Protocol

from torch import Tensor

from benchmarks import peers
from benchmarks.fit_photographs import Photographs
from benchmarks.gsplat_fit import BLACK, PeerFit, Recipe
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.fitting.vgg16 import fetch_weights
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians


class Fit(Protocol):
    """A fit under way."""

    def advance(self, until: int) -> None:
        """Does the steps up to `until`."""

    def gaussians(self) -> Gaussians:
        """The scene as it is now."""

    def draw(self, cameras: Cameras) -> Tensor:
        """It before a camera, by the rasterizer that it is fitted with: [1, H, W, 3]."""


class OurFit:
    """Ours."""

    def __init__(self, photographs: Photographs, settings: FitSettings) -> None:
        self._trainer = Trainer(GaussianState.start(photographs.start(settings)), photographs.train, settings)

    def advance(self, until: int) -> None:
        """Does the steps up to `until`."""
        self._trainer.advance(until)

    def gaussians(self) -> Gaussians:
        """The scene as it is now."""
        return self._trainer.state.gaussians()

    def draw(self, cameras: Cameras) -> Tensor:
        """It before a camera, [1, H, W, 3]."""
        return render(self.gaussians(), cameras, background=BLACK).image


def _ours(changes: dict[str, Any], photographs: Photographs, settings: FitSettings) -> Fit:
    return OurFit(photographs, replace(settings, **{"exposure": photographs.exposures_differ} | changes))


def _peer(recipe: Recipe, photographs: Photographs, settings: FitSettings) -> Fit:
    start = photographs.start(recipe.initial(settings, len(photographs.points)))
    return PeerFit(recipe, start, photographs.train, settings)


PEER_ARMS = {
    "gsplat-mcmc": Recipe("gsplat", "mcmc"),
    "gsplat-default": Recipe("gsplat", "default"),
    "gsplat-absgrad": Recipe("gsplat", "absgrad"),
    "gsplat-mcmc-our-loss": Recipe("gsplat", "mcmc", our_loss=True),
    "gsplat-default-our-loss": Recipe("gsplat", "default", our_loss=True),
    "our-rasterizer-gsplat-mcmc": Recipe("ours", "mcmc"),
    "our-rasterizer-gsplat-default": Recipe("ours", "default"),
}
WD_ARM = "ours-wd"
ARMS: dict[str, Callable[[Photographs, FitSettings], Fit]] = {
    "ours": partial(_ours, {}),
    "ours-no-exposure": partial(_ours, {"exposure": False}),
    "ours-adaptive": partial(_ours, {"density": "adaptive"}),
    WD_ARM: partial(_ours, {"loss": "wd"}),
    **{name: partial(_peer, recipe) for name, recipe in PEER_ARMS.items()},
}
OURS = "ours"
OUR_ARMS, USUAL_ARMS = (OURS,), (OURS, "gsplat-mcmc", "gsplat-default")
GSPLAT_STRATEGIES = ("gsplat-mcmc", "gsplat-default", "gsplat-absgrad")  # in all parts gsplat's own


def check_arms(arms: Sequence[str]) -> None:
    """Fetch the weights that arms need; raise InputError for unknown arms, and where gsplat or weights are missing."""
    if unknown := sorted(set(arms) - set(ARMS)):
        raise InputError(f"arms=: expected of {', '.join(ARMS)}, got {', '.join(unknown)}")
    if WD_ARM in arms:
        fetch_weights(options.progress)
    if set(arms) & set(PEER_ARMS):
        peers.gsplat()


def usual_arms(device: str) -> tuple[str, ...]:
    """Return our arms, and the arms of gsplat if it runs on CUDA here."""
    if device == "cuda":
        try:
            peers.gsplat()
            return USUAL_ARMS
        except InputError as error:
            options.progress(f"no arms of gsplat: {error}")
    return OUR_ARMS
