"""What is left of a scene once what its panel does not show is pruned, and what stands before the eyes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import real_number
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.encoding.pruning import contributions, left_out
from lightfield_gs.fitting.display import Display
from lightfield_gs.fitting.drawing import view_job
from lightfield_gs.fitting.evaluate import Scores
from lightfield_gs.fitting.frame import PROTOCOL, Frame, framed
from lightfield_gs.fitting.run import Run
from lightfield_gs.fitting.views import Views
from lightfield_gs.fitting.world import World
from lightfield_gs.rasterizer.image_render import ImageBuffers
from lightfield_gs.rasterizer.scene import GradientRequest
from lightfield_gs.scene.gaussians import Gaussians, map_fields

# Of the mean error that colours of 0..1 may have for what is pruned: 1/39 of a step of 8 bits, a third of what `prune`
# allows, for here nobody asked for a smaller scene.
CONTRIBUTION_CUT = 1e-4
# What is nearer to the panel's cameras than this share of the zero plane's distance floats before the eyes: at a fourth
# of it two eyes at the ends of a cone of 40 degrees see a point 2.2 zero-plane distances apart.
NEAR_SHARE = 0.25
_SEEN_PX = 1.0  # the least weight, in pixels of all photographs together, of what is said to be seen by them


@dataclass(frozen=True)
class Shown:
    """What pruning for a panel found.

    kept: [N] bool. unseen: how many contribute nothing to the panel; faint: how many went by the cut; floating: how
    many of the others float before the eyes; unfounded: how many of these no photograph shows, which went too.
    share: of the light of an opaque image, 0..1, what those that went contributed: the mean error of colours of 0..1 is
    at most that, and 1e-4, at which samples end.
    """

    kept: Tensor
    unseen: int
    faint: int
    floating: int
    unfounded: int
    share: float

    @property
    def count(self) -> int:
        """How many Gaussians are left."""
        return int(self.kept.sum())

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the numbers."""
        numbers = {name: value for name, value in vars(self).items() if name != "kept"}
        return {"gaussians": self.count, **numbers}

    def lines(self) -> list[str]:
        """What to say of it."""
        return [
            f"cone: {self.count} of {len(self.kept)} Gaussians are left: {self.unseen} show in no view of the panel, "
            f"{self.faint} hardly; without them colours of 0..1 differ by {self.share + 1e-4:.1e} at most in the mean",
            f"cone: {self.floating} Gaussians float nearer to the eyes than {NEAR_SHARE:g} of the zero plane's "
            f"distance; {self.unfounded} of them show in no photograph and went too",
        ]


def shown_by(
    gaussians: Gaussians,
    world: World,
    display: Display,
    views: Views,
    contribution_cut: float = CONTRIBUTION_CUT,
    antialiased: bool = False,
) -> Shown:
    """Which Gaussians [N], float32, coordinates of the fit, a panel needs; views: the photographs that were fitted to.

    Those that contribute nothing to what the panel shows go; those that contribute least go as long as they stay within
    contribution_cut (0..1; encoding.prune has the proof); and those that float before the eyes go where they have less
    than a pixel's weight in all photographs together. Takes time and memory like a training step on one image of the
    panel, and where something floats, like one on every photograph. Raises InputError.
    """
    contribution_cut = real_number("contribution_cut", contribution_cut, 0.0, 1.0)
    of_capture = world.back(gaussians)
    rig = display.rig.relative_to(of_capture.origin)
    weights = contributions(of_capture, display.panel, rig, antialiased)
    cut = left_out(weights, display.panel, contribution_cut)
    floating = ~cut & (_depths(of_capture, rig.world_to_camera) < NEAR_SHARE * rig.zero_depth)
    unfounded = torch.zeros_like(floating)
    if bool(floating.any()):
        unfounded = floating & (photographed(gaussians, views, antialiased) < _SEEN_PX)
    unseen = weights == 0
    gone = cut | unfounded
    if bool(gone.all()):
        assume("cone: nothing of the scene shows on the panel, so that nothing is left out of it")
        gone = torch.zeros_like(gone)
    whole = 3 * display.panel.width_px * display.panel.height_px
    return Shown(
        ~gone,
        int(unseen.sum()),
        int((cut & ~unseen).sum()),
        int(floating.sum()),
        int(unfounded.sum()),
        float(weights[gone].sum()) / whole,
    )


@dataclass(frozen=True)
class FrameScores:
    """Of the same held-out photographs inside the cone, by what the panel can show of them, see frame.PROTOCOL: whole,
    of all Gaussians; pruned, of those that are left. share: of the photographs' pixels, 0..1, what counted."""

    whole: Scores
    pruned: Scores
    share: float


def pruned(
    run: Run, world: World, display: Display, contribution_cut: float
) -> tuple[Gaussians, Shown, FrameScores | None]:
    """The scene of a run, coordinates of the fit, without what a display does not need; what was found; and scores
    before and after, which scores.json has too; None where no photograph that was held out says anything of them.
    Raises InputError."""
    trainer = run.trainer
    gaussians, settings = trainer.fields.gaussians().detach(), trainer.settings
    shown = shown_by(gaussians, world, display, trainer.views, contribution_cut, settings.antialiased)
    for line in shown.lines():
        run.say(line)
    left = map_fields(gaussians, lambda field: field[shown.kept])
    scores = _scores_in_frame(run, Frame.of(display, world), display, gaussians, left)
    if scores is None:
        run.write_scores(pruned=shown.to_dict())
    else:
        frame = {"protocol": PROTOCOL, "share": round(scores.share, 4), **scores.whole.to_dict()}
        run.write_scores(frame=frame, pruned={**shown.to_dict(), **scores.pruned.to_dict()})
    return left, shown, scores


def _scores_in_frame(
    run: Run, frame: Frame, display: Display, gaussians: Gaussians, left: Gaussians
) -> FrameScores | None:
    """Scores before and after, by the photographs in the same poses: alignment might hide what is gone."""
    held = run.held_for(gaussians)
    if held is None or run.angles is None:
        return None
    found = framed(held, frame, [angle <= display.panel.cone_deg / 2 for angle in run.angles.angles_deg])
    if found is None:
        return None
    views, share = found
    return FrameScores(run.scores_of(gaussians, views), run.scores_of(left, views), share)


def photographed(gaussians: Gaussians, views: Views, antialiased: bool = False) -> Tensor:
    """[N] float64: the weight of each Gaussian, alpha times the transmittance before it, summed over all pixels that
    count of all photographs."""
    total = gaussians.means.new_zeros(gaussians.count, dtype=torch.float64)
    # Of one grey: the derivative of an image by it is the weight, whatever the colours are
    grey = replace(gaussians, sh=torch.zeros_like(gaussians.sh[:, :1]))
    black = gaussians.means.new_zeros(1, 3)
    for place in range(views.count):
        chosen = torch.tensor([place], device=gaussians.means.device)
        job = view_job(grey, views, chosen, views.world_to_camera, black, antialiased)
        images = job.draw()
        counts = views.counts(place)[None, None, ..., None].expand_as(images.image)
        gradients = job.backward(images, ImageBuffers(counts.contiguous(), None, None), GradientRequest(cameras=False))
        total += gradients.fields[-1][0].double().sum((1, 2)) / SH_CONSTANT / 3
    return total


def _depths(gaussians: Gaussians, pose: np.ndarray) -> Tensor:
    """[N] float64: depths in all cameras of a rig, which stand on one line across its axis."""
    row = torch.from_numpy(pose[2]).to(gaussians.means.device)
    return gaussians.means.double() @ row[:3] + row[3]
