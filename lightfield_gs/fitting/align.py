"""Poses of held-out photographs, refined before they are scored, where those of the others were refined in the fit.

A fit that moves its cameras moves the scene a little with them, and a held-out camera that has not moved is then
compared from the wrong place. So it is moved until its photograph fits best, with the scene as it is: that says how
good the scene is, not how good its pose was, and a score has to say that it was done.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lightfield_gs.fitting.drawing import view_job
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.poses import Poses
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.views import Views
from lightfield_gs.rasterizer.image_render import ImageBuffers
from lightfield_gs.rasterizer.scene import GradientRequest
from lightfield_gs.scene.gaussians import Gaussians

STEPS, RATE = 100, 1e-3  # of each camera; the rate at the start, extents and radians a step


def aligned(views: Views, gaussians: Gaussians, settings: FitSettings, steps: int = STEPS, rate: float = RATE) -> Views:
    """The views with the poses, of those on the way, at which the loss is least; the scene is left alone.

    views, gaussians: in coordinates of the fit, on one device. steps: of Adam for each view.
    """
    poses = [_aligned_pose(views, gaussians, settings, index, steps, rate) for index in range(views.count)]
    return replace(views, world_to_camera=torch.cat(poses))


def _aligned_pose(
    views: Views, gaussians: Gaussians, settings: FitSettings, index: int, steps: int, rate: float
) -> Tensor:
    """[1,4,4], that of one view."""
    device = views.device
    views.stage(torch.tensor([index]))
    chosen = torch.tensor([index], device=device)
    background = torch.tensor([settings.steady_background], device=device)
    photos, weights = views.targets(chosen, background)
    poses = Poses(views.world_to_camera[index : index + 1], steps, rate, keeps_mean=False)
    best, least = poses.world_to_camera.clone(), torch.full((), torch.inf, device=device)
    first, kept = torch.zeros(1, dtype=torch.int64, device=device), torch.ones(1, dtype=torch.int64, device=device)
    for step in range(steps):
        everywhere = poses.world_to_camera.expand(views.count, 4, 4)
        job = view_job(gaussians, views, chosen, everywhere, background, settings.antialiased)
        images = job.draw()
        loss, g_image = photo_loss_and_gradient(images.image[0], photos, weights, settings.ssim_lambda)
        better = loss < least
        best, least = torch.where(better, poses.world_to_camera, best), torch.where(better, loss, least)
        gradients = job.backward(images, ImageBuffers(g_image[None], None, None), GradientRequest(cameras=True))
        poses.update(poses.gathered(gradients.cameras, first), first + step, kept)
    return best
