"""The training loop: resumable at any step, with the same numbers as without the interruption."""
from __future__ import annotations

import copy
import json
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import torch
from tqdm import tqdm

from lightfield_gs.models import ModelConfig, SplatterNet
from training.checkpoints import cut_log, load_checkpoint, save_checkpoint
from training.config import TrainingConfig
from training.data.batches import Batch, BatchMaker
from training.data.cache import load_set
from training.data.sampler import ViewSampler
from training.evaluation import score_folder
from training.losses import total_loss
from training.rendering import render_views
from training.schedule import WeightAverage, learning_rate, make_optimizer


def make_batches(config: TrainingConfig) -> BatchMaker:
    """The batch source of a run; decodes the data first where that has not been done."""
    sets = [load_set(Path(folder), Path(config.cache_dir)) for folder in config.data]
    poses = [views.camera_to_world for cached in sets for views in cached.objects]
    azimuth = config.cone_deg / 2 * config.cone_margin
    sampler = ViewSampler(poses, azimuth, config.elevation_deg, config.targets, config.seed)
    return BatchMaker(sets, sampler, config.augmentation)


class Trainer:
    """Network, averaged weights and optimizer of one run, and the step that advances them."""

    def __init__(self, config: TrainingConfig) -> None:
        self.config, self.step = config, 0
        torch.manual_seed(config.seed)
        self.net = SplatterNet(ModelConfig.from_yaml(config.model)).to(memory_format=torch.channels_last).train()
        self.average = WeightAverage(copy.deepcopy(self.net), config.optimizer.ema_decay)
        self.optimizer = make_optimizer(self.net, config.optimizer)

    def advance(self, batch: Batch) -> dict[str, float]:
        """One optimizer step on a batch; returns the loss and its terms."""
        config, size = self.config, batch.source.shape[-1]
        # Dropout must not depend on how often the run was resumed.
        torch.manual_seed((config.seed << 32) + self.step)
        rate = learning_rate(self.step, config.total_steps, config.optimizer)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        with torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
            gaussians = self.net(batch.source, batch.source_intrinsics)
        images, alpha = render_views(gaussians, batch.world_to_camera, batch.intrinsics, size, size, batch.backgrounds)
        loss, terms = total_loss(images, alpha, batch.targets, batch.backgrounds, gaussians.means, batch.source,
                                 config.loss)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.net.parameters(), config.optimizer.clip, error_if_nonfinite=True)
        self.optimizer.step()
        self.average.update(self.net, self.step)
        self.step += 1
        return {"loss": loss.item(), "gradient_norm": norm.item(), "learning_rate": rate,
                **{name: term.item() for name, term in terms.items()}}

    def state(self) -> dict:
        """Everything that resuming needs."""
        return {"step": self.step, "identity": json.dumps(self.config.identity()), "net": self.net.state_dict(),
                "average": self.average.average.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict) -> None:
        """The inverse of state()."""
        self.net.load_state_dict(state["net"])
        self.average.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.step = state["step"]


@contextmanager
def _termination_noticed() -> Iterator[list[int]]:
    """Collects SIGTERM and SIGINT in a list, so that the step under way can end and be saved."""
    received: list[int] = []
    former = {number: signal.signal(number, lambda number, _: received.append(number))
              for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield received
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


def _batches(maker: BatchMaker, config: TrainingConfig, start: int) -> Iterator[Batch]:
    """Batches from step `start` on, each made while the step before it runs."""
    def make(step: int) -> Batch:
        stage, drawn = config.stage_at(step)
        return maker.make(step, drawn, stage.objects, stage.image_size_px)

    with ThreadPoolExecutor(1) as pool:
        following = pool.submit(make, start) if start < config.total_steps else None
        for step in range(start, config.total_steps):
            batch = following.result()
            if step + 1 < config.total_steps:
                following = pool.submit(make, step + 1)
            yield batch


def _validate(trainer: Trainer, config: TrainingConfig) -> dict[str, float]:
    """Scores of the averaged weights on the first objects of the validation folder."""
    report = score_folder(trainer.average.average, Path(config.validation), limit=config.validation_objects)
    return {name: report[name] for name in ("psnr_db", "ssim", "copy_psnr_db", "copy_ssim")}


def train(config: TrainingConfig) -> Path | None:
    """Run or resume a training run; returns the final weights' path, or None when a signal stopped it early."""
    from torch.utils.tensorboard import SummaryWriter
    output = Path(config.output_dir)
    output.mkdir(parents=True, exist_ok=True)
    if config.threads:
        torch.set_num_threads(config.threads)
    trainer, maker = Trainer(config), make_batches(config)
    if (output / "last.pt").exists():
        trainer.restore(load_checkpoint(output / "last.pt", config.identity()))
    cut_log(output / "losses.jsonl", trainer.step)
    progress = tqdm(total=config.total_steps, initial=trainer.step, unit="step", dynamic_ncols=True)
    with (_termination_noticed() as signals, progress, open(output / "losses.jsonl", "a", buffering=1) as log,
          SummaryWriter(output / "tensorboard", purge_step=trainer.step) as board):
        for batch in _batches(maker, config, trainer.step):
            step, values = trainer.step, trainer.advance(batch)
            log.write(json.dumps({"step": step} | values) + "\n")
            for name, value in values.items():
                board.add_scalar(f"train/{name}", value, step)
            progress.set_postfix(loss=f"{values['loss']:.4f}", lr=f"{values['learning_rate']:.1e}")
            progress.update()
            if signals or trainer.step % config.checkpoint_every == 0 or trainer.step == config.total_steps:
                save_checkpoint(output / "last.pt", trainer.state())
            if signals:
                progress.write(f"stopped by signal {signals[0]} after step {trainer.step}; "
                               "run the same command to resume")
                return None
            if config.validation and trainer.step % config.validate_every == 0:
                scores = _validate(trainer, config)
                progress.write(f"step {trainer.step}: " + json.dumps(scores))
                for name, value in scores.items():
                    board.add_scalar(f"validation/{name}", value, trainer.step)
    weights = output / "model.safetensors"
    trainer.average.average.save(weights, {"steps": str(trainer.step), "training": json.dumps(config.identity())})
    return weights
