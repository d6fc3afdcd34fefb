"""Train the network for hidden surfaces: `python -m training.hidden.train --config configs/training/hidden.yaml`.

Every field of HiddenConfig is an option that overrides the file. Running the same command again resumes the run.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import make_folder
from training.checkpoints import cut_log, load_checkpoint, save_checkpoint
from training.command import with_line_errors
from training.hidden.compositions import Compositions
from training.hidden.config import HiddenConfig
from training.hidden.examples import Example, make_examples
from training.hidden.losses import HiddenLoss, Judge
from training.hidden.network import HiddenNet
from training.hidden.pictures import make_leaves, read_pieces
from training.hidden.scores import HeldOut
from training.log import RunLog
from training.loop import termination_noticed
from training.meshes.pack import ResidentMeshes, read_meshes
from training.schedule import WeightAverage, learning_rate, make_optimizer

_JUDGE_RATE = 0.3  # learning rate of the judge by the network's


class HiddenTrainer:
    """The state of a run: network, averaged weights, judge, optimizers.

    Attributes:
        step: Steps taken.
        elapsed_s: Time that they took, over all resumptions.
    """

    def __init__(self, config: HiddenConfig, device: torch.device) -> None:
        torch.manual_seed(config.seed)
        self.config, self.device, self.step, self.elapsed_s = config, device, 0, 0.0
        memory = torch.channels_last
        self.net = HiddenNet().to(device, memory_format=memory)
        self.average = WeightAverage(copy.deepcopy(self.net), self.net, config.optimizer.ema_decay)
        self._optimizer = make_optimizer(self.net, config.optimizer)
        self._loss = HiddenLoss(config.loss).to(device)
        self._judge = Judge().to(device, memory_format=memory)
        self._judge_optimizer = torch.optim.Adam(self._judge.parameters(), betas=(0.0, 0.9))

    def progress(self) -> float:
        """Return how much of the run is over, 0..1, by steps or by time."""
        seconds = self.config.seconds
        return min(1.0, max(self.step / self.config.steps, self.elapsed_s / seconds if seconds else 0.0))

    def advance(self, example: Example) -> dict[str, float]:
        """Take a step on examples, and return its report."""
        config = self.config.optimizer
        rate = learning_rate(self.step, self.progress(), config)
        half = torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda")
        with half:
            colours, log_disparity = self.net(example.seen())
        colours = colours.float()
        known, truth = example.known, example.truth
        terms = self._loss(colours, log_disparity.float(), truth, example.log_disparity, known)
        weighted = self._loss.weighted(terms)
        if self.config.loss.adversarial:
            drawn = torch.where(known[:, None], colours, truth)
            judged = self._judge.loss(drawn, truth, known)
            self._take(self._judge_optimizer, judged, _JUDGE_RATE * rate, self._judge)
            approval = self._judge.approval(drawn, known)
            weighted = weighted - self.config.loss.adversarial * approval
            terms |= {"judge": judged, "approval": approval}
        norm = self._take(self._optimizer, weighted, rate, self.net)
        self.average.update(self.step)
        self.step += 1
        report = torch.stack([weighted, norm, *terms.values()]).detach().tolist()
        return {"step": self.step - 1, "learning_rate": rate} | dict(zip(("loss", "gradient_norm", *terms), report))

    def _take(
        self, optimizer: torch.optim.Optimizer, loss: torch.Tensor, rate: float, net: torch.nn.Module
    ) -> torch.Tensor:
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), self.config.optimizer.clip)
        optimizer.step()
        return norm

    def _parts(self) -> dict[str, Any]:
        return {
            "net": self.net,
            "average": self.average.average,
            "optimizer": self._optimizer,
            "judge": self._judge,
            "judge_optimizer": self._judge_optimizer,
        }

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint stores."""
        parts = {name: part.state_dict() for name, part in self._parts().items()}
        own = {"step": self.step, "elapsed_s": self.elapsed_s, "identity": json.dumps(self.config.identity())}
        return parts | own

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a state."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.step, self.elapsed_s = state["step"], state["elapsed_s"]


