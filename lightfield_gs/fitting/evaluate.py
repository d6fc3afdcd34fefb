"""Scores of a scene by held-out photographs: PSNR and SSIM of each, their means, and means by angle in a cone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.image_optimizers import PoseOptimizer
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.rasterizer.image_render import ImageBuffers
from lightfield_gs.rasterizer.workspace import GradientRequest
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
_MATCHED = (
    "exposures were fitted, and no fit knows those of held-out photographs, so each render was scored after the affine "
    "change of its colours that suits its photograph best"
)
_LEAST_ERROR = 1e-10  # mean squared: equal images have 100 dB
_ALIGN_STEPS, _ALIGN_LR = 100, 1e-3  # of each camera; the learning rate at the start, extents and radians
# Edges of the rows by angle, degrees: fine where panels are, coarse beyond
EDGES_DEG = (0, 5, 10, 15, 20, 25, 30, 45, 90, 180)


def describe_protocol(settings: FitSettings) -> str:
    """Return in words how the scores of a fit are made."""
    changes = [words for words, is_made in ((_ALIGNED, settings.poses), (_MATCHED, settings.exposure)) if is_made]
    return "; ".join([_PROTOCOL, *changes])


@dataclass(frozen=True)
class Scores:
    """Scores of held-out photographs.

    Attributes:
        names: [T], of the photographs.
        psnr_db: [T].
        ssim: [T].
    """

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
        """Return the means and a row for each photograph, for JSON."""
        rows = [
            {"name": name, "psnr_db": round(psnr, 4), "ssim": round(structure, 5)}
            for name, psnr, structure in zip(self.names, self.psnr_db, self.ssim)
        ]
        return {"psnr_db": round(self.mean_psnr_db, 4), "ssim": round(self.mean_ssim, 5), "views": rows}

    def table(self) -> str:
        """Return a text with a row for each photograph and a row of the means."""
        rows = [*zip(self.names, self.psnr_db, self.ssim), ("mean", self.mean_psnr_db, self.mean_ssim)]
        width = max(len("photograph"), *(len(name) for name, *_ in rows))
        lines = [f"{'photograph':{width}}  PSNR dB   SSIM"]
        return "\n".join(lines + [f"{name:{width}}  {psnr:7.2f}  {value:.4f}" for name, psnr, value in rows])


def evaluate(
    gaussians: Gaussians,
    images: PosedImages,
    background: tuple[float, float, float],
    antialiased: bool = False,
    matched: bool = False,
) -> Scores:
    """Score a scene by photographs, one after the other.

    Args:
        gaussians: the scene, normalised coordinates.
        images: the photographs.
        background: red, green and blue in 0..1.
        antialiased: the scene's render mode.
        matched: match the colours of each render to its photograph first, see match_colours.
    """
    psnr, structure = [], []
    for index in range(images.count):
        image, photo, weights = render_and_photo(gaussians, images, index, background, antialiased)
        image = match_colours(image, photo, weights) if matched else image
        psnr.append(weighted_psnr_db(image, photo, weights))
        structure.append(weighted_ssim(image, photo, weights))
    return Scores(list(images.names), psnr, structure)


def render_and_photo(
    gaussians: Gaussians,
    images: PosedImages,
    index: int,
    background: tuple[float, float, float],
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw a scene from the camera of one photograph.

    Returns:
        The render, clamped to 0..1, and the photograph, both [H,W,3] float32 at the photograph's own size. The
        photograph is over the background too where masks are the target of alpha. Weights [H,W] in 0..1.
    """
    width, height = size_px = images.sizes[index]
    images.stage(torch.arange(index, images.count)[:, None])
    chosen = torch.tensor([index], device=images.device)
    behind = torch.tensor([background], device=images.device)
    job = images.render_job(gaussians, chosen, images.world_to_camera, behind, antialiased, size_px=size_px)
    image = job.draw().image[0, 0]
    photos, weights = images.targets(chosen, behind)
    weight = torch.ones_like(image[..., 0]) if weights is None else weights[0, :height, :width]
    photo = photos[0, :height, :width]
    return image.clamp(0, 1), photo / 255 if photo.dtype == torch.uint8 else photo, weight


