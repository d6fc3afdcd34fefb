"""Configuration of a training run for hidden surfaces, read from configs/training/hidden.yaml."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Literal

from training.config import OptimizerConfig
from training.hidden.compositions import CompositionOptions
from training.ranges import MOST, check_ranges


@dataclass(frozen=True)
class HiddenLossWeights:
    """Weights of the loss's terms; each is a mean over the known pixels of the holes.

    Args:
        colour: absolute differences of colours.
        gradient: absolute differences of their steps to the neighbours, at three scales.
        texture: differences of the strength of details of a kind, whatever their places: blurred textures lack it.
        depth: absolute differences of log disparity.
        adversarial: of a second network's verdict, which learns to tell filled holes from true ones.
    """

    colour: float = 1.0
    gradient: float = 0.5
    texture: float = 1.0
    depth: float = 0.5
    adversarial: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(self, "loss.", **dict.fromkeys((f.name for f in dataclasses.fields(self)), (0.0, 100.0)))


@dataclass(frozen=True)
class HiddenConfig:
    """A run.

    Args:
        output_dir: folder of the checkpoint, the log and the weights.
        meshes: folder of mesh packs with their index; its split "val" is held out.
        photographs: folder of photographs.
        held_out: file name patterns of photographs that training never sees.
        leaves: number of made-up pictures beside the photographs.
        steps: optimizer steps.
        seconds: time of the whole run over all resumptions, after which it ends early; 0: no limit.
        batch: examples of a step.
        batches: batches that are drawn at once.
        uses: how often each drawn batch is used, in mirror images and with other colours.
        compositions: ranges of the compositions.
        optimizer: AdamW and its schedule.
        loss: weights of the terms.
        seed: of the initial weights and the compositions.
        device: where to run.
        compile: let torch.compile make some kernels.
        checkpoint_every: steps.
        score_every: steps.
        scored: held-out compositions of a score.
    """

    output_dir: str
    meshes: str
    photographs: str
    held_out: list[str] = field(default_factory=list)
    leaves: int = 256
    steps: int = 12000
    seconds: float = 0.0
    batch: int = 24
    batches: int = 2
    uses: int = 4
    compositions: CompositionOptions = field(default_factory=CompositionOptions)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    loss: HiddenLossWeights = field(default_factory=HiddenLossWeights)
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    compile: bool = False
    checkpoint_every: int = 500
    score_every: int = 1000
    scored: int = 24

    def __post_init__(self) -> None:
        check_ranges(
            self,
            leaves=(0, 4096),
            steps=(1, MOST),
            seconds=(0.0, 1e9),
            batch=(1, 1024),
            batches=(1, 64),
            uses=(1, 64),
            seed=(0, MOST),
            checkpoint_every=(1, MOST),
            score_every=(1, MOST),
            scored=(1, 4096),
        )

    def identity(self) -> dict:
        """Return the fields that decide the results; a run may be resumed when they are the same."""
        fields = dataclasses.asdict(self)
        places = ("output_dir", "meshes", "photographs", "seconds", "device", "compile")
        for name in (*places, "checkpoint_every", "score_every", "scored"):
            del fields[name]
        return fields

    def differences(self, stored: object) -> list[str]:
        """Return the names of the fields in which this run differs from the one whose identity() was stored."""
        own = json.loads(json.dumps(self.identity()))
        stored = stored if isinstance(stored, dict) else {}
        return sorted(name for name in own.keys() | stored.keys() if own.get(name) != stored.get(name))
