"""One step of a fit: photographs are drawn, compared, and the fields moved; the same calls on every device.

Whatever changes from step to step is read from tensors by the number of the step, which is a tensor too. So a step on
CUDA waits for nothing, and a CUDA graph can repeat it. How many (tile, splat) pairs an image has is known only to the
device: there is room for some, and a step that would need more changes nothing, nor do those after it, until the host
has looked and made room.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs.fitting.drawing import view_job
from lightfield_gs.fitting.dropout import dropout
from lightfield_gs.fitting.exposure import Exposure
from lightfield_gs.fitting.fields import Fields
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.poses import Poses
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.several import ALONE, Group
from lightfield_gs.fitting.tally import Tally
from lightfield_gs.fitting.update import Gradients, update
from lightfield_gs.fitting.views import Views
from lightfield_gs.rasterizer.image_render import ImageBuffers, ImageRender
from lightfield_gs.rasterizer.scene import GradientRequest


@dataclass
class Counters:
    """Where a fit stands, on its device: [1] int64 each, but losses.

    step: the next one. pairs: the most that a step needed since the host looked. lost: 1 once a step had no room for
    its pairs. skipped: Gaussians left alone for gradients that were no numbers. losses [steps]: of each step.
    """

    step: Tensor
    pairs: Tensor
    lost: Tensor
    skipped: Tensor
    losses: Tensor

    @classmethod
    def start(cls, steps: int, device: torch.device | str) -> Counters:
        step, pairs, lost, skipped = (torch.zeros(1, dtype=torch.int64, device=device) for _ in range(4))
        return cls(step, pairs, lost, skipped, torch.zeros(steps, device=device))


class Step:
    """The step of a fit, for as long as its tensors are the same."""

    def __init__(
        self,
        fields: Fields,
        views: Views,
        schedule: Schedule,
        settings: FitSettings,
        counters: Counters,
        tally: Tally,
        room: int | None,
        *,
        order: Tensor,
        exposure: Exposure | None = None,
        poses: Poses | None = None,
        group: Group = ALONE,
    ):
        """room: for how many (tile, splat) pairs, on CUDA; None: the host waits for their number. order: the columns of
        schedule.order that this process of the group draws. exposure, poses: of all views, where they are optimised."""
        self.fields, self.views, self.schedule, self.settings = fields, views, schedule, settings
        self.counters, self.tally, self.room = counters, tally, room
        self.order, self.exposure, self.poses, self.group = order, exposure, poses, group

    def run(self) -> None:
        """Does the step that is next."""
        counters = self.counters
        chosen = self.order.index_select(0, counters.step)[0]
        found = self._gradients(chosen)
        self.group.sum_([*found.fields, *found[1:]])
        counters.losses.index_copy_(0, counters.step, found.loss)
        kept = 1 - counters.lost
        self.tally.add(found.sums, kept)
        update(
            self.fields.values,
            self.fields.first,
            self.fields.second,
            found.fields,
            self.fields.scales,
            self.fields.opacities,
            table=self.schedule.numbers,
            step=torch.where(kept > 0, counters.step, -1),
            skipped=counters.skipped,
            seed=self.settings.seed,
            seen=self.tally.seen,
        )
        if self.exposure is not None:
            self.exposure.update(found.exposure, counters.step, kept)
        if self.poses is not None:
            self.poses.update(found.poses, counters.step, kept)
        counters.step += kept

    def _gradients(self, chosen: Tensor) -> _Found:
        """What the views `chosen` [V] say: their part of the sums over all views of the step."""
        views, poses = self.views, self.poses
        background = self.schedule.backgrounds.index_select(0, self.counters.step).expand(len(chosen), 3).contiguous()
        from_where = views.world_to_camera if poses is None else poses.world_to_camera
        gaussians, antialiased = self.fields.gaussians(), self.settings.antialiased
        factors = self._dropout()
        if factors is not None:
            gaussians = replace(gaussians, opacities=gaussians.opacities * factors)
        job = view_job(gaussians, views, chosen, from_where, background, antialiased, room=self.room)
        images = job.draw()
        loss, g_image, g_exposure = self._compared(images.image[0], chosen, background)
        wanted = GradientRequest(self.tally.screen_numbers, cameras=poses is not None)
        gradients = job.backward(images, ImageBuffers(g_image[None], None, None), wanted)
        self._note(job)
        of_fields = Gradients(*(g[0] for g in gradients.fields))
        if factors is not None:
            of_fields = of_fields._replace(opacities=of_fields.opacities * factors)
        return _Found(
            of_fields,
            self.tally.measured(job.splats, gradients.screen, views),
            loss[None],
            g_exposure,
            loss.new_zeros(0) if poses is None else poses.gathered(gradients.cameras, chosen).to(loss.dtype),
        )

    def _dropout(self) -> Tensor | None:
        """The factors of the opacities in this step; None: none is left out."""
        shares = self.schedule.dropouts
        return None if shares is None else dropout(shares, self.counters.step, self.settings.seed, self.fields.count)

    def _compared(self, image: Tensor, chosen: Tensor, background: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The loss of images [V,H,W,3], over the number of views of the step; its gradients with respect to them, and
        to the exposure of all photographs.

        A photograph over the background is over that as exposed: exposure is that of the camera, and what is
        transparent is to say nothing of it.
        """
        exposure, views = self.exposure, self.settings.batch_size
        behind = background if exposure is None else exposure.exposed(background, chosen)
        exposed = image if exposure is None else exposure.exposed(image, chosen)
        photos, weights = self.views.targets(chosen, behind)
        loss, gradient = photo_loss_and_gradient(exposed, photos, weights, self.settings.ssim_lambda)
        loss, gradient = loss / views, gradient / views
        if exposure is None:
            return loss, gradient, loss.new_zeros(0)
        return loss, *exposure.reverse(image, gradient, chosen)

    def _note(self, job: ImageRender) -> None:
        """Notes how many pairs there were in the process that had most, and whether that were too many for it: there is
        as much room in all, and all stop together."""
        counters, pairs = self.counters, job.intersections_on_device
        self.group.max_(pairs)
        torch.maximum(counters.pairs, pairs, out=counters.pairs)
        if self.room is not None:
            counters.lost |= pairs > self.room


class _Found(NamedTuple):
    """What some views of a step say, float32: gradients of the fields; sums of the tally; loss [1]; gradients of the
    exposure and of the poses of all photographs, empty where these are not optimised."""

    fields: Gradients
    sums: Tensor
    loss: Tensor
    exposure: Tensor
    poses: Tensor
