"""Training batches: the images of a plan, cut out of the resident views and resized on their device."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from training.data.fusing import fused
from training.data.photographs import photographed
from training.data.plan import BatchPlan
from training.data.resident import ResidentViews
from training.data.transfer import on_device


@dataclass
class Batch:
    """B examples of V views each; view 0 is the source view itself.

    Attributes:
        source: [B,4,S,S] premultiplied RGBA, 0..1.
        source_intrinsics: [B,4] (fx, fy, cx, cy) in pixels.
        targets: [B,V,4,T,T].
        intrinsics: [B,V,4].
        world_to_camera: [B,V,4,4], the world being the source camera's axes.
        backgrounds: [B,V,3], plain colours 0..1.
    """

    source: Tensor
    source_intrinsics: Tensor
    targets: Tensor
    intrinsics: Tensor
    world_to_camera: Tensor
    backgrounds: Tensor


def make_batch(plan: BatchPlan, views: ResidentViews, compiled: bool = False) -> Batch:
    """Return the batch of a plan, on the device of the views: stored views, then procedural objects, then meshes.

    The host waits only where a block of procedural objects begins (see training/data/procedural.py), and for meshes.

    Args:
        compiled: Use a few kernels that torch.compile makes for these sizes, in place of hundreds of operations.
    """
    plan = on_device(plan, views.device)
    made: list[tuple[Tensor, ...]] = []
    if len(plan.rectangles):
        # Other parts of the plan must not be compiled for
        stored = dataclasses.replace(plan, procedural=None, meshes=None, photo=None)
        made.append((*fused(_stored_pictures, compiled)(stored, views), plan.world_to_camera, plan.backgrounds))
    if plan.procedural is not None:
        made.append(plan.procedural.drawn(views.device, compiled))
    if plan.meshes is not None:
        made.append(plan.meshes.drawn(compiled))
    batch = Batch(*(torch.cat(fields) if len(made) > 1 else fields[0] for fields in zip(*made)))
    if plan.photo is not None:
        batch.source = fused(photographed, compiled)(batch.source, plan.photo)
    return batch


def _stored_pictures(plan: BatchPlan, views: ResidentViews) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Input pictures [B,4,S,S] and their intrinsics [B,4], targets [B,V,4,T,T] and theirs [B,V,4], as in Batch."""
    source = _images(plan, views, slice(0, 1), plan.source_px)[:, 0]
    targets = _images(plan, views, slice(1, None), plan.target_px)
    return source, plan.intrinsics[:, 0], targets, plan.intrinsics[:, 1:]


def _images(plan: BatchPlan, views: ResidentViews, chosen: slice, size: int) -> Tensor:
    """The chosen images of every example, [B,I,4,size,size]."""
    rectangles = plan.rectangles[:, chosen]
    windows = views.windows(rectangles.flatten(0, 1), *plan.window_px).float()
    across, down = (_resizing(plan, chosen, size, axis).flatten(0, 1) for axis in (0, 1))
    images = _resized(windows, across, down).unflatten(0, rectangles.shape[:2]).div_(255).clamp_(0, 1)
    return _recoloured(images, plan)


def _resizing(plan: BatchPlan, chosen: slice, size: int, axis: int) -> Tensor:
    """Return the weights [B,I,S,P] of a window's P pixels in the S pixels of a crop, along x (0) or y (1).

    The filter is a triangle, as wide as the pixels of the crop or of the window, whichever are wider. As in
    crop_resize, its weights add up to 1 over all pixels of the crop, also those beyond the window or the frame.
    """
    device, crops = plan.crops.device, plan.crops[:, chosen]
    start, side = crops[..., axis, None], crops[..., 2, None]
    centres = start + side / size * (torch.arange(size, device=device) + 0.5)
    reach = (side / size).clamp_min(1)

    def triangle(pixels: Tensor) -> Tensor:
        inside = (pixels >= start[..., None]) & (pixels < (start + side)[..., None])
        return inside * (1 - (pixels + 0.5 - centres[..., None]).abs() / reach[..., None]).clamp_min(0)

    taps = torch.arange(plan.taps, device=device)
    total = triangle((centres - reach).floor()[..., None] + taps).sum(-1, keepdim=True)
    steps = torch.arange(plan.window_px[1 - axis], device=device)
    steps = steps * plan.directions[:, None, None] if axis == 0 else steps
    return triangle((plan.origins[:, chosen, axis, None] + steps)[..., None, :]) / total


def _resized(windows: Tensor, across: Tensor, down: Tensor) -> Tensor:
    """Windows [N,H,W,4] under the weights of columns [N,S,W] and of rows [N,S,H]: [N,4,S,S], float32."""
    count, height, width, channels = windows.shape
    size = across.shape[1]
    rows = down @ windows.view(count, height, width * channels)
    turned = rows.view(count, size, width, channels).transpose(1, 2).reshape(count, width, size * channels)
    return (across @ turned).view(count, size, size, channels).permute(0, 3, 2, 1).contiguous()


def _recoloured(images: Tensor, plan: BatchPlan) -> Tensor:
    """Permutes the channels of some examples' colours and bends them by gain * colour^gamma; images: [B,I,4,S,S]."""
    colour, alpha = images[:, :, :3], images[:, :, 3:]
    gain, gamma = plan.gains[:, None, :, None, None], plan.gammas[:, None, None, None, None]
    order = plan.permutations[:, None, :, None, None].expand_as(colour)
    straight = (colour / alpha.clamp_min(1e-3)).clamp(0, 1).gather(2, order)
    bent = (gain * straight.pow(gamma)).clamp(0, 1) * alpha
    chosen = plan.recoloured[:, None, None, None, None]
    return torch.cat([torch.where(chosen, bent, colour), alpha], dim=2)
