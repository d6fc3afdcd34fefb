"""The training loop: resumable at any step, with the same numbers as without the interruption."""

from __future__ import annotations

import json
import math
import signal
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import make_folder
from training.checkpoints import cut_log, load_checkpoint, save_checkpoint
from training.config import Stage, TrainingConfig
from training.data.batches import make_batch
from training.data.cache import CachedSet, load_set
from training.data.distance import distance_doubt
from training.data.objects import find_objects
from training.data.partners import find_partners
from training.data.plan import BatchPlan, BatchPlanner
from training.data.resident import ResidentViews
from training.data.sampler import ViewSampler
from training.data.textures import Photographs, read_photographs
from training.distributed import Team, join_team
from training.evaluation import score_folder
from training.log import RunLog
from training.meshes.pack import ResidentMeshes, read_meshes
from training.meshes.scenes import MeshScenes
from training.trainer import StepValues, Trainer


def make_planner(config: TrainingConfig, team: Team, tell: bool = False) -> BatchPlanner:
    """Return the source of a run's batches, its views on the team's device; decode the data first if necessary.

    Args:
        tell: Print how each set's object pixels are found.
    """
    with team.leader_first():
        sets, target_sets = (
            [load_set(Path(folder), Path(config.cache_dir), background=config.background) for folder in folders]
            for folders in (config.data, config.target_data)
        )
    if tell and team.leads:
        _tell(sets + target_sets)
    partners = find_partners(sets, target_sets)
    poses = [views.camera_to_world for cached in sets + target_sets for views in cached.objects]
    sampler = ViewSampler(
        poses[: len(partners)],
        config.azimuth_deg,
        config.elevation_deg,
        config.targets,
        config.seed,
        config.neighbour_deg,
        [poses[partner] for partner in partners],
    )
    photographs = read_photographs(Path(config.photographs)) if config.photographs else None
    views = ResidentViews(sets + target_sets, team.device)
    if tell and team.leads:
        _tell_pixels(config.stages, views)
    return BatchPlanner(
        views,
        sampler,
        config.augmentation,
        partners,
        config.procedural,
        photographs,
        _mesh_scenes(config, team, photographs, tell) if config.meshes.folder else None,
    )


def _mesh_scenes(config: TrainingConfig, team: Team, photographs: Photographs | None, tell: bool) -> MeshScenes:
    """Return the source of the examples that show meshes; print how many objects there are."""
    meshes = read_meshes(Path(config.meshes.folder))
    if tell and team.leads:
        print(f"{config.meshes.folder}: {len(meshes)} meshes, {len(meshes.corners)} triangles", flush=True)
    cone_deg = (config.azimuth_deg, config.elevation_deg)
    return MeshScenes(ResidentMeshes(meshes, team.device), config.meshes, cone_deg, photographs)


def _tell(sets: list[CachedSet]) -> None:
    """Print how the pixels of objects are found in each set, and note objects that are not where the network looks."""
    if sets:
        print(*sets, sep="\n", flush=True)
    doubts = [
        f"{views.name}: {doubt}"
        for cached in sets
        for views in cached.objects
        if (doubt := distance_doubt(views.camera_to_world))
    ]
    if doubts:
        note(f"{len(doubts)} objects may teach nothing; the first: {doubts[0]}")


def _tell_pixels(stages: list[Stage], views: ResidentViews) -> None:
    """Note where a sheet of detail is finer than the stored views."""
    finest = max(stage.detail * stage.image_size_px for stage in stages)
    stored = float(np.median(views.squares[:, 2])) if len(views.squares) else finest
    if stored < finest:
        note(f"stages: detail: the sheet has {finest} px, objects of the stored views {stored:.0f} in the median")


