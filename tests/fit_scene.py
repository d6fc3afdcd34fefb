"""A known scene, photographs of it as a fit takes them, and Gaussians to begin with that are not yet right."""

from __future__ import annotations

import math

import torch
from rasterizer_cases import random_scene, turned_pose

import lightfield_gs as lf
from lightfield_gs.fitting.initialization import initialize_gaussians
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.settings import FitSettings

WIDTH, HEIGHT, PHOTOGRAPHS = 48, 32, 6


def known_scene(count: int = 300, degree: int = 0, seed: int = 0) -> lf.Gaussians:
    """`count` opaque Gaussians, float32, in coordinates of a fit: 2 before the cameras of known_cameras."""
    scene = random_scene(count, degree, seed, size=0.05, dtype=torch.float32)
    scene.opacities = 0.5 + 0.5 * scene.opacities
    return scene


def known_cameras(count: int = PHOTOGRAPHS, width: int = WIDTH, height: int = HEIGHT) -> lf.Cameras:
    """Cameras on an arc of 45 degrees about the middle of the scene, up and down by turns, within 1 of the origin."""
    yaws = torch.linspace(-0.4, 0.4, count).tolist()
    poses = torch.stack([torch.from_numpy(turned_pose(yaw, 0.1 * (-1) ** i)) for i, yaw in enumerate(yaws)]).float()
    focal, middle = torch.full((count, 2), 1.2 * width), torch.tensor([[width / 2, height / 2]]).expand(count, 2)
    return lf.Cameras(poses, focal, middle.contiguous(), width, height)


def photograph_scene(scene: lf.Gaussians, cameras: lf.Cameras | None = None, device: str = "cpu") -> PosedImages:
    """Photographs of a scene over black, in 8 bits, with their cameras."""
    cameras = cameras or known_cameras()
    photos = lf.render(scene, cameras, background=(0.0, 0.0, 0.0)).image.clamp(0, 1).mul(255).round().to(torch.uint8)
    names, size = [f"{i:02d}.png" for i in range(cameras.count)], (cameras.width_px, cameras.height_px)
    tensors = (t.contiguous().to(device) for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits()))
    return PosedImages(names, photos.to(device), None, *tensors, [size] * cameras.count)


def first_state(scene: lf.Gaussians, settings: FitSettings, points: int = 150, device: str = "cpu") -> GaussianState:
    """Return the first state of a fit: small grey Gaussians near some of the scene's."""
    shift = 0.02 * torch.randn(points, 3, generator=torch.Generator().manual_seed(1))
    places = (scene.means[:points] + shift).double().numpy()
    grey = (127 * torch.ones(points, 3, dtype=torch.uint8)).numpy()
    centres = torch.linalg.inv(known_cameras().world_to_camera.double())[:, :3, 3].numpy()
    return GaussianState.start(initialize_gaussians(places, grey, centres, settings).to(device))


def psnr_db(state: GaussianState, images: PosedImages) -> float:
    """Of all images together, as the state is now."""
    image = lf.render(state.gaussians(), images.cameras(), background=(0.0, 0.0, 0.0)).image.clamp(0, 1)
    return -10 * math.log10(float((image - images.photos / 255).square().mean()))
