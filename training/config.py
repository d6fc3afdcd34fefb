"""Configuration of a training run, read from configs/training/*.yaml."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from lightfield_gs.base.errors import InputError
from training.data.background import Choice
from training.data.plan import Augmentation, check_zoom
from training.losses import LossWeights
from training.meshes.scenes import MeshOptions
from training.ranges import MOST, check_ranges

_FOLDERS = ("data", "target_data")
_REMOVED = {"detail": 0.0}  # fields that runs were stored with, and the values that meant nothing


@dataclass(frozen=True)
class Stage:
    """A stretch of the run. Raises InputError for numbers out of their ranges, as all parts of a configuration do.

    Args:
        steps: optimizer steps; 0 where minutes say how long the stage is.
        image_size_px: side of the source pictures.
        objects: examples per step, of all processes together.
        target_px: side of the target images; 0: as the source pictures.
        minutes: length by the clock in place of steps, compilation and scores included, over all starts of the run.
            Either all stages have minutes, or none has. The learning rate then follows the time.
        detail: also draw what a photo shows with a sheet of detail this many times as fine as the source pictures: 1,
            2 or 4; 0: not. Its loss (`composite`) is added to that of the network's own Gaussians. Pictures are made as
            fine as the sheet, and the network sees them reduced, as it sees a photo.
        scales: the network's own Gaussians are drawn at target_px divided by each of these, and their losses averaged.
        target_zoom: range in place of the augmentation's; null: none.
    """

    steps: int = 0
    image_size_px: int = 0
    objects: int = 0
    target_px: int = 0
    minutes: float = 0.0
    detail: Literal[0, 1, 2, 4] = 0
    scales: tuple[int, ...] = (1,)
    target_zoom: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.steps and self.minutes:
            raise InputError("stages: expected steps or minutes, got both")
        check_ranges(
            self,
            "stages: ",
            minutes=(0.0, 1e6),
            steps=(0 if self.minutes else 1, MOST),
            image_size_px=(1, 8192),
            objects=(1, MOST),
            target_px=(0, 8192),
            scales=(1, 64),
        )
        if not self.scales or any(self.targets_px % scale for scale in self.scales):
            raise InputError(
                f"stages: scales: expected divisors of target_px, {self.targets_px}, got {list(self.scales)}"
            )
        if self.target_zoom is not None:
            check_zoom(self.target_zoom, "stages: ")

    @property
    def targets_px(self) -> int:
        """Side of the target images."""
        return self.target_px or self.image_size_px


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW with linear warm-up and cosine decay.

    Args:
        learning_rate: its peak.
        betas: of AdamW, 0..1.
        weight_decay: of AdamW; none on biases and norms.
        warmup_steps: length of the warm-up.
        final_share: last learning rate / peak, 0..1.
        clip: largest norm of the gradient.
        ema_decay: of the averaged weights, the ones that are evaluated and shipped, 0..1 per step.
    """

    learning_rate: float = 6e-4
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.01
    warmup_steps: int = 200
    final_share: float = 0.01
    clip: float = 1.0
    ema_decay: float = 0.998

    def __post_init__(self) -> None:
        check_ranges(
            self,
            "optimizer.",
            learning_rate=(0.0, 1.0),
            betas=(0.0, 0.999999),
            weight_decay=(0.0, 1e3),
            warmup_steps=(0, MOST),
            final_share=(0.0, 1.0),
            clip=(1e-9, 1e9),
            ema_decay=(0.0, 1.0),
        )