def weighted_psnr_db(image: Tensor, photo: Tensor, weights: Tensor) -> float:
    """Return the PSNR in dB of [H,W,3] in 0..1, by the weighted mean of squared errors; weights [H,W]; 100 at most."""
    errors = (image - photo).double().square().mean(-1)
    total = weights.double().sum().clamp_min(1e-12)
    return float(-10 * ((errors * weights).sum() / total).clamp_min(_LEAST_ERROR).log10())


def match_colours(image: Tensor, photo: Tensor, weights: Tensor) -> Tensor:
    """Return an image with the affine change of colours that brings it closest to a photograph, by least squares.

    A camera that chooses exposure and white balance by itself chose others for each held-out photograph, and no fit
    can know them. PSNR after this change rates the scene alone, as gsplat's `cc_psnr` does.

    Args:
        image: [H,W,3] in 0..1.
        photo: [H,W,3] in 0..1.
        weights: [H,W] in 0..1.

    Returns:
        [H,W,3] in 0..1.
    """
    colours = torch.cat([image, torch.ones_like(image[..., :1])], -1).double().flatten(0, 1)
    weighted = colours * weights.double().flatten()[:, None]
    # A small ridge towards no change keeps images of one colour from giving any change at all
    ridge = 1e-6 * weights.double().sum().clamp_min(1) * torch.eye(4, dtype=torch.float64, device=image.device)
    none = torch.eye(4, 3, dtype=torch.float64, device=image.device)
    change = torch.linalg.solve(weighted.T @ colours + ridge, weighted.T @ photo.double().flatten(0, 1) + ridge @ none)
    return (colours @ change).clamp(0, 1).view_as(image).to(image)


def weighted_ssim(image: Tensor, photo: Tensor, weights: Tensor) -> float:
    """Return the SSIM of [H,W,3] in 0..1, both black where weights [H,W] are zero."""
    counts = (weights > 0)[..., None].to(image)
    return float(ssim(*(picture.mul(counts).permute(2, 0, 1) for picture in (image, photo))))


# --- Poses of held-out photographs


def align_poses(
    images: PosedImages, gaussians: Gaussians, settings: FitSettings, steps: int = _ALIGN_STEPS, rate: float = _ALIGN_LR
) -> PosedImages:
    """Return photographs with the poses at which each fits a scene best.

    A fit that moves its cameras moves the scene a little with them. A held-out camera that has not moved then compares
    the scene from the wrong place. Aligned scores rate the scene, and not the poses: they have to be marked as such.

    Args:
        images: the photographs, on the device of the scene.
        gaussians: the scene, normalised coordinates; it stays as it is.
        settings: of the fit.
        steps: of Adam for each photograph.
        rate: learning rate at the start, extents and radians.
    """
    poses = [_align_pose(images, gaussians, settings, index, steps, rate) for index in range(images.count)]
    return replace(images, world_to_camera=torch.cat(poses))


