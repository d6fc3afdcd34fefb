"""Pruning of a fitted scene for its panel, and scores of the rest.

All views of a panel look through one window, the part of the zero plane that it shows. A photograph also looks past the
window, at Gaussians that no view shows and pruning removes. So scores count a pixel only if its ray goes through the
window from the side of the panel's cameras. A photograph from a place of these cameras then shows exactly the panel's
view. A photograph from above, below or nearer also sees parts outside the views; gaps there count against the pruned
scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import real_number
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.base.options import CameraModel
from lightfield_gs.fitting.cone import Display
from lightfield_gs.fitting.evaluate import Scores
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.fitting.run import Run
from lightfield_gs.rasterizer.image_render import ImageBuffers
from lightfield_gs.rasterizer.workspace import GradientRequest
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.simplification.pruning import contributions, left_out

# The mean error of colours 0..1 by pruning, 1/39 of a step of 8 bits. `prune` allows three times as much; here nobody
# asked for a smaller scene.
CONTRIBUTION_CUT = 1e-4
# Gaussians nearer to the panel's cameras than this fraction of the zero plane's distance float before the eyes. At a
# fourth of it two eyes at the ends of a cone of 40 degrees see a point 2.2 zero-plane distances apart.
NEAR_FRACTION = 0.25
_SEEN_PX = 1.0  # the least weight, in pixels of all photographs together, of a Gaussian that photographs show
PROTOCOL = (
    "of held-out photographs inside the panel's cone, those pixels alone whose rays go through the panel's frame in "
    "its zero plane; the others are as if a mask left them out"
)


@dataclass(frozen=True)
class PanelPruning:
    """The result of pruning a scene for a panel.

    Attributes:
        kept: [N] bool, the Gaussians that are left.
        unseen: number of Gaussians that contribute nothing to the panel.
        faint: number of others that the contribution cut removes.
        floating: number of the rest that float before the eyes.
        unfounded: number of floating Gaussians that no photograph shows; these are removed too.
        contribution: contribution of the removed Gaussians, as a fraction 0..1 of the light of an opaque image. The
            mean error of colours 0..1 is at most this plus 1e-4, the transmittance at which samples end.
    """

    kept: Tensor
    unseen: int
    faint: int
    floating: int
    unfounded: int
    contribution: float

    @property
    def count(self) -> int:
        """The number of Gaussians that are left."""
        return int(self.kept.sum())

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, for JSON."""
        counts = {name: getattr(self, name) for name in ("unseen", "faint", "floating", "unfounded")}
        return {"gaussians": self.count, **counts, "share": self.contribution}

    def messages(self) -> list[str]:
        """Return lines about the result."""
        error = self.contribution + 1e-4
        return [
            f"cone: {self.count} of {len(self.kept)} Gaussians are left: {self.unseen} show in no view of the panel, "
            f"{self.faint} hardly; without them colours of 0..1 differ by {error:.1e} at most in the mean",
            f"cone: {self.floating} Gaussians float nearer to the eyes than {NEAR_FRACTION:g} of the zero plane's "
            f"distance; {self.unfounded} of them show in no photograph and went too",
        ]


@dataclass(frozen=True)
class WindowScores:
    """Scores by the pixels of held-out photographs inside the cone that the panel can show, see PROTOCOL.

    Attributes:
        whole: of all Gaussians.
        pruned: of the Gaussians that are left.
        coverage: fraction 0..1 of the photographs' pixels that count.
    """

    whole: Scores
    pruned: Scores
    coverage: float


def prune_run(
    run: Run, normalization: Normalization, display: Display, contribution_cut: float
) -> tuple[Gaussians, PanelPruning, WindowScores | None]:
    """Prune the scene of a run for its display, and add scores before and after to scores.json.

    Args:
        run: a finished run.
        normalization: the coordinates of the fit.
        display: the panel.
        contribution_cut: 0..1, see prune_for_panel.

    Returns:
        The pruned scene in normalised coordinates, the result, and scores; None where no held-out photograph shows the
        panel's window.

    Raises:
        InputError: see prune_for_panel.
    """
    trainer = run.trainer
    gaussians, settings = trainer.state.gaussians().detach(), trainer.settings
    pruning = prune_for_panel(gaussians, normalization, display, trainer.images, contribution_cut, settings.antialiased)
    for line in pruning.messages():
        run.say(line)
    left = gaussians[pruning.kept]
    scores = _score_window(run, PanelWindow.locate(display, normalization), display, gaussians, left)
    if scores is None:
        run.write_scores(pruned=pruning.to_dict())
    else:
        frame = {"protocol": PROTOCOL, "share": round(scores.coverage, 4), **scores.whole.to_dict()}
        run.write_scores(frame=frame, pruned={**pruning.to_dict(), **scores.pruned.to_dict()})
    return left, pruning, scores


