"""Network, averaged weights and optimizer of a run, and the step that advances them."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Sequence

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.models import ModelConfig, SplatterNet
from training.config import Stage, TrainingConfig
from training.data.batches import Batch
from training.data.fusing import keep_compile_workers, keep_one_graph
from training.distributed import Team
from training.drawing import draw, drawings, seen_by_network
from training.losses import total_loss
from training.marks import NoMarks
from training.schedule import WeightAverage, learning_rate, make_optimizer, progress


class StepValues:
    """The report of a step, on its way from the device: reading it waits for that step and for nothing after it."""

    def __init__(self, step: int, rate: float, values: dict[str, Tensor], team: Team) -> None:
        self.step, self._rate, self._names = step, rate, list(values)
        self._values = team.mean(torch.stack(list(values.values()))).to("cpu", non_blocking=True)
        self._arrived = None
        if team.device.type == "cuda":
            self._arrived = torch.cuda.Event()
            self._arrived.record()

    def read(self) -> dict[str, float]:
        """step, loss, gradient_norm, learning_rate, terms of the loss, seconds, stop; means over all processes."""
        if self._arrived is not None:
            self._arrived.synchronize()
        found = dict(zip(self._names, self._values.tolist()))
        return {
            "step": self.step,
            "loss": found.pop("loss"),
            "gradient_norm": found.pop("gradient_norm"),
            "learning_rate": self._rate,
            **found,
        }


def _initial_net(config: TrainingConfig) -> SplatterNet:
    if config.initial_weights:
        path = None if config.initial_weights == "pretrained" else config.initial_weights
        net = SplatterNet.from_pretrained(path)
    else:
        net = SplatterNet(ModelConfig.from_yaml(config.model))
    if config.attention_px:
        net = with_attention(net, config.attention_px)
    if config.symmetric:  # has no weights of its own
        net.config = dataclasses.replace(net.config, symmetric=True)
    if config.trained == "head":
        net.unet.requires_grad_(False)
    return net


def with_attention(net: SplatterNet, sizes_px: Sequence[int]) -> SplatterNet:
    """Return the network with self-attention at more sizes of its features, which has no effect until it is trained.

    Raises:
        InputError: the network has no features of such a size.
    """
    unet, size = net.config.unet, net.config.image_size_px // net.config.patch_px
    sizes = [size >> level for level in range(len(unet.multipliers))]
    if other := sorted(set(sizes_px) - set(sizes)):
        raise InputError(f"attention_px: expected sizes of {', '.join(map(str, sizes))} for this network, got {other}")
    unet = dataclasses.replace(unet, attention_px=tuple(sorted({*unet.attention_px, *sizes_px}, reverse=True)))
    more = SplatterNet(dataclasses.replace(net.config, unet=unet))
    more.load_state_dict(net.state_dict(), strict=False)  # the rest is the new attention, whose output begins at zero
    return more


class Trainer:
    """Network, averaged weights and optimizer of one run, and the step that advances them.

    marks: told where the parts of a step end. seconds: time that the run had taken at the last step that was read, the
    same in all processes. Raises InputError for pictures that the network cannot take.
    """

    def __init__(self, config: TrainingConfig, team: Team) -> None:
        self.config, self.team, self.step, self.seconds, self.marks = config, team, 0, 0.0, NoMarks()
        torch.manual_seed(config.seed)
        net = _initial_net(config).to(team.device, memory_format=torch.channels_last)
        for stage in config.stages:
            net.config.check_size("stages: image_size_px", stage.image_size_px)
        self.net = net.train()
        if config.trained == "head":
            self.net.unet.eval()  # its features as they are, without dropout
        self.average = WeightAverage(copy.deepcopy(self.net), self.net, config.optimizer.ema_decay)
        self.optimizer = make_optimizer(self.net, config.optimizer)
        self._weights = [weights for weights in self.net.parameters() if weights.requires_grad]
        self._loss, self._compose = total_loss, self.net.composed
        if config.compile:  # sizes change between stages only
            keep_compile_workers()
            keep_one_graph()
            self.net.compile(dynamic=False, mode="reduce-overhead" if team.device.type == "cuda" else None)
            self._loss = torch.compile(total_loss, dynamic=False)
            self._compose = torch.compile(self.net.composed, dynamic=False)
        self._replica = team.replicated(self.net)

    def advance(self, batch: Batch, stage: Stage | None = None, stop: bool = False, seconds: float = 0.0) -> StepValues:
        """Do one optimizer step on this process's part of a batch.

        On CUDA the step is queued, not finished, when this returns, but for the rasterizer's own waits.

        Args:
            stage: Of the step; None: the first.
            stop: Whether this process has been told to end.
            seconds: Time that the run has taken so far.
        """
        config, device, marks = self.config, self.team.device, self.marks
        stage = stage or config.stages[0]
        marks.mark("batch")
        # Dropout must not depend on how often the run was resumed.
        torch.manual_seed((config.seed << 32) + self.step * self.team.size + self.team.rank)
        rate = learning_rate(self.step, progress(self.step, self.seconds, config), config.optimizer)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        seen = seen_by_network(batch, stage)
        with torch.autocast(device.type, torch.bfloat16, enabled=config.bfloat16):
            cloud = self._replica(*seen)
        marks.mark("network")
        drawn = drawings(self._compose, cloud, seen, batch, stage, config)
        if stage.detail:
            marks.mark("sheet")
        pictures = [draw(drawing, batch) for drawing in drawn]
        marks.mark("rasterizer")
        losses = []
        terms: dict[str, Tensor] = {}
        for drawing, (images, alpha, targets) in zip(drawn, pictures):
            loss, parts = self._loss(images, alpha, targets, batch.backgrounds, cloud.means, seen[0], drawing.weights)
            losses.append(drawing.share * loss)
            for name, term in parts.items():
                name = drawing.name + name
                terms[name] = terms.get(name, 0) + drawing.share * term
            marks.mark_at_gradient(images, "loss backward")
        loss = torch.stack(losses).sum()
        marks.mark("loss")
        marks.mark_at_gradient(cloud.means, "rasterizer backward")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        marks.mark("network backward")
        norm = torch.nn.utils.clip_grad_norm_(self._weights, config.optimizer.clip)
        self.optimizer.step()
        self.average.update(self.step)
        marks.mark("update")
        self.step += 1
        told = {"stop": float(stop), "seconds": seconds}
        values = {"loss": loss.detach(), "gradient_norm": norm, **terms}
        values |= {name: torch.full((), value, device=device) for name, value in told.items()}
        return StepValues(self.step - 1, rate, values, self.team)

    def state(self) -> dict:
        """Everything that resuming needs."""
        return {
            "step": self.step,
            "seconds": self.seconds,
            "identity": json.dumps(self.config.identity()),
            "net": self.net.state_dict(),
            "average": self.average.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
        }

    def restore(self, state: dict) -> None:
        """The inverse of state()."""
        self.net.load_state_dict(state["net"])
        self.average.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step, self.seconds = state["step"], state.get("seconds", 0.0)