def _align_pose(
    images: PosedImages, gaussians: Gaussians, settings: FitSettings, index: int, steps: int, rate: float
) -> Tensor:
    """Return [1,4,4], the pose with the least loss on the way."""
    device = images.device
    images.stage(torch.arange(index, images.count)[:, None])
    chosen = torch.tensor([index], device=device)
    background = torch.tensor([settings.steady_background], device=device)
    photos, weights = images.targets(chosen, background)
    poses = PoseOptimizer(images.world_to_camera[index : index + 1], steps, rate, keeps_mean=False)
    best, least = poses.world_to_camera.clone(), torch.full((), torch.inf, device=device)
    first, kept = torch.zeros(1, dtype=torch.int64, device=device), torch.ones(1, dtype=torch.int64, device=device)
    for step in range(steps):
        everywhere = poses.world_to_camera.expand(images.count, -1, -1)
        job = images.render_job(gaussians, chosen, everywhere, background, settings.antialiased)
        rendered = job.draw()
        loss, g_image = photo_loss_and_gradient(rendered.image[0], photos, weights, settings.ssim_lambda)
        better = loss < least
        best, least = torch.where(better, poses.world_to_camera, best), torch.where(better, loss, least)
        gradients = job.backward(rendered, ImageBuffers(g_image[None], None, None), GradientRequest(cameras=True))
        poses.update(poses.sum_gradients(gradients.cameras, first), first + step, kept)
    return best


# --- Scores by angle


@dataclass(frozen=True)
class ConeAngles:
    """Angles of held-out photographs in a cone.

    Attributes:
        centre: name of the photograph in the middle of the cone.
        cone_deg: full angle of the cone.
        angles_deg: [T], 0..180, from the centre photograph, seen from the cone's pivot.
    """

    centre: str
    cone_deg: float
    angles_deg: list[float]

    def to_dict(self, scores: Scores) -> dict[str, Any]:
        """Return scores by angle and the angle of each photograph, for JSON."""
        angles = {name: round(angle, 3) for name, angle in zip(scores.names, self.angles_deg)}
        return {"centre": self.centre, "cone_deg": self.cone_deg, "rows": self.rows(scores), "angles_deg": angles}

    def rows(self, scores: Scores) -> list[dict[str, float | str]]:
        """Return the rows of scores_by_angle."""
        return scores_by_angle(self.angles_deg, scores.psnr_db, scores.ssim, self.cone_deg)

    def table(self, scores: Scores) -> str:
        """Return a text with a row for each range of angles that has photographs."""
        head = f"{'views':<16} {'photographs':>11} {'PSNR dB':>8} {'SSIM':>7}"
        rows = (
            f"{row['views']:<16} {row['photographs']:>11} {row['psnr_db']:>8.2f} {row['ssim']:>7.4f}"
            for row in self.rows(scores)
        )
        return "\n".join([head, *rows])


def scores_by_angle(
    angles_deg: Sequence[float] | np.ndarray,
    psnr_db: Sequence[float] | np.ndarray,
    ssim: Sequence[float] | np.ndarray,
    cone_deg: float,
) -> list[dict[str, float | str]]:
    """Return mean scores of photographs by their angle from the centre of a cone.

    Means of decibels are not decibels of means.

    Args:
        angles_deg: [T], 0..180.
        psnr_db: [T].
        ssim: [T].
        cone_deg: full angle of the cone.

    Returns:
        Rows of views, photographs, psnr_db and ssim, for JSON: "inside the cone" (up to half of it), "outside", and
        each range of EDGES_DEG, "5-10 degrees". Rows without photographs are left out.

    Raises:
        InputError: the lengths differ.
    """
    angles, psnr, similar = (np.asarray(values, np.float64) for values in (angles_deg, psnr_db, ssim))
    if not angles.shape == psnr.shape == similar.shape or angles.ndim != 1:
        raise InputError(f"expected scores of {angles.shape} photographs, got {psnr.shape} and {similar.shape}")
    inside = angles <= cone_deg / 2
    parts = [("inside the cone", inside), ("outside", ~inside)]
    for low, high in zip(EDGES_DEG, EDGES_DEG[1:]):
        last = high == EDGES_DEG[-1]
        parts.append((f"{low}-{high} degrees", (angles >= low) & ((angles < high) | last)))
    rows: list[dict[str, float | str]] = []
    for name, chosen in parts:
        if chosen.any():
            means = {"psnr_db": float(psnr[chosen].mean()), "ssim": float(similar[chosen].mean())}
            rows.append({"views": name, "photographs": int(chosen.sum()), **means})
    return rows
