"""One step of a fit: photographs are drawn, compared, and the fields moved; the same calls on every device.

Whatever changes from step to step is read from tensors by the number of the step, which is a tensor too. So a step on
CUDA waits for nothing, and a CUDA graph can repeat it. How many (tile, splat) pairs an image has is known only to the
device: there is room for some, and a step that would need more changes nothing, nor do those after it, until the host
has looked and made room.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.fit.fields import Fields
from lightfield_gs.fit.photo_loss import photo_loss_and_gradient
from lightfield_gs.fit.schedule import Schedule
from lightfield_gs.fit.settings import FitSettings
from lightfield_gs.fit.tally import Tally
from lightfield_gs.fit.update import Gradients, update
from lightfield_gs.fit.views import Views
from lightfield_gs.rasterizer.dense_job import DenseImages, DenseJob
from lightfield_gs.rasterizer.workspace import Wanted


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
    ):
        """room: for how many (tile, splat) pairs, on CUDA; None: the host waits for their number."""
        self.fields, self.views, self.schedule, self.settings = fields, views, schedule, settings
        self.counters, self.tally, self.room = counters, tally, room

    def run(self) -> None:
        """Does the step that is next."""
        views, counters = self.views, self.counters
        chosen = self.schedule.order.index_select(0, counters.step)[0]
        poses, intrinsics, limits = (
            t.index_select(0, chosen)[None] for t in (views.world_to_camera, views.intrinsics, views.limits)
        )
        background = self.schedule.backgrounds.index_select(0, counters.step).expand(len(chosen), 3).contiguous()
        drawn = [field[None] for field in self.fields.gaussians().fields().values()]
        job = DenseJob(
            *drawn,
            background[None],
            poses,
            intrinsics,
            limits,
            views.width_px,
            views.height_px,
            self.settings.antialiased,
            room=self.room,
        )
        images = job.draw()
        photos, weights = views.chosen(chosen)
        loss, g_image = photo_loss_and_gradient(images.image[0], photos, weights, self.settings.ssim_share)
        wanted = Wanted(self.tally.screen_numbers, cameras=False)
        gradients = job.backward(images, DenseImages(g_image[None] / len(chosen), None, None), wanted)
        self._note(job, loss / len(chosen))
        kept = 1 - counters.lost
        self.tally.add(job.splats, gradients.screen, kept, views)
        update(
            self.fields.values,
            self.fields.first,
            self.fields.second,
            Gradients(*(g[0] for g in gradients.fields)),
            self.fields.scales,
            self.fields.opacities,
            table=self.schedule.numbers,
            step=torch.where(kept > 0, counters.step, -1),
            skipped=counters.skipped,
            seed=self.settings.seed,
            seen=self.tally.seen,
        )
        counters.step += kept

    def _note(self, job: DenseJob, loss: Tensor) -> None:
        """Notes how many pairs there were, whether that were too many, and the loss."""
        counters = self.counters
        torch.maximum(counters.pairs, job.pairs_on_device, out=counters.pairs)
        if self.room is not None:
            counters.lost |= job.pairs_on_device > self.room
        counters.losses.index_copy_(0, counters.step, loss[None])
