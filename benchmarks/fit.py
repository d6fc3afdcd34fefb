"""Compare fits: the quality of held-out photographs after some steps and seconds.

All arms fit the same Gaussians at the same points to the same photographs, one a step, in the same order. Coordinates
are the same, and the background is black. Cameras and exposures stay fixed.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from benchmarks import fit_report, peers
from benchmarks.gsplat_fit import BLACK, PeerFit, Recipe
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.report import check_plot
from lightfield_gs.bench.timing import machine
from lightfield_gs.commands.options.parser import whole
from lightfield_gs.fitting.evaluate import render_and_photo, weighted_psnr_db, weighted_ssim
from lightfield_gs.fitting.initialization import initialize_gaussians
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.fitting.settings import Density, FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.captures.capture import Capture, read_capture
from lightfield_gs.io.text_files import write_json
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
        return render(self.gaussians(), cameras, background=BLACK).image


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
    """Raise InputError for unknown arms, and for arms of gsplat where it is not installed."""
    if unknown := sorted(set(arms) - set(ARMS)):
        raise InputError(f"arms=: expected of {', '.join(ARMS)}, got {', '.join(unknown)}")
    if set(arms) & set(RECIPES):
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


def marks(steps: int) -> list[int]:
    """The steps after which a fit of so many is scored."""
    return sorted({*(mark for mark in MARKS if mark < steps), steps})


def rows(photographs: Photographs, arms: Sequence[str], settings: FitSettings, seeds: int) -> Iterator[dict[str, Any]]:
    """A row for each seed, arm and mark, in this order, as soon as it is known. Raises InputError."""
    for seed in range(seeds):
        for arm in arms:
            yield from _fit_rows(photographs, arm, replace(settings, seed=seed))


def _fit_rows(photographs: Photographs, arm: str, settings: FitSettings) -> Iterator[dict[str, Any]]:
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
    """Free the memory of earlier fits."""
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
    """Return the fields common to all rows."""
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


class Fit(Protocol):
    """A fit under way."""

    def advance(self, until: int) -> None:
        """Does the steps up to `until`."""

    def gaussians(self) -> Gaussians:
        """The scene as it is now."""

    def draw(self, cameras: Cameras) -> Tensor:
        """It before a camera, by the rasterizer that it is fitted with: [1, H, W, 3]."""


@dataclass(frozen=True)
class Photographs:
    """A capture on its device, in normalised coordinates: training images and held-out images.

    It also has points [P,3], their colours [P,3] uint8, and the centres [C,3] of all cameras.
    """

    name: str
    train: PosedImages
    test: PosedImages
    points: np.ndarray
    colours: np.ndarray
    centres: np.ndarray

    @classmethod
    def load(cls, capture: Capture, test_every: int, device: str) -> Photographs:
        """Those of a capture. Raises InputError."""
        normalization = Normalization.from_centres(capture.centres, capture.extent)
        train, test = capture.split(test_every)
        if not test:
            raise InputError(
                f"{capture.folder}: {len(capture.names)} photographs are too few to hold out one of {test_every}; "
                "give a smaller test_every="
            )
        fitted, held = (PosedImages.load(capture, some, normalization, device, some) for some in (train, test))
        points, centres = (normalization.points(places) for places in (capture.points, capture.centres))
        return cls(capture.folder.resolve().name, fitted, held, points, capture.colours, centres)

    def start(self, settings: FitSettings) -> Gaussians:
        """Return the initial Gaussians of a fit, on the device."""
        return initialize_gaussians(self.points, self.colours, self.centres, settings).to(self.train.device)


@torch.no_grad()
def scores(fit: Fit, images: PosedImages) -> dict[str, float]:
    """Return means over photographs: PSNR in dB, SSIM, and the PSNR of the same scene drawn by ours.

    The first two are drawn by the fit's own rasterizer, by the protocol of fitting/evaluate.py.
    """
    scene, found = fit.gaussians(), []
    for place, (width, height) in enumerate(images.sizes):
        by_ours, photo, weights = render_and_photo(scene, images, place, BLACK)
        image = fit.draw(images.cameras(place))[0, :height, :width].clamp(0, 1)
        psnr, psnr_by_ours = (weighted_psnr_db(picture, photo, weights) for picture in (image, by_ours))
        found.append((psnr, weighted_ssim(image, photo, weights), psnr_by_ours))
    return dict(zip(("psnr_db", "ssim", "psnr_db_by_ours"), np.mean(found, 0).tolist()))


@dataclass(frozen=True, kw_only=True)
class Options(options.BenchmarkOptions):
    """The options of the benchmark.

    Attributes:
        capture: folder of the capture.
        gaussians, steps, longest_px: None: those of GAUSSIANS, STEPS and LONGEST_PX.
        seeds: number of fits of each arm.
        arms: names with commas. None: see `usual_arms`.
        test_every: one of so many photographs is held out.
        plot: file for the picture of the rows.
    """

    capture: Path
    gaussians: int | None = None
    steps: int | None = None
    seeds: int = 1
    arms: str | None = None
    longest_px: int | None = None
    test_every: int = 8
    plot: Path | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="the folder of a capture")
    parser.add_argument(
        "--gaussians",
        type=whole(1, 100_000_000),
        metavar="N",
        help="how many a scene has at the end, of the arms that are told (default: "
        f"{GAUSSIANS['cuda']}, on the CPU {GAUSSIANS['cpu']})",
    )
    parser.add_argument(
        "--steps",
        type=whole(1, 10_000_000),
        help=f"schedules are scaled to them (default: {STEPS['cuda']}, on the CPU {STEPS['cpu']})",
    )
    parser.add_argument("--seeds", type=whole(1, 1000), default=1, help="how many fits of each arm (default: 1)")
    parser.add_argument(
        "--arms",
        help=f"with commas, of {', '.join(ARMS)} (default: {', '.join(USUAL_ARMS)}, or ours alone on the CPU "
        "and where gsplat is not installed)",
    )
    parser.add_argument(
        "--longest-px",
        type=whole(16, 16_384),
        help="photographs are shrunk to this many pixels on their longer side (default: not at all, on the CPU to "
        f"{LONGEST_PX['cpu']})",
    )
    parser.add_argument(
        "--test-every",
        type=whole(2, 1_000_000),
        metavar="K",
        default=8,
        help="one of K photographs is held out, the middle one (default: 8)",
    )
    options.add_plot(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Rows of every seed, arm and mark, each in the JSON as soon as it is known, and their text; draws the plot."""
    if given.plot is not None:
        check_plot(given.plot)
    torch.set_num_threads(given.thread_count or torch.get_num_threads())
    arms = usual_arms(given.device) if given.arms is None else given.arms.split(",")
    check_arms(arms)
    settings = FitSettings(steps=given.steps or STEPS[given.device], cap_max=given.gaussians or GAUSSIANS[given.device])
    capture = read_capture(given.capture, longest_px=given.longest_px or LONGEST_PX[given.device])
    options.progress(f"{given.capture}: reading {len(capture.names)} photographs")
    photographs = Photographs.load(capture, given.test_every, given.device)
    result: dict[str, Any] = {"protocol": protocol(photographs, settings, arms, given.capture)}
    result |= {"machine": machine(given.device), "rows": []}
    for row in rows(photographs, arms, settings, given.seeds):
        options.progress(fit_report.line(row))
        result["rows"].append(row)
        result["summary"] = fit_report.summary(result["rows"])
        if given.json is not None:
            write_json(result, given.json)
    if given.plot is not None:
        fit_report.plot(result["rows"], result["protocol"], given.plot)
    return result, fit_report.table(result["rows"], result["protocol"])
