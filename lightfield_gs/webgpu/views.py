"""Ordinary images by WebGPU: a light field of one view is the image of its camera."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.lenticular_camera import Aperture, Lens, LenticularCamera
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.webgpu.devices import draw_direct
from lightfield_gs.webgpu.resident import Kept


def draw_views(
    device: str, gaussians: Gaussians, cameras: Cameras, background: Tensor, antialiased: bool, aperture: Aperture
) -> Tensor:
    """Return the images [K, H, W, 3] float32 of K cameras, on the CPU.

    Args:
        device: webgpu or webgpu:N.
        gaussians: One scene, on the CPU in float32.
        cameras: [K].
        background: [3].
        antialiased: See encoding.encode.
        aperture: Of each camera.

    Raises:
        InputError: As in draw_direct.
    """
    width, height = cast(int, cameras.width_px), cast(int, cameras.height_px)
    out, kept = torch.empty(cameras.count, height, width, 3), Kept.new()
    lens = Lens(width, height, 1, (0, 0, 0), 1.0, 0.0, 0.0, bgr=False, continuous=False)
    rows = zip(*(t.double().tolist() for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())))
    for image, (pose, intrinsics, limits) in zip(out, rows):
        numbers = tuple(number for row in pose for number in row), tuple(intrinsics), tuple(limits)
        camera = LenticularCamera(*numbers, aperture.zero_depth, lens, aperture.deviation)
        job = DirectRender(gaussians.fields().values(), background, camera, antialiased)
        draw_direct(device, job, out=image, kept=kept)
    return out
