"""What a training step draws and compares: the network's own Gaussians at some sizes, and with the sheet of detail."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor

from lightfield_gs import Gaussians
from lightfield_gs.models.crop import resized
from lightfield_gs.models.detail import DetailLevel
from training.config import Stage, TrainingConfig
from training.data.batches import Batch
from training.losses import LossWeights
from training.rendering import render_views


@dataclass(frozen=True)
class Drawing:
    """Gaussians that are drawn as the targets see them.

    Attributes:
        gaussians: With leading B.
        reduced: The targets are so many times smaller than those of the batch.
        weights: Of the terms of the loss.
        share: Factor on the loss.
        name: Text before the names of its terms.
    """

    gaussians: Gaussians
    reduced: int
    weights: LossWeights
    share: float
    name: str


def seen_by_network(batch: Batch, stage: Stage) -> tuple[Tensor, Tensor]:
    """Return the pictures [B,4,S,S] that the network sees, and their intrinsics [B,4].

    Where the batch has finer ones for the sheet, they are reduced as crop_resize reduces a photo.
    """
    if stage.detail <= 1:
        return batch.source, batch.source_intrinsics
    size = batch.source.shape[-1] // stage.detail
    return resized(batch.source, (size, size)), batch.source_intrinsics / stage.detail


def drawings(
    compose: Callable[..., Gaussians],
    cloud: Gaussians,
    seen: tuple[Tensor, Tensor],
    batch: Batch,
    stage: Stage,
    config: TrainingConfig,
) -> list[Drawing]:
    """Return what a step draws.

    Args:
        compose: SplatterNet.composed, or what torch.compile makes of it.
        cloud: Of the network, from the pictures and intrinsics `seen`.
    """
    alone = [Drawing(cloud, scale, config.loss, 1 / len(stage.scales), "") for scale in stage.scales]
    if not stage.detail:
        return alone
    zoom = stage.target_zoom or config.augmentation.target_zoom
    # Texels are as wide as where a target is magnified most, so that the sheet closes in all
    level = DetailLevel(stage.detail, batch.targets.shape[-1] / (batch.source.shape[-1] * zoom[0]))
    composed = compose(cloud, *seen, batch.source, level)
    return [*alone, Drawing(composed, 1, config.composite, 1.0, "composite_")]


def draw(drawing: Drawing, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Return images [B,V,3,T,T] over the backgrounds, opacities [B,V,T,T], and the targets [B,V,4,T,T] of that size."""
    targets, intrinsics = batch.targets, batch.intrinsics
    if drawing.reduced > 1:
        targets = F.avg_pool2d(targets.flatten(0, 1), drawing.reduced).unflatten(0, targets.shape[:2])
        intrinsics = intrinsics / drawing.reduced
    size = targets.shape[-1]
    images, alpha = render_views(drawing.gaussians, batch.world_to_camera, intrinsics, size, size, batch.backgrounds)
    return images, alpha, targets
