"""The training loop of a fit: its steps, and the changes between them: degree of harmonics, density, order in memory.

The calls of a step are the same on every device. All values that change from step to step are read from tensors by the
number of the step, also a tensor. So a step on CUDA waits for nothing, and a CUDA graph can repeat it. Only the device
knows the number of (tile, Gaussian) intersections of an image. A step with more than its capacity changes nothing, nor
do the steps after it, until the host has looked and raised the capacity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs.base.device import capture_graph
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.density import DensityStatistics, morton_order, refine_adaptive, refine_mcmc, reset_opacities
from lightfield_gs.fitting.distributed import ALONE, Group
from lightfield_gs.fitting.image_optimizers import ExposureOptimizer, PoseOptimizer
from lightfield_gs.fitting.optimizer import GaussianState, Gradients, update
from lightfield_gs.fitting.photo_loss import Loss, own_loss_and_gradient, photo_loss_and_gradient
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.random import dropout
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.rasterizer.image_render import ImageBuffers, ImageRender
from lightfield_gs.rasterizer.workspace import GradientRequest

_LOOK_EVERY = 100  # steps after which the host waits for the device
# Allocate 1.25 x the largest number of intersections seen, and 65536; allocate again when less than 10 % is left.
_SLACK, _LEAST_SLACK, _LEAST_CAPACITY = 1.25, 1.1, 1 << 16


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


class _StepGradients(NamedTuple):
    """The part of some photographs in a step, float32."""

    gaussians: Gradients
    sums: Tensor  # see DensityStatistics.measure
    loss: Tensor  # [1]
    exposure: Tensor  # of all photographs, empty if it is not optimised
    poses: Tensor  # of all photographs, empty if they are not optimised


class Trainer:
    """A fit under way; `done` is the number of its steps that are done, and `advance` does more.

    The same settings, photographs and Gaussians give the same bits on the same device, with any stops and checkpoints
    between: nothing depends on time, and random numbers only on seed and step.
    """

    def __init__(
        self,
        state: GaussianState,
        images: PosedImages,
        settings: FitSettings,
        group: Group = ALONE,
        photo_weights: Sequence[float] | None = None,
        loss: Loss | None = None,
    ):
        """Prepare the first step.

        Args:
            state: the first Gaussians.
            images: the training photographs.
            settings: settings of the fit; batch_size counts the photographs of all processes.
            group: the processes that fit together.
            photo_weights: of the photographs, see Schedule.make; None: 1.
            loss: in place of that of the settings.

        Raises:
            InputError: the processes cannot split a batch equally, or were not given the same; the loss needs weights
                that are not here.
        """
        self.state, self.images, self.settings, self.group = state, images, settings, group
        self.device = images.device
        self._losses = _choose_losses(loss, settings, self.device)
        self.schedule = Schedule.make(settings, images.count, self.device, photo_weights)
        self.counters = StepCounters.start(settings.steps, self.device)
        self.statistics = DensityStatistics(state.count, settings, self.device)
        self.exposure = ExposureOptimizer(images.count, settings, self.device) if settings.exposure else None
        self.poses = (
            PoseOptimizer(images.world_to_camera, settings.steps, settings.poses_lr) if settings.poses else None
        )
        # Other optimised tensors by name: a checkpoint stores them, and writes to them to restore the fit
        self.extra: dict[str, Tensor] = {
            f"{name}.{part}": tensor
            for name, own in (("exposure", self.exposure), ("poses", self.poses))
            if own is not None
            for part, tensor in own.tensors().items()
        }
        self._order = group.split(self.schedule.order)
        self._host_order = self._order.cpu()
        self._check_same()
        self.done = 0
        self._capacity: int | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._graph_key: tuple | None = None

    def _check_same(self) -> None:
        """Raise InputError unless all processes begin with the same."""
        if self.group.size > 1:
            device = self.device
            self.group.check_same("settings", repr(self.settings).encode(), device)
            self.group.check_same("photographs", repr((self.images.names, self.images.sizes)).encode(), device)
            self.group.check_same("order", self.schedule.order.cpu().numpy().tobytes(), device)
            self.group.check_same("Gaussians", self.state.values.means.cpu().numpy().tobytes(), device)

    def advance(self, until: int) -> None:
        """Do the steps up to `until`, and all that is due between them."""
        until = min(until, self.settings.steps)
        while self.done < until:
            degree = self.settings.degree_at(self.done)
            if degree > self.state.degree:
                self.state.raise_degree(degree)
            self._run(self._segment_end(until))
            self._end_segment()

    def _segment_end(self, until: int) -> int:
        """Return the next step after which other work is due, or `until` if it comes first."""
        return next((step for step in range(self.done + 1, until) if self._something_due(step)), until)

    def _something_due(self, step: int) -> bool:
        settings = self.settings
        density = settings.refines_after(step) or settings.resets_after(step) or settings.sorts_after(step)
        return density or settings.degree_at(step) != settings.degree_at(step - 1) or step in self._losses

    def _end_segment(self) -> None:
        """Change the density, reset opacities and sort, where due."""
        settings = self.settings
        if settings.refines_after(self.done):
            self._refine()
        if settings.resets_after(self.done):
            reset_opacities(self.state, settings)
        if settings.sorts_after(self.done):
            order = morton_order(self.state.values.means)
            self.state = self.state.select(order)
            self.statistics.sort(order)

    def _refine(self) -> None:
        """Change the density, and begin another round of statistics."""
        before = self.state
        if self.settings.density == "mcmc":
            self.state = refine_mcmc(self.state, self.settings, self.done)
        else:
            self.state = refine_adaptive(self.state, self.statistics, self.settings, self.done)
        if self.state is before:
            self.statistics.next_round()
        else:
            self.statistics = DensityStatistics(self.state.count, self.settings, self.device)

    # --- Steps, by a graph on CUDA

    @property
    def _loss_and_gradient(self) -> Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]]:
        """The loss of the next step."""
        return self._losses[max(first for first in self._losses if first <= self.done)]

    def _run(self, until: int) -> None:
        """Do the steps up to `until`; nothing else is due between them."""
        while self.done < until:
            count = min(until - self.done, _LOOK_EVERY)
            if self.device.type == "cuda":
                count = 1 if self._capacity is None else count
                self._run_cuda(count)
            else:
                for ahead in range(count):
                    self._stage(ahead)
                    self._step(None)
            self._look(count)

    def _run_cuda(self, count: int) -> None:
        self._stage(0)
        if self._capacity is None:  # the first step of all finds the number of intersections
            self._step(None)
            return
        tensors = [*self.state.tensors().values(), *self.statistics.tensors().values()]
        key = (self._loss_and_gradient, self.state.count, self._capacity, *(t.data_ptr() for t in tensors))
        if self._graph is None or key != self._graph_key:
            self._graph = None  # frees its memory before the next one is made
            self._step(self._capacity)  # calls that run for the first time must not be captured
            torch.cuda.synchronize(self.device)
            self._graph, _ = capture_graph(partial(self._step, self._capacity))
            self._graph_key = key
        else:
            self._graph.replay()
        for ahead in range(1, count):
            self._stage(ahead)
            self._graph.replay()

    def _stage(self, ahead: int) -> None:
        """Bring the photographs of a step, `ahead` of the next one, to the device if they are elsewhere."""
        self.images.stage(self._host_order[min(self.done + ahead, self.settings.steps - 1) :])

    def _look(self, begun: int) -> None:
        """Wait for the device; learn how many of `begun` steps are done, and raise the capacity if they need more.

        Steps beyond the capacity count all their Gaussians as skipped; this is subtracted.
        """
        counters, before = self.counters, self.done
        numbers = torch.cat([counters.step, counters.intersections, counters.overflow])
        self.done, intersections, overflow = numbers.tolist()
        if self._capacity is None or overflow or intersections * _LEAST_SLACK > self._capacity:
            self._capacity = int(intersections * _SLACK) + _LEAST_CAPACITY
        if overflow:
            counters.overflow.zero_()
            counters.skipped -= self.state.count * (begun - (self.done - before))
        if not torch.isfinite(counters.losses[self.done - 1]):
            raise InputError(
                f"step {self.done}: the loss is no number any more; a lower rate or other photographs may help"
            )

    # --- One step

    def _step(self, capacity: int | None) -> None:
        """Do the next step.

        Args:
            capacity: for (tile, Gaussian) intersections, on CUDA; None: the host waits for their number.
        """
        counters = self.counters
        chosen = self._order.index_select(0, counters.step)[0]
        found = self._gradients(chosen, capacity)
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

    def _gradients(self, chosen: Tensor, capacity: int | None) -> _StepGradients:
        """Return the part of photographs `chosen` [V] in the sums over all photographs of the step."""
        images, poses = self.images, self.poses
        background = self.schedule.backgrounds.index_select(0, self.counters.step).expand(len(chosen), 3).contiguous()
        world_to_camera = images.world_to_camera if poses is None else poses.world_to_camera
        gaussians, antialiased = self.state.gaussians(), self.settings.antialiased
        rates, factors = self.schedule.dropouts, None
        if rates is not None:
            factors = dropout(rates, self.counters.step, self.settings.seed, self.state.count)
            gaussians = replace(gaussians, opacities=gaussians.opacities * factors)
        job = images.render_job(gaussians, chosen, world_to_camera, background, antialiased, capacity=capacity)
        rendered = job.draw()
        loss, g_image, g_exposure = self._compare(rendered.image[0], chosen, background)
        request = GradientRequest(self.statistics.screen_numbers, cameras=poses is not None)
        gradients = job.backward(rendered, ImageBuffers(g_image[None], None, None), request)
        self._count_intersections(job, capacity)
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
        loss, gradient = self._loss_and_gradient(exposed, photos, weights)
        loss, gradient = loss / batch_size, gradient / batch_size
        if exposure is None:
            return loss, gradient, loss.new_zeros(0)
        return loss, *exposure.backward(image, gradient, chosen)

    def _count_intersections(self, job: ImageRender, capacity: int | None) -> None:
        """Count intersections, and set `overflow` if they exceed the capacity in any process: all stop together."""
        counters, intersections = self.counters, job.intersections_on_device
        self.group.max_(intersections)
        torch.maximum(counters.intersections, intersections, out=counters.intersections)
        if capacity is not None:
            counters.overflow |= intersections > capacity


def _choose_losses(
    own: Loss | None, settings: FitSettings, device: torch.device
) -> dict[int, Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]]]:
    """Return the losses by the step from which on they count, the later ones last.

    Each is a function of renders, photographs and weights that returns the loss and its gradient by the renders.
    """
    if own is not None:
        return {0: partial(own_loss_and_gradient, own)}
    pixels = partial(photo_loss_and_gradient, ssim_lambda=settings.ssim_lambda)
    if settings.loss == "wd":
        from lightfield_gs.fitting.wasserstein import FIRST_STEPS, load_loss

        return {0: pixels, round(FIRST_STEPS * settings.steps): load_loss(settings.ssim_lambda, device)}
    return {0: pixels}