def prune_for_panel(
    gaussians: Gaussians,
    normalization: Normalization,
    display: Display,
    images: PosedImages,
    contribution_cut: float = CONTRIBUTION_CUT,
    antialiased: bool = False,
) -> PanelPruning:
    """Find the Gaussians that a panel needs.

    Three kinds are removed:

    - Gaussians that contribute nothing to the panel's image;
    - Gaussians that contribute least, within contribution_cut (encoding.prune has the proof);
    - Gaussians that float before the eyes, with less than a pixel's weight in all photographs together.

    It takes time and memory like a training step on one image of the panel. If something floats, it also takes a step
    on every photograph.

    Args:
        gaussians: [N] float32, normalised coordinates.
        normalization: the coordinates of the fit.
        display: the panel.
        images: the training photographs.
        contribution_cut: the mean error of colours 0..1 that is allowed, 0..1.
        antialiased: the scene's render mode.

    Raises:
        InputError: contribution_cut is outside 0..1.
    """
    contribution_cut = real_number("contribution_cut", contribution_cut, 0.0, 1.0)
    restored = normalization.restore(gaussians)
    rig = display.rig.relative_to(restored.origin)
    weights = contributions(restored, display.panel, rig, antialiased)
    cut = left_out(weights, display.panel, contribution_cut)
    floating = ~cut & (_rig_depths(restored, rig.world_to_camera) < NEAR_FRACTION * rig.zero_depth)
    unfounded = torch.zeros_like(floating)
    if bool(floating.any()):
        unfounded = floating & (photo_visibility(gaussians, images, antialiased) < _SEEN_PX)
    unseen = weights == 0
    gone = cut | unfounded
    if bool(gone.all()):
        assume("cone: nothing of the scene shows on the panel, so that nothing is left out of it")
        gone = torch.zeros_like(gone)
    whole = 3 * display.panel.width_px * display.panel.height_px
    parts = {"unseen": unseen, "faint": cut & ~unseen, "floating": floating, "unfounded": unfounded}
    counts = {name: int(part.sum()) for name, part in parts.items()}
    return PanelPruning(~gone, contribution=float(weights[gone].sum()) / whole, **counts)


def photo_visibility(gaussians: Gaussians, images: PosedImages, antialiased: bool = False) -> Tensor:
    """Return [N] float64, the weight of each Gaussian over all pixels of all photographs that count.

    The weight is alpha times the transmittance before it.

    Args:
        gaussians: [N], normalised coordinates.
        images: the photographs.
        antialiased: the scene's render mode.
    """
    total = gaussians.means.new_zeros(gaussians.count, dtype=torch.float64)
    # With one harmonic, the derivative of an image by it is the weight, whatever the colours are
    grey = replace(gaussians, sh=torch.zeros_like(gaussians.sh[:, :1]))
    black = gaussians.means.new_zeros(1, 3)
    for index in range(images.count):
        chosen = torch.tensor([index], device=gaussians.means.device)
        job = images.render_job(grey, chosen, images.world_to_camera, black, antialiased)
        rendered = job.draw()
        counts = images.pixel_weights(index)[None, None, ..., None].expand_as(rendered.image)
        gradients = job.backward(
            rendered, ImageBuffers(counts.contiguous(), None, None), GradientRequest(cameras=False)
        )
        total += gradients.fields[-1][0].double().sum((1, 2)) / SH_CONSTANT / 3
    return total


def _rig_depths(gaussians: Gaussians, pose: np.ndarray) -> Tensor:
    """Return [N] float64, depths in all cameras of a rig, which stand on one line across its axis."""
    row = torch.from_numpy(pose[2]).to(gaussians.means.device)
    return gaussians.means.double() @ row[:3] + row[3]


# --- Scores in the panel's window


