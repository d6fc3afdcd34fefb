"""The steps of a fit in their order, and what comes between them: harmonics of a higher degree, other densities."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from lightfield_gs.base.cuda import capture_graph
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting import adaptive, mcmc, morton
from lightfield_gs.fitting.exposure import Exposure
from lightfield_gs.fitting.fields import Fields
from lightfield_gs.fitting.poses import Poses
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.several import ALONE, Group
from lightfield_gs.fitting.step import Counters, Step
from lightfield_gs.fitting.tally import Tally
from lightfield_gs.fitting.views import Views

_LOOK_EVERY = 100  # steps after which the host looks where the device is
# Of the room for pairs, beyond what the steps so far needed: what is made, and with how little there is made more
_SLACK, _LEAST_SLACK, _LEAST_ROOM = 1.25, 1.1, 1 << 16


class Trainer:
    """A fit under way. Where it stands is `done`, how many steps are done; whoever drives it calls `advance`.

    The same settings, views and Gaussians give the same bits on the same device, whether in one go or with any number
    of stops and checkpoints between: nothing depends on time, and random numbers only on the seed and the step.
    """

    def __init__(
        self,
        fields: Fields,
        views: Views,
        settings: FitSettings,
        group: Group = ALONE,
        shares: Sequence[float] | None = None,
    ):
        """group: the processes that fit together; settings.batch_size is that of all of them. shares: in how many of
        the epochs each of the views is, see Schedule.of; None: in all.

        Raises InputError where they cannot be shared out, or the processes were not given the same.
        """
        self.fields, self.views, self.settings, self.group = fields, views, settings, group
        self.device = views.device
        self.schedule = Schedule.of(settings, views.count, self.device, shares)
        self.counters = Counters.start(settings.steps, self.device)
        self.tally = Tally(self.fields.count, settings, self.device)
        self.exposure = Exposure(views.count, settings, self.device) if settings.exposure else None
        self.poses = Poses(views.world_to_camera, settings.steps, settings.poses_lr) if settings.poses else None
        # What else is optimised, by name: a checkpoint keeps it too, and writes to these tensors to restore it
        self.extra: dict[str, torch.Tensor] = {
            f"{name}.{part}": tensor
            for name, own in (("exposure", self.exposure), ("poses", self.poses))
            if own is not None
            for part, tensor in own.tensors().items()
        }
        self._own_order = group.share(self.schedule.order)
        self._host_order = self._own_order.cpu()
        self._check_same()
        self.done = 0
        self._room: int | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._graph_key: tuple | None = None

    def _check_same(self) -> None:
        """Whether all processes begin with the same; raises InputError."""
        if self.group.size > 1:
            device = self.device
            self.group.check_same("settings", repr(self.settings).encode(), device)
            self.group.check_same("photographs", repr((self.views.names, self.views.sizes)).encode(), device)
            self.group.check_same("order", self.schedule.order.cpu().numpy().tobytes(), device)
            self.group.check_same("Gaussians", self.fields.values.means.cpu().numpy().tobytes(), device)

    def advance(self, until: int) -> None:
        """Does the steps up to `until`, with all that is due between them."""
        until = min(until, self.settings.steps)
        while self.done < until:
            self._begin_segment()
            self._run(self._segment_end(until))
            self._end_segment()

    def _segment_end(self, until: int) -> int:
        """The next step after which something else is due, or `until` if that comes first."""
        step = self.done + 1
        while step < until and not self._something_due(step):
            step += 1
        return step

    def _something_due(self, step: int) -> bool:
        settings = self.settings
        density = settings.refines_after(step) or settings.resets_after(step) or settings.sorts_after(step)
        return density or settings.degree_at(step) != settings.degree_at(step - 1)

    def _begin_segment(self) -> None:
        degree = self.settings.degree_at(self.done)
        if degree > self.fields.degree:
            self.fields.raise_degree(degree)

    def _end_segment(self) -> None:
        """Does what is due: changes the density, resets opacities, sorts."""
        settings = self.settings
        if settings.refines_after(self.done):
            self._refine()
        if settings.resets_after(self.done):
            adaptive.reset(self.fields, settings)
        if settings.sorts_after(self.done):
            order = morton.order_of(self.fields.values.means)
            self.fields = self.fields.changed(lambda tensor: tensor[order])
            self.tally.sort(order)

    def _refine(self) -> None:
        """Changes the density, and begins another tally."""
        before = self.fields
        if self.settings.density == "mcmc":
            self.fields = mcmc.change(self.fields, self.settings, self.done)
        else:
            self.fields = adaptive.change(self.fields, self.tally, self.settings, self.done)
        if self.fields is before:
            self.tally.next_round()
        else:
            self.tally = Tally(self.fields.count, self.settings, self.device)

    # --- Steps, by a graph where there is CUDA

    def _run(self, until: int) -> None:
        """Does the steps up to `until`, between which nothing else is due."""
        while self.done < until:
            count = min(until - self.done, _LOOK_EVERY)
            if self.device.type == "cuda":
                count = 1 if self._room is None else count
                self._run_cuda(count)
            else:
                for _ in range(count):
                    self._step(None).run()
            self._look(count)

    def _step(self, room: int | None) -> Step:
        return Step(
            self.fields,
            self.views,
            self.schedule,
            self.settings,
            self.counters,
            self.tally,
            room,
            order=self._own_order,
            exposure=self.exposure,
            poses=self.poses,
            group=self.group,
        )

    def _run_cuda(self, count: int) -> None:
        self._stage(0)
        if self._room is None:  # the first step of all finds out how many pairs there are
            self._step(None).run()
            return
        tensors = [*self.fields.tensors().values(), *self.tally.tensors().values()]
        key = (self.fields.count, self._room, *(t.data_ptr() for t in tensors))
        if self._graph is None or key != self._graph_key:
            self._graph = None  # its memory is free for the next before that is made
            self._step(self._room).run()  # what runs for the first time may not be captured
            self._graph, self._graph_key = self._captured(), key
        else:
            self._graph.replay()
        for ahead in range(1, count):
            self._stage(ahead)
            self._graph.replay()

    def _stage(self, ahead: int) -> None:
        """Has the device find the photographs of a step, `ahead` of the next one, where they are the host's."""
        if self.views.on_host:
            self.views.stage(self._host_order[min(self.done + ahead, self.settings.steps - 1)])

    def _captured(self) -> torch.cuda.CUDAGraph:
        """Capture a step as a graph, without running it."""
        torch.cuda.synchronize(self.device)
        return capture_graph(self._step(self._room).run)[0]

    def _look(self, begun: int) -> None:
        """Waits for the device, and learns from it how many of the steps that were begun are done, and whether they
        need more room. Steps without room count all their Gaussians as skipped, which is taken back."""
        counters, before = self.counters, self.done
        self.done, pairs, lost = torch.cat([counters.step, counters.pairs, counters.lost]).tolist()
        if self._room is None or lost or pairs * _LEAST_SLACK > self._room:
            self._room = int(pairs * _SLACK) + _LEAST_ROOM
        if lost:
            counters.lost.zero_()
            counters.skipped -= self.fields.count * (begun - (self.done - before))
        if not torch.isfinite(counters.losses[self.done - 1]):
            raise InputError(
                f"step {self.done}: the loss is no number any more; a lower rate or other photographs may help"
            )
