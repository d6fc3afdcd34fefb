"""One step of a fit: photographs are drawn and compared, and the parameters updated; the same calls on every device.

Everything that changes from step to step is read from tensors by the number of the step, which is a tensor too. So a
step on CUDA waits for nothing, and a CUDA graph can repeat it. Only the device knows the number of (tile, Gaussian)
intersections of an image. A step with more than its capacity changes nothing, nor do the steps after it, until the host
has looked and raised the capacity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs.fitting.density import DensityStatistics
from lightfield_gs.fitting.distributed import ALONE, Group
from lightfield_gs.fitting.image_optimizers import ExposureOptimizer, PoseOptimizer
from lightfield_gs.fitting.optimizer import GaussianState, Gradients, update
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.random import dropout
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.rasterizer.image_render import ImageBuffers, ImageRender
from lightfield_gs.rasterizer.scene import GradientRequest


@dataclass
class StepCounters:
    """The progress of a fit, on its device; [1] int64 each, except losses.

    Attributes:
        step: the next step.
        intersections: the most that a step needed since the host looked.
        overflow: 1 once a step needed more than its capacity.
        skipped: number of Gaussians that kept their values since their gradients were not numbers.
        losses: [steps] float32, of each step.
    """

    step: Tensor
    intersections: Tensor
    overflow: Tensor
    skipped: Tensor
    losses: Tensor

    @classmethod
    def start(cls, steps: int, device: torch.device | str) -> StepCounters:
        """Return the counters of a fit that begins."""
        step, intersections, overflow, skipped = (torch.zeros(1, dtype=torch.int64, device=device) for _ in range(4))
        return cls(step, intersections, overflow, skipped, torch.zeros(steps, device=device))

    def tensors(self) -> dict[str, Tensor]:
        """Return all tensors by their names in checkpoints."""
        own = {"step": self.step, "pairs": self.intersections, "lost": self.overflow}
        return {**own, "skipped": self.skipped, "losses": self.losses}


class Step:
    """The step of a fit, for as long as its tensors are the same."""

    def __init__(
        self,
        state: GaussianState,
        images: PosedImages,
        schedule: Schedule,
        settings: FitSettings,
        counters: StepCounters,
        statistics: DensityStatistics,
        capacity: int | None,
        *,
        order: Tensor,
        exposure: ExposureOptimizer | None = None,
        poses: PoseOptimizer | None = None,
        group: Group = ALONE,
    ):
        """Keep the tensors.

        Args:
            state: the Gaussians.
            images: the training photographs.
            schedule: of all steps.
            settings: of the fit.
            counters: of the fit.
            statistics: for density control.
            capacity: for (tile, Gaussian) intersections, on CUDA; None: the host waits for their number.
            order: the columns of schedule.order that this process draws.
            exposure: of all photographs, if it is optimised.
            poses: of all photographs, if they are optimised.
            group: the processes of the fit.
        """
        self.state, self.images, self.schedule, self.settings = state, images, schedule, settings
        self.counters, self.statistics, self.capacity = counters, statistics, capacity
        self.order, self.exposure, self.poses, self.group = order, exposure, poses, group

    def run(self) -> None:
        """Do the next step."""
        counters = self.counters
        chosen = self.order.index_select(0, counters.step)[0]
        found = self._gradients(chosen)
        self.group.sum_([*found.gaussians, *found[1:]])
        counters.losses.index_copy_(0, counters.step, found.loss)
        kept = 1 - counters.overflow
        self.statistics.add(found.sums, kept)
        update(
            self.state.values,
            self.state.first,
            self.state.second,
            found.gaussians,
            self.state.scales,
            self.state.opacities,
            table=self.schedule.numbers,
            step=torch.where(kept > 0, counters.step, -1),
            skipped=counters.skipped,
            seed=self.settings.seed,
            seen=self.statistics.seen,
        )
        if self.exposure is not None:
            self.exposure.update(found.exposure, counters.step, kept)
        if self.poses is not None:
            self.poses.update(found.poses, counters.step, kept)
        counters.step += kept

    def _gradients(self, chosen: Tensor) -> _StepGradients:
        """Return the part of photographs `chosen` [V] in the sums over all photographs of the step."""
        images, poses = self.images, self.poses
        background = self.schedule.backgrounds.index_select(0, self.counters.step).expand(len(chosen), 3).contiguous()
        world_to_camera = images.world_to_camera if poses is None else poses.world_to_camera
        gaussians, antialiased = self.state.gaussians(), self.settings.antialiased
        factors = self._dropout()
        if factors is not None:
            gaussians = replace(gaussians, opacities=gaussians.opacities * factors)
        job = images.render_job(gaussians, chosen, world_to_camera, background, antialiased, capacity=self.capacity)
        rendered = job.draw()
        loss, g_image, g_exposure = self._compare(rendered.image[0], chosen, background)
        request = GradientRequest(self.statistics.screen_numbers, cameras=poses is not None)
        gradients = job.backward(rendered, ImageBuffers(g_image[None], None, None), request)
        self._count_intersections(job)
        g_gaussians = Gradients(*(g[0] for g in gradients.fields))
        if factors is not None:
            g_gaussians = g_gaussians._replace(opacities=g_gaussians.opacities * factors)
        return _StepGradients(
            g_gaussians,
            self.statistics.measure(job.splats, gradients.screen, images),
            loss[None],
            g_exposure,
            loss.new_zeros(0) if poses is None else poses.sum_gradients(gradients.cameras, chosen).to(loss.dtype),
        )

    def _dropout(self) -> Tensor | None:
        """Return the factors of the opacities in this step; None without dropout."""
        rates = self.schedule.dropouts
        return None if rates is None else dropout(rates, self.counters.step, self.settings.seed, self.state.count)

    def _compare(self, image: Tensor, chosen: Tensor, background: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compare renders [V,H,W,3] with photographs.

        A photograph over the background is over the exposed background: exposure belongs to the camera, and transparent
        pixels are to say nothing about it.

        Returns:
            The loss over the batch size, and its gradients by the renders and by the exposure of all photographs.
        """
        exposure, batch_size = self.exposure, self.settings.batch_size
        behind = background if exposure is None else exposure.apply(background, chosen)
        exposed = image if exposure is None else exposure.apply(image, chosen)
        photos, weights = self.images.targets(chosen, behind)
        loss, gradient = photo_loss_and_gradient(exposed, photos, weights, self.settings.ssim_lambda)
        loss, gradient = loss / batch_size, gradient / batch_size
        if exposure is None:
            return loss, gradient, loss.new_zeros(0)
        return loss, *exposure.backward(image, gradient, chosen)

    def _count_intersections(self, job: ImageRender) -> None:
        """Count intersections, and set `overflow` if they exceed the capacity in any process: all stop together."""
        counters, intersections = self.counters, job.intersections_on_device
        self.group.max_(intersections)
        torch.maximum(counters.intersections, intersections, out=counters.intersections)
        if self.capacity is not None:
            counters.overflow |= intersections > self.capacity


class _StepGradients(NamedTuple):
    """The part of some photographs in a step, float32."""

    gaussians: Gradients
    sums: Tensor  # see DensityStatistics.measure
    loss: Tensor  # [1]
    exposure: Tensor  # of all photographs, empty if it is not optimised
    poses: Tensor  # of all photographs, empty if they are not optimised
