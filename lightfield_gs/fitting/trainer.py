"""The steps of a fit in their order, and the changes between them: degree of harmonics, density, order in memory."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from lightfield_gs.base.device import capture_graph
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.density import DensityStatistics, morton_order, refine_adaptive, refine_mcmc, reset_opacities
from lightfield_gs.fitting.distributed import ALONE, Group
from lightfield_gs.fitting.image_optimizers import ExposureOptimizer, PoseOptimizer
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.posed_images import PosedImages
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.step import Step, StepCounters

_LOOK_EVERY = 100  # steps after which the host waits for the device
# Allocate 1.25 x the largest number of intersections seen, and 65536; allocate again when less than 10 % is left.
_SLACK, _LEAST_SLACK, _LEAST_CAPACITY = 1.25, 1.1, 1 << 16


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
    ):
        """Prepare the first step.

        Args:
            state: the first Gaussians.
            images: the training photographs.
            settings: of the fit; batch_size counts the photographs of all processes.
            group: the processes that fit together.
            photo_weights: of the photographs, see Schedule.make; None: 1.

        Raises:
            InputError: the processes cannot split a batch equally, or were not given the same.
        """
        self.state, self.images, self.settings, self.group = state, images, settings, group
        self.device = images.device
        self.schedule = Schedule.make(settings, images.count, self.device, photo_weights)
        self.counters = StepCounters.start(settings.steps, self.device)
        self.statistics = DensityStatistics(state.count, settings, self.device)
        self.exposure = ExposureOptimizer(images.count, settings, self.device) if settings.exposure else None
        self.poses = (
            PoseOptimizer(images.world_to_camera, settings.steps, settings.poses_lr) if settings.poses else None
        )
        # Other optimised tensors by name: a checkpoint stores them, and writes to them to restore the fit
        self.extra: dict[str, torch.Tensor] = {
            f"{name}.{part}": tensor
            for name, own in (("exposure", self.exposure), ("poses", self.poses))
            if own is not None
            for part, tensor in own.tensors().items()
        }
        self._own_order = group.split(self.schedule.order)
        self._host_order = self._own_order.cpu()
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
        """Return the next step after which something else is due, or `until` if that comes first."""
        step = self.done + 1
        while step < until and not self._something_due(step):
            step += 1
        return step

    def _something_due(self, step: int) -> bool:
        settings = self.settings
        density = settings.refines_after(step) or settings.resets_after(step) or settings.sorts_after(step)
        return density or settings.degree_at(step) != settings.degree_at(step - 1)

    def _end_segment(self) -> None:
        """Change the density, reset opacities and sort, where due."""
        settings = self.settings
        if settings.refines_after(self.done):
            self._refine()
        if settings.resets_after(self.done):
            reset_opacities(self.state, settings)
        if settings.sorts_after(self.done):
            order = morton_order(self.state.values.means)
            self.state = self.state.map(lambda tensor: tensor[order])
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

    def _run(self, until: int) -> None:
        """Do the steps up to `until`; nothing else is due between them."""
        while self.done < until:
            count = min(until - self.done, _LOOK_EVERY)
            if self.device.type == "cuda":
                count = 1 if self._capacity is None else count
                self._run_cuda(count)
            else:
                for _ in range(count):
                    self._step(None).run()
            self._look(count)

    def _step(self, capacity: int | None) -> Step:
        return Step(
            self.state,
            self.images,
            self.schedule,
            self.settings,
            self.counters,
            self.statistics,
            capacity,
            order=self._own_order,
            exposure=self.exposure,
            poses=self.poses,
            group=self.group,
        )

    def _run_cuda(self, count: int) -> None:
        self._stage(0)
        if self._capacity is None:  # the first step of all finds the number of intersections
            self._step(None).run()
            return
        tensors = [*self.state.tensors().values(), *self.statistics.tensors().values()]
        key = (self.state.count, self._capacity, *(t.data_ptr() for t in tensors))
        if self._graph is None or key != self._graph_key:
            self._graph = None  # frees its memory before the next one is made
            self._step(self._capacity).run()  # calls that run for the first time must not be captured
            self._graph, self._graph_key = self._capture(), key
        else:
            self._graph.replay()
        for ahead in range(1, count):
            self._stage(ahead)
            self._graph.replay()

    def _stage(self, ahead: int) -> None:
        """Copy the photographs of a step, `ahead` of the next one, to the device if they are on the host."""
        if self.images.on_host:
            self.images.stage(self._host_order[min(self.done + ahead, self.settings.steps - 1)])

    def _capture(self) -> torch.cuda.CUDAGraph:
        """Return a step as a graph. Capturing does not run it."""
        torch.cuda.synchronize(self.device)
        return capture_graph(self._step(self._capacity).run)[0]

    def _look(self, begun: int) -> None:
        """Wait for the device; learn how many of `begun` steps are done, and raise the capacity if they need more.

        Steps beyond the capacity count all their Gaussians as skipped, which is taken back.
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
