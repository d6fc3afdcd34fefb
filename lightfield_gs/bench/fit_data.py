"""The photographs that the fits of a benchmark are made of, and how good what they drew is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.fit.initial import initial_gaussians
from lightfield_gs.fit.settings import FitSettings
from lightfield_gs.fit.views import Views
from lightfield_gs.fit.world import World
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.rasterizer.images import render
from lightfield_gs.reference.metrics import psnr_db, ssim
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
    train: Views
    test: Views
    points: np.ndarray
    colours: np.ndarray
    centres: np.ndarray

    @classmethod
    def load(cls, capture: Capture, test_every: int, device: str) -> Photographs:
        """Those of a capture. Raises InputError."""
        world = World.of(capture.world_to_camera, capture.extent)
        train, test = capture.split(test_every)
        if not test:
            raise InputError(
                f"{capture.folder}: {len(capture.names)} photographs are too few to hold out one of {test_every}; "
                "give a smaller --test-every"
            )
        views = [Views.load(capture, some, world, device, some) for some in (train, test)]
        points, centres = (world.points(places) for places in (capture.points, capture.centres))
        return cls(capture.folder.resolve().name, *views, points, capture.colours, centres)

    def start(self, settings: FitSettings) -> Gaussians:
        """What a fit begins with, on the device."""
        return initial_gaussians(self.points, self.colours, self.centres, settings).to(self.train.photos.device)


@torch.no_grad()
def scores(fit: Fit, views: Views) -> dict[str, float]:
    """Means over views of PSNR in dB and of SSIM, of images clamped to 0..1; by the fit's rasterizer and PSNR by ours.

    What a mask leaves out looks as in the photograph, and does not count in the PSNR.
    """
    scene, found = fit.gaussians(), []
    for place in range(views.count):
        cameras = view_cameras(views, place)
        own, ours = fit.draw(cameras), render(scene, cameras, background=BLACK)
        found.append((*_score(own, views, place), _score(ours, views, place)[0]))
    psnr, structure, by_ours = np.mean(found, 0).tolist()
    return {"psnr_db": psnr, "ssim": structure, "psnr_db_by_ours": by_ours}


def _score(image: Tensor, views: Views, place: int) -> tuple[float, float]:
    width, height = views.sizes[place]
    drawn, photo = (t.movedim(-1, 0)[:, :height, :width] for t in (image[0].clamp(0, 1), views.photos[place] / 255))
    counted = 1.0
    if views.weights is not None:
        weights = views.weights[place, :height, :width] / 255
        drawn, counted = weights * drawn + (1 - weights) * photo, float(weights.mean())
    return float(psnr_db(drawn, photo)) + 10 * float(np.log10(counted)), float(ssim(drawn, photo))


def view_cameras(views: Views, place: int) -> Cameras:
    """The camera of one of them, as large as all."""
    one = slice(place, place + 1)
    focal, centre = views.intrinsics[one].split(2, -1)
    return Cameras(
        views.world_to_camera[one], focal, centre, views.width_px, views.height_px, jacobian_limits=views.limits[one]
    )