@dataclass(frozen=True)
class TrainingConfig:
    """One run.

    Args:
        output_dir: folder for checkpoints, losses.jsonl, scores.jsonl, TensorBoard logs and the final weights.
        data: folders of objects, SRN layout or transforms.json; [] where all examples show meshes.
        stages: run one after the other under one schedule.
        background: of objects without masks and alpha: white, black, or auto, one colour that is found for each object.
            With none the whole pictures are the subject. `python -m training.data.validate` shows the result.
        cache_dir: folder where decoded views are kept.
        model: name in configs/models, or a YAML file.
        initial_weights: checkpoint to start from, "pretrained" for the network in the package; it replaces model. "":
            none.
        symmetric: make the network symmetric (see ModelConfig), also where model or initial_weights do not.
        attention_px: sizes of feature maps that get self-attention beside those of model or initial_weights.
        trained: the whole network, or the head alone on fixed features of the U-Net. The head alone is quick, also on a
            CPU, and adapts a trained network to other targets.
        seed: of weights, samples, dropout and augmentation, 0..2^31 - 1.
        cone_deg: the panel's full viewing cone, degrees; 360 with elevation_deg 90 takes every view.
        cone_margin: targets lie within this times half the cone in azimuth of the source view.
        elevation_deg: targets lie within this elevation of the source view, degrees to either side.
        target_data: for each folder of data a folder with further views of the same objects, in the same worlds.
            Targets are drawn from these alone, sources from data. []: both from data.
        neighbour_deg: a view of data is a source only if another view looks within this angle, degrees.
        targets: target views per object, beside the source view itself.
        meshes: examples rendered from meshes in place of data.
        procedural: fraction of the examples of each step, 0..1, that show random objects in place of data. The device
            draws about 32 of them at once, for several steps.
        photographs: folder of photographs. Most parts of procedural objects and some of the meshes wear pieces of them;
            procedural objects then have lobes, turned profiles and relief too.
            `python -m training.data.gather_photographs` makes a folder. "": none.
        bfloat16: run the U-Net in bfloat16.
        device: cpu, cuda, or auto (cuda where there is one).
        compile: let torch.compile make kernels for the network, its loss and its batches. That takes one to four
            minutes at the start of every stage and process.
        threads: of torch; 0 leaves the default. Resuming gives the same losses to the last digit on a CPU, with the
            same number of threads and of processes. On a machine that is busy with other work, 1 can be several times
            faster than more: threads wait for the slowest of them.
        checkpoint_every: steps between resumable checkpoints.
        validation: folder of objects that the averaged weights are scored on during training. "": none.
        validate_every: steps between such scores.
        validation_objects: how many of its objects, spread evenly over the folder.
        optimizer: AdamW with linear warm-up and cosine decay.
        loss: weights of the terms of the loss, at least 0, not all 0.
        composite: the same for pictures with the sheet of detail, in stages that draw it.
        augmentation: how examples are varied.
    """

    output_dir: str
    data: list[str]
    stages: list[Stage]
    background: Choice = "auto"
    cache_dir: str = ".data/cache"
    model: str = "default"
    initial_weights: str = ""
    symmetric: bool = False
    attention_px: list[int] = field(default_factory=list)
    trained: Literal["network", "head"] = "network"
    seed: int = 0
    cone_deg: float = 40.0
    cone_margin: float = 1.5
    elevation_deg: float = 12.0
    target_data: list[str] = field(default_factory=list)
    neighbour_deg: float = 180.0
    targets: int = 3
    meshes: MeshOptions = field(default_factory=MeshOptions)
    procedural: float = 0.0
    photographs: str = ""
    bfloat16: bool = True
    device: Literal["auto", "cpu", "cuda"] = "auto"
    compile: bool = False
    threads: int = 0
    checkpoint_every: int = 100
    validation: str = ""
    validate_every: int = 500
    validation_objects: int = 24
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    loss: LossWeights = field(default_factory=LossWeights)
    composite: LossWeights = field(default_factory=LossWeights)
    augmentation: Augmentation = field(default_factory=Augmentation)

    def __post_init__(self) -> None:
        all_meshes = bool(self.meshes.folder) and self.meshes.fraction == 1
        for name in ("output_dir", "cache_dir", "data", "stages"):
            if not getattr(self, name) and not (name == "data" and all_meshes):
                raise InputError(f"{name}: expected {'a folder' if name.endswith('dir') else 'at least one'}, got none")
        check_ranges(
            self,
            seed=(0, 2**31 - 1),
            cone_deg=(0.0, 360.0),
            cone_margin=(0.0, 360.0),
            elevation_deg=(0.0, 180.0),
            neighbour_deg=(0.0, 180.0),
            attention_px=(1, 8192),
            targets=(1, 1000),
            procedural=(0.0, 1.0),
            threads=(0, 4096),
            checkpoint_every=(1, MOST),
            validate_every=(1, MOST),
            validation_objects=(1, MOST),
        )
        if any(bool(stage.minutes) != self.by_time for stage in self.stages):
            raise InputError("stages: expected minutes for all stages or for none")

    @property
    def azimuth_deg(self) -> float:
        """Targets lie within this azimuth of the source view, to either side."""
        return self.cone_deg / 2 * self.cone_margin

    @property
    def by_time(self) -> bool:
        """Whether stages end by the clock."""
        return self.stages[0].minutes > 0

    @property
    def total_steps(self) -> int:
        """Steps of all stages together; 0 where they end by the clock."""
        return sum(stage.steps for stage in self.stages)

    @property
    def total_seconds(self) -> float:
        """Time of all stages together; 0 where they end by steps."""
        return 60 * sum(stage.minutes for stage in self.stages)

    def is_over(self, step: int, seconds: float) -> bool:
        """Whether no stage is left for a step, the steps before it having taken some time."""
        return seconds >= self.total_seconds if self.by_time else step >= self.total_steps

    def scores_due(self, step: int) -> bool:
        """Whether the weights are scored after so many steps."""
        return bool(self.validation) and step > 0 and step % self.validate_every == 0

    def stage_at(self, step: int, seconds: float = 0.0) -> tuple[Stage, int]:
        """Return the stage of a step, and how many examples all steps before it have drawn.

        Args:
            seconds: Time that the steps before it have taken. Where stages end by the clock, examples are counted as if
                all steps had been of this stage.
        """
        drawn = 0
        for stage in self.stages if self.by_time else ():
            if seconds < 60 * stage.minutes:
                return stage, step * stage.objects
            seconds -= 60 * stage.minutes
        for stage in self.stages:
            if step < stage.steps:
                return stage, drawn + step * stage.objects
            step, drawn = step - stage.steps, drawn + stage.steps * stage.objects
        raise IndexError("step beyond the last stage")

    def identity(self) -> dict:
        """Return the fields that decide the results; a run may be resumed when they are the same.

        Of the folders of data only their own names, so that they may be moved.
        """
        fields = dataclasses.asdict(self)
        for name in (
            "output_dir",
            "cache_dir",
            "validation",
            "validate_every",
            "validation_objects",
            "checkpoint_every",
            "device",
            "compile",
        ):
            del fields[name]
        names = {name: [Path(folder).name for folder in fields[name]] for name in _FOLDERS}
        meshes = fields["meshes"] | {"folder": Path(self.meshes.folder).name}
        return fields | names | {"photographs": Path(self.photographs).name, "meshes": meshes}

    def differences(self, stored: object) -> list[str]:
        """Names of the fields in which this run differs from the one whose identity() was stored as JSON.

        A field that did not exist when it was stored had the value that is now its default. Folders of data were not
        stored at first: they count as the same.
        """
        if not isinstance(stored, dict):
            return sorted(self.identity())
        plain = TrainingConfig("unused", ["unused"], [Stage(1, 1, 1)])
        own, defaults = (json.loads(json.dumps(run.identity())) for run in (self, plain))
        stored = {name: value for name, value in stored.items() if _REMOVED.get(name, ...) != value}
        stored = _filled(stored, defaults | {name: own[name] for name in _FOLDERS})
        stored["stages"] = [_filled(stage, defaults["stages"][0]) for stage in stored["stages"]]
        return sorted(name for name in own.keys() | stored.keys() if own.get(name) != stored.get(name))


def _filled(values: dict, defaults: dict) -> dict:
    """Complete values by the defaults, also in dictionaries inside."""
    inside = {
        name: _filled(value, defaults[name])
        for name, value in values.items()
        if isinstance(value, dict) and isinstance(defaults.get(name), dict)
    }
    return defaults | values | inside
