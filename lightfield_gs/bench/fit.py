"""A fit beside others: how good the views that were held out are after so many steps and seconds.

All arms fit the same Gaussians at the same points to the same photographs, one a step and in the same order, in the
same coordinates and before black; their cameras stay as they are, and so do the photographs' exposures.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import peers
from lightfield_gs.bench.fit_data import BLACK, Fit, Photographs, scores
from lightfield_gs.bench.fit_peer import PeerFit, Recipe
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.settings import Density, FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

MARKS = (1000, 2000, 4000, 7000, 15_000, 30_000)  # steps after which a fit is scored, and after the last
STEPS, GAUSSIANS, LONGEST_PX = {"cpu": 200, "cuda": 7000}, {"cpu": 5000, "cuda": 300_000}, {"cpu": 160, "cuda": None}
WARM_UP_STEPS = 20  # of a fit that is thrown away: kernels load, libraries start


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
        return render(self.gaussians(), cameras, background=BLACK)


def _ours(density: Density, photographs: Photographs, settings: FitSettings) -> Fit:
    return OurFit(photographs, replace(settings, density=density))


def _peer(recipe: Recipe, photographs: Photographs, settings: FitSettings) -> Fit:
    start = photographs.start(recipe.initial(settings, len(photographs.points)))
    return PeerFit(recipe, start, photographs.train, settings)


RECIPES = {
    "gsplat-mcmc": Recipe("gsplat", "mcmc"),
    "gsplat-default": Recipe("gsplat", "default"),
    "gsplat-absgrad": Recipe("gsplat", "absgrad"),
    "gsplat-mcmc-our-loss": Recipe("gsplat", "mcmc", our_loss=True),
    "gsplat-default-our-loss": Recipe("gsplat", "default", our_loss=True),
    "our-rasterizer-gsplat-mcmc": Recipe("ours", "mcmc"),
    "our-rasterizer-gsplat-default": Recipe("ours", "default"),
}
ARMS: dict[str, Callable[[Photographs, FitSettings], Fit]] = {
    "ours": partial(_ours, "mcmc"),
    "ours-adaptive": partial(_ours, "adaptive"),
    **{name: partial(_peer, recipe) for name, recipe in RECIPES.items()},
}
OUR_ARMS, USUAL_ARMS = ("ours",), ("ours", "gsplat-mcmc", "gsplat-default")


def check_arms(arms: Sequence[str]) -> None:
    """Raises InputError for arms that there are not, and where those of gsplat cannot be had."""
    if unknown := sorted(set(arms) - set(ARMS)):
        raise InputError(f"--arms: expected of {', '.join(ARMS)}, got {', '.join(unknown)}")
    if set(arms) & set(RECIPES):
        peers.gsplat()


def usual_arms(device: str, complain: Callable[[str], None]) -> tuple[str, ...]:
    """Ours, and those of gsplat where it can be had on CUDA; `complain` hears why not."""
    if device == "cuda":
        try:
            peers.gsplat()
            return USUAL_ARMS
        except InputError as error:
            complain(f"no arms of gsplat: {error}")
    return OUR_ARMS


def marks(steps: int) -> list[int]:
    """The steps after which a fit of so many is scored."""
    return sorted({*(mark for mark in MARKS if mark < steps), steps})


def rows(photographs: Photographs, arms: Sequence[str], settings: FitSettings, seeds: int) -> Iterator[dict[str, Any]]:
    """A row for each seed, arm and mark, in this order, as soon as it is known. Raises InputError."""
    for seed in range(seeds):
        for arm in arms:
            yield from _rows_of(photographs, arm, replace(settings, seed=seed))


def _rows_of(photographs: Photographs, arm: str, settings: FitSettings) -> Iterator[dict[str, Any]]:
    """The rows of one fit. Times are of its steps alone, from device to device."""
    device = photographs.train.device
    begin = partial(ARMS[arm], photographs, settings)
    if device.type == "cuda":
        begin().advance(min(WARM_UP_STEPS, settings.steps))
    _clear(device)
    held = torch.cuda.memory_allocated() if device.type == "cuda" else 0
    fit, seconds, done, peak = begin(), 0.0, 0, 0
    for mark in marks(settings.steps):
        taken, most = _timed(partial(fit.advance, mark), device)
        seconds, peak = seconds + taken, max(peak, most - held)
        yield {
            "capture": photographs.name,
            "arm": arm,
            "seed": settings.seed,
            "steps": settings.steps,
            "step": mark,
            **scores(fit, photographs.test),
            "gaussians": fit.gaussians().count,
            "seconds": seconds,
            "ms_step": 1e3 * seconds / mark,
            "ms_step_lately": 1e3 * taken / (mark - done),
            "peak_bytes": peak if device.type == "cuda" else None,
        }
        done = mark
    del fit
    _clear(device)


def _clear(device: torch.device) -> None:
    """Lets go of what earlier fits held."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.empty_cache()


def _timed(call: Callable[[], None], device: torch.device) -> tuple[float, int]:
    """Seconds that a call takes until the device is done, and the most memory of it that is held meanwhile."""
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    began = time.perf_counter()
    call()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began, torch.cuda.max_memory_allocated() if device.type == "cuda" else 0


def protocol(photographs: Photographs, settings: FitSettings, arms: Sequence[str], folder: Path) -> dict[str, Any]:
    """What all rows have in common."""
    train, test = photographs.train, photographs.test
    return {
        "capture": photographs.name,
        "folder": str(folder),
        "photographs": train.count,
        "held_out": test.names,
        "width_px": train.width_px,
        "height_px": train.height_px,
        "masked": train.weights is not None or test.weights is not None,
        "points": len(photographs.points),
        "steps": settings.steps,
        "gaussians": settings.cap_max,
        "gsplat": peers.gsplat().__version__ if set(arms) & set(RECIPES) else None,
    }