def _examples(config: HiddenConfig, source: Compositions, step: int) -> Iterator[Example]:
    """Yield the examples of the steps from this one on; each drawn set depends on the seed and its number alone."""
    steps_of_set = config.batches * config.uses
    while True:
        number, first = divmod(step, steps_of_set)
        rng = np.random.default_rng((config.seed, number))
        drawn = make_examples(source.make(rng, config.batch * config.batches, config.compile), rng)
        for place in range(first, steps_of_set):
            use, part = divmod(place, config.batches)
            yield drawn.part(slice(part * config.batch, (part + 1) * config.batch), use)
            step += 1


def _run(trainer: HiddenTrainer, source: Compositions, held_out: HeldOut, log: RunLog, signals: list[int]) -> bool:
    """Take the steps that are left; return whether the run is over."""
    config, output = trainer.config, Path(trainer.config.output_dir)
    begun = time.monotonic() - trainer.elapsed_s
    for example in _examples(config, source, trainer.step):
        report = trainer.advance(example)
        if not math.isfinite(report["gradient_norm"]):
            raise InputError(f"step {trainer.step}: the gradient is not finite: lower optimizer.learning_rate")
        log.record(report)
        trainer.elapsed_s = time.monotonic() - begun
        over = trainer.progress() >= 1
        if trainer.step % config.score_every == 0 or over:
            log.scores(trainer.step, held_out.scores(trainer.average.average))
        if signals or over or trainer.step % config.checkpoint_every == 0:
            save_checkpoint(output / "last.pt", trainer.state())
            trainer.average.average.save(output / "model.safetensors")
        if signals or over:
            return over
    return True


def train(config: HiddenConfig) -> Path | None:
    """Run or resume a run; return the path of the weights, None where a signal stopped it.

    Raises:
        InputError: the configuration, the data or a checkpoint cannot be used.
    """
    output, device = make_folder(config.output_dir), torch.device(choose_device(config.device))
    meshes, photographs = Path(config.meshes), Path(config.photographs)
    pieces = read_pieces(photographs, config.held_out, held_out=False)
    pictures = torch.cat([pieces.to(device), make_leaves(config.leaves, config.seed, device)])
    source = Compositions(ResidentMeshes(read_meshes(meshes), device), pictures, config.compositions)
    held_out = HeldOut(meshes, photographs, config.held_out, config.compositions, config.scored, device)
    print(f"{len(pieces)} pieces of photographs, {config.leaves} made-up pictures; {held_out.scores(None)}", flush=True)
    trainer = HiddenTrainer(config, device)
    if (output / "last.pt").exists():
        trainer.restore(load_checkpoint(output / "last.pt", config))
    cut_log(output / "losses.jsonl", trainer.step)
    cut_log(output / "scores.jsonl", trainer.step + 1)
    with termination_noticed() as signals, RunLog(output, trainer.step, config.steps, writes=True) as log:
        finished = trainer.progress() >= 1 or _run(trainer, source, held_out, log, signals)
        log.say_speed()
    return output / "model.safetensors" if finished else None


@with_line_errors("training.hidden.train")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog="python -m training.hidden.train", description=__doc__, exit_on_error=False)
    parser.add_argument("--config", action="config", help="YAML file with options")
    parser.add_class_arguments(HiddenConfig)
    instantiate = getattr(parser, "instantiate", None) or parser.instantiate_classes  # renamed in jsonargparse 4.49
    try:
        options = instantiate(parser.parse_args(arguments))
    except argparse.ArgumentError as error:
        raise InputError(" ".join(str(error).split())) from None
    weights = train(HiddenConfig(**{field.name: options[field.name] for field in dataclasses.fields(HiddenConfig)}))
    if weights is not None:
        print(f"weights: {weights}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
