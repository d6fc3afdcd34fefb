"""Pictures of a fit under way: a view, its photograph beside it, and four times their difference."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from lightfield_gs.base.arrays import to_bytes
from lightfield_gs.fitting.evaluate import compared
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.fitting.views import Views
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.images import write_image

_DIFFERENCE = 4.0


def write_pictures(folder: Path, trainer: Trainer, views: Views) -> None:
    """Writes folder/pictures/<step>.png and folder/last.png, of the middle one of `views`."""
    settings = trainer.settings
    gaussians, background = trainer.fields.gaussians(), settings.steady_background
    image, photo, weights = compared(gaussians, views, views.count // 2, background, settings.antialiased)
    pixels = to_bytes(beside(image, photo, weights)).cpu().numpy()
    for path in (make_folder(folder / "pictures") / f"{trainer.done:07d}.png", folder / "last.png"):
        write_image(path, pixels)


def beside(image: Tensor, photo: Tensor, weights: Tensor) -> Tensor:
    """[H,3W,3] in 0..1: image and photo [H,W,3], and their difference x 4 where weights [H,W] let it count."""
    return torch.cat([image, photo, (image - photo).abs() * weights[..., None] * _DIFFERENCE], 1).clamp(0, 1)