@contextmanager
def termination_noticed() -> Iterator[list[int]]:
    """Collects SIGTERM and SIGINT in a list, so that the step under way can end and be saved."""
    received: list[int] = []
    former = {
        number: signal.signal(number, lambda number, _: received.append(number))
        for number in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield received
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


class Planned(NamedTuple):
    """A step to take: its plan, its stage, and whether it is the last of the run."""

    plan: BatchPlan
    stage: Stage
    last: bool


def plans(planner: BatchPlanner, trainer: Trainer) -> Iterator[Planned]:
    """Return this process's plans from the trainer's step on, each made while the step before it runs."""
    config, team = trainer.config, trainer.team

    def submitted(step: int) -> tuple[Stage, Future[BatchPlan]] | None:
        if config.is_over(step, trainer.seconds):
            return None
        stage, drawn = config.stage_at(step, trainer.seconds)
        sizes, part = (stage.image_size_px, stage.target_px), team.split(stage.objects)
        finer = {"finer": max(1, stage.detail), "zoom": stage.target_zoom}
        return stage, pool.submit(planner.plan, step, drawn, stage.objects, *sizes, part, **finer)

    with ThreadPoolExecutor(1) as pool:
        step = trainer.step
        following = submitted(step)
        while following is not None:
            stage, future = following
            plan, step = future.result(), step + 1
            following = submitted(step)
            yield Planned(plan, stage, following is None)


def _record(values: StepValues, trainer: Trainer, log: RunLog) -> bool:
    """Read and log a step; return whether any process had been told to end. Raise InputError when it went wrong."""
    found = values.read()
    stop, trainer.seconds = found.pop("stop") > 0, found.pop("seconds")
    if not math.isfinite(found["gradient_norm"]):
        raise InputError(
            f"step {values.step}: the gradient is not finite: lower optimizer.learning_rate, and run the "
            "command again with another output_dir, or to go on from the last checkpoint"
        )
    log.record(found)
    return stop


def _validate(trainer: Trainer, log: RunLog, decoded: dict[Path, Tensor], over: bool) -> None:
    """Score the averaged weights on objects of the validation folder, if that is due and not done.

    Args:
        decoded: See score_folder.
        over: Whether the run is. Stages that end by the clock end with scores.
    """
    config = trainer.config
    due = config.scores_due(trainer.step) or (over and config.by_time and bool(config.validation))
    if not (trainer.team.leads and due) or trainer.step <= log.scored:
        return
    report = score_folder(
        trainer.average.average,
        Path(config.validation),
        limit=config.validation_objects,
        device=trainer.team.device,
        decoded=decoded,
        background=config.background,
    )
    if report["skipped"]:
        first = next(iter(report["skipped"].values()))
        log.say(f"{len(report['skipped'])} objects could not be scored; the first: {first}")
    log.scores(trainer.step, {name: report[name] for name in ("psnr_db", "ssim", "copy_psnr_db", "copy_ssim")})


def _run(trainer: Trainer, planner: BatchPlanner, log: RunLog, signals: list[int]) -> bool:
    """Takes the steps that are left, saves and scores; whether the last one was reached."""
    config, team = trainer.config, trainer.team
    behind: StepValues | None = None
    decoded: dict[Path, Tensor] = {}
    # Owed by a run that ended between a checkpoint and its scores
    _validate(trainer, log, decoded, config.is_over(trainer.step, trainer.seconds))
    log.resume_clock()
    begun = time.monotonic() - trainer.seconds
    former = None
    for plan, stage, last in plans(planner, trainer):
        if former not in (None, stage) and team.leads:
            _save_weights(trainer, f"stage-{config.stages.index(former) + 1}.safetensors")
        former = stage
        batch = make_batch(plan, planner.views, config.compile)
        ahead = trainer.advance(batch, stage, stop=bool(signals), seconds=time.monotonic() - begun)
        # A step is read while the next one runs, so that the device always has work. All processes read the same.
        stop = behind is not None and _record(behind, trainer, log)
        behind = ahead
        if not (stop or last or config.scores_due(trainer.step) or trainer.step % config.checkpoint_every == 0):
            continue
        stop, behind = _record(ahead, trainer, log) or stop, None
        log.mark_speed()
        if team.leads:
            save_checkpoint(Path(config.output_dir) / "last.pt", trainer.state())
        if stop and not last:
            log.say(f"stopped by a signal after step {trainer.step}; run the same command to resume")
            return False
        _validate(trainer, log, decoded, last)
        log.resume_clock()
    return True


def _save_weights(trainer: Trainer, name: str) -> Path:
    """Write the averaged weights into the run's folder; return their path."""
    path = Path(trainer.config.output_dir) / name
    notes = {"steps": str(trainer.step), "training": json.dumps(trainer.config.identity())}
    trainer.average.average.save(path, notes)
    return path


def _train(config: TrainingConfig, output: Path, team: Team) -> Path | None:
    """Do the work of train() as one of a team."""
    for stage in config.stages:
        team.split(stage.objects)
    trainer, planner = Trainer(config, team), make_planner(config, team, tell=True)
    if (output / "last.pt").exists():
        trainer.restore(load_checkpoint(output / "last.pt", config))
    if team.leads:
        cut_log(output / "losses.jsonl", trainer.step)
        cut_log(output / "scores.jsonl", trainer.step + 1)
    with termination_noticed() as signals, RunLog(output, trainer.step, config.total_steps, team.leads) as log:
        if config.compile:
            log.say("compiling kernels for this machine: the first step takes one to four minutes")
        finished = _run(trainer, planner, log, signals)
        log.say_speed()
    if not (finished and team.leads):
        return None
    return _save_weights(trainer, "model.safetensors")


def train(config: TrainingConfig) -> Path | None:
    """Run or resume a training run; returns the final weights' path, or None when a signal stopped it early.

    Under torchrun every process calls this; the first of them writes, the others return None. Raises InputError for a
    configuration, data or a checkpoint that cannot be used.
    """
    if config.validation:
        find_objects(Path(config.validation), "val")  # now, not when the first scores are due
    output = make_folder(config.output_dir)
    if config.threads:
        torch.set_num_threads(config.threads)
    with join_team(config.device) as team:
        return _train(config, output, team)
