"""How well a scene shows photographs that it was not fitted to: PSNR and SSIM of each, and their means."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.fitting.drawing import view_job
from lightfield_gs.fitting.views import Views
from lightfield_gs.reference.metrics import ssim
from lightfield_gs.scene.gaussians import Gaussians

_PROTOCOL = (
    "PSNR and SSIM of each held-out photograph, then their means: floats of the render, cut to 0..1, against the "
    "photograph / 255; SSIM by 11 x 11 windows of sigma 1.5 with zeros beyond the image; pixels that a mask leaves out "
    "are in no PSNR, and black in both for SSIM"
)
_ALIGNED = (
    "poses were refined in the fit, so those of the held-out photographs were moved to where each fits best, with the "
    "scene as it is, before they were scored"
)
_LEAST_ERROR = 1e-10  # mean squared: equal images have 100 dB


def protocol(aligned: bool) -> str:
    """How scores are made, in words. aligned: whether the views' poses were moved before, see align.aligned."""
    return f"{_PROTOCOL}; {_ALIGNED}" if aligned else _PROTOCOL


@dataclass(frozen=True)
class Scores:
    """Of held-out photographs: names, and for each psnr_db and ssim."""

    names: list[str]
    psnr_db: list[float]
    ssim: list[float]

    @property
    def mean_psnr_db(self) -> float:
        """The mean of the photographs' PSNR, not the PSNR of their mean error."""
        return float(np.mean(self.psnr_db))

    @property
    def mean_ssim(self) -> float:
        return float(np.mean(self.ssim))

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the means, and a row for each photograph."""
        views = [
            {"name": name, "psnr_db": round(psnr, 4), "ssim": round(structure, 5)}
            for name, psnr, structure in zip(self.names, self.psnr_db, self.ssim)
        ]
        return {"psnr_db": round(self.mean_psnr_db, 4), "ssim": round(self.mean_ssim, 5), "views": views}

    def table(self) -> str:
        """A row for each photograph, and one of the means."""
        rows = [*zip(self.names, self.psnr_db, self.ssim), ("mean", self.mean_psnr_db, self.mean_ssim)]
        width = max(len("photograph"), *(len(name) for name, *_ in rows))
        lines = [f"{'photograph':{width}}  PSNR dB   SSIM"]
        return "\n".join(lines + [f"{name:{width}}  {psnr:7.2f}  {value:.4f}" for name, psnr, value in rows])


def evaluated(
    gaussians: Gaussians, views: Views, background: tuple[float, float, float], antialiased: bool = False
) -> Scores:
    """Scores of a scene, in coordinates of the fit, by the protocol(); one photograph after the other."""
    psnr, structure = [], []
    for index in range(views.count):
        image, photo, weights = compared(gaussians, views, index, background, antialiased)
        psnr.append(weighted_psnr_db(image, photo, weights))
        structure.append(weighted_ssim(image, photo, weights))
    return Scores(list(views.names), psnr, structure)


def compared(
    gaussians: Gaussians, views: Views, index: int, background: tuple[float, float, float], antialiased: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """View `index` as it is drawn, cut to 0..1, and its photograph, both [H,W,3] float32 of the photograph's own size,
    over the background too where masks are the target of alpha; and weights [H,W] in 0..1."""
    width, height = size_px = views.sizes[index]
    views.stage(torch.tensor([index]))
    chosen = torch.tensor([index], device=views.device)
    behind = torch.tensor([background], device=views.device)
    job = view_job(gaussians, views, chosen, views.world_to_camera, behind, antialiased, size_px=size_px)
    image = job.draw().image[0, 0]
    photos, weights = views.targets(chosen, behind)
    weight = torch.ones_like(image[..., 0]) if weights is None else weights[0, :height, :width]
    photo = photos[0, :height, :width]
    return image.clamp(0, 1), photo / 255 if photo.dtype == torch.uint8 else photo, weight


def weighted_psnr_db(image: Tensor, photo: Tensor, weights: Tensor) -> float:
    """PSNR in dB of [H,W,3] in 0..1, by the mean of squared errors over pixels, weights [H,W]; 100 at most."""
    errors = (image - photo).double().square().mean(-1)
    total = weights.double().sum().clamp_min(1e-12)
    return float(-10 * ((errors * weights).sum() / total).clamp_min(_LEAST_ERROR).log10())


def weighted_ssim(image: Tensor, photo: Tensor, weights: Tensor) -> float:
    """SSIM of [H,W,3] in 0..1, both black where weights [H,W] are zero."""
    counts = (weights > 0)[..., None].to(image)
    return float(ssim(*(picture.mul(counts).permute(2, 0, 1) for picture in (image, photo))))