@dataclass(frozen=True)
class PanelWindow:
    """The panel's window in the scene, normalised coordinates.

    Attributes:
        pose: [4,4] float64, of the rig's centre camera.
        depth: of the zero plane in it.
        low: (x, y) of a corner at depth 1.
        high: (x, y) of the opposite corner at depth 1.
    """

    pose: np.ndarray
    depth: float
    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def locate(cls, display: Display, normalization: Normalization) -> PanelWindow:
        """Return the window of a display's rig at the panel's resolution."""
        rig, panel = display.rig, display.panel
        (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
        (pose,) = normalization.poses(rig.world_to_camera[None])
        low, high = (-cx / fx, -cy / fy), ((panel.width_px - cx) / fx, (panel.height_px - cy) / fy)
        return cls(pose, rig.zero_depth / normalization.extent, low, high)

    def mask(
        self, world_to_camera: Tensor, intrinsics: Tensor, width_px: int, height_px: int, model: CameraModel = "pinhole"
    ) -> Tensor:
        """Return [H,W] bool, the pixels of a photograph whose rays go through the window.

        Args:
            world_to_camera: [4,4], normalised coordinates.
            intrinsics: [4], fx, fy, cx, cy.
            width_px: W.
            height_px: H.
            model: of the camera; a fisheye is an equidistant one.
        """
        device = world_to_camera.device
        to_rig = torch.from_numpy(self.pose).to(device) @ torch.linalg.inv(world_to_camera.double())
        fx, fy, cx, cy = intrinsics.double()
        x = (torch.arange(width_px, dtype=torch.float64, device=device) + 0.5 - cx) / fx
        y = (torch.arange(height_px, dtype=torch.float64, device=device) + 0.5 - cy) / fy
        y, x = torch.meshgrid(y, x, indexing="ij")
        rays = torch.stack(_direction(x, y, model), -1)
        rays, origin = rays @ to_rig[:3, :3].T, to_rig[:3, 3]
        steps = (self.depth - origin[2]) / rays[..., 2]
        met = (origin[:2] + steps[..., None] * rays[..., :2]) / self.depth
        low, high = (torch.tensor(corner, dtype=torch.float64, device=device) for corner in (self.low, self.high))
        return ((met >= low) & (met <= high)).all(-1) & (steps > 0) & (rays[..., 2] > 0)


def _direction(x: Tensor, y: Tensor, model: CameraModel) -> tuple[Tensor, Tensor, Tensor]:
    """Return x, y and z of the rays through places of an image, in focal lengths from the principal point."""
    if model == "fisheye":
        angle = torch.hypot(x, y)
        radius = torch.sinc(angle / torch.pi)
        return x * radius, y * radius, torch.cos(angle)
    if model == "equirectangular":
        return torch.sin(x) * torch.cos(y), torch.sin(y), torch.cos(x) * torch.cos(y)
    return x, y, torch.ones_like(x)


def mask_to_window(
    images: PosedImages, window: PanelWindow, inside: Sequence[bool]
) -> tuple[PosedImages, float] | None:
    """Let pixels of photographs count only in the panel's window.

    Args:
        images: C photographs.
        window: the panel's window.
        inside: [C], the photographs to keep.

    Returns:
        The photographs, and the fraction 0..1 of their pixels that count; None where no pixel does.
    """
    weights = {}
    for index, (width, height) in enumerate(images.sizes):
        if not inside[index]:
            continue
        camera = images.world_to_camera[index, :4], images.intrinsics[index]
        counts = images.pixel_weights(index)[:height, :width] * window.mask(*camera, width, height, images.model)
        beyond = (0, images.width_px - width, 0, images.height_px - height)
        weight = pad(counts, beyond).mul(255).round().to(images.photos.device, torch.uint8)
        if bool(weight.any()):
            weights[index] = weight
    if not weights:
        return None
    pixels = sum(images.sizes[index][0] * images.sizes[index][1] for index in weights)
    masked = replace(images.select(list(weights)), weights=torch.stack(list(weights.values())))
    return masked, sum(int((weight > 0).sum()) for weight in weights.values()) / pixels


def _score_window(
    run: Run, window: PanelWindow, display: Display, gaussians: Gaussians, left: Gaussians
) -> WindowScores | None:
    """Score the scene before and after pruning, by photographs in the same poses: alignment might hide losses."""
    held = run.align_held_out(gaussians)
    if held is None or run.angles is None:
        return None
    found = mask_to_window(held, window, [angle <= display.panel.cone_deg / 2 for angle in run.angles.angles_deg])
    if found is None:
        return None
    images, coverage = found
    return WindowScores(run.score(gaussians, images), run.score(left, images), coverage)
