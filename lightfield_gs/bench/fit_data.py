"""The photographs that the fits of a benchmark are made of, and how good what they drew is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.evaluate import render_and_photo, weighted_psnr_db, weighted_ssim
from lightfield_gs.fitting.initialization import initialize_gaussians
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

BLACK = (0.0, 0.0, 0.0)


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
    """A capture on its device, in coordinates of the fit: views to fit to, those held out, and where points [P,3] of
    colours [P,3] uint8 and the centres of all cameras [C,3] are."""

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
                "give a smaller --test-every"
            )
        fitted, held = (PosedImages.load(capture, some, normalization, device, some) for some in (train, test))
        points, centres = (normalization.points(places) for places in (capture.points, capture.centres))
        return cls(capture.folder.resolve().name, fitted, held, points, capture.colours, centres)

    def start(self, settings: FitSettings) -> Gaussians:
        """What a fit begins with, on the device."""
        return initialize_gaussians(self.points, self.colours, self.centres, settings).to(self.train.device)


@torch.no_grad()
def scores(fit: Fit, images: PosedImages) -> dict[str, float]:
    """Means over views of PSNR in dB and SSIM by the protocol of fitting/evaluate.py, drawn by the fit's own
    rasterizer; and of the PSNR of the same scene drawn by ours."""
    scene, found = fit.gaussians(), []
    for place, (width, height) in enumerate(images.sizes):
        by_ours, photo, weights = render_and_photo(scene, images, place, BLACK)
        image = fit.draw(images.cameras(place))[0, :height, :width].clamp(0, 1)
        psnr, psnr_by_ours = (weighted_psnr_db(picture, photo, weights) for picture in (image, by_ours))
        found.append((psnr, weighted_ssim(image, photo, weights), psnr_by_ours))
    return dict(zip(("psnr_db", "ssim", "psnr_db_by_ours"), np.mean(found, 0).tolist()))
