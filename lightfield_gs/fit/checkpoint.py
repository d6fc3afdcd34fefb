"""Checkpoints: everything that a fit needs to go on to the same bits, in one file that is whole or not there.

A safetensors file. Its tensors are the fields with their moments, the counters, the tally and what else is optimised;
its metadata say of which fit it is. Random numbers, orders and schedules follow from settings and step, so that they
need no place in it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.fit.fields import Fields
from lightfield_gs.fit.settings import FitSettings
from lightfield_gs.fit.tally import Tally
from lightfield_gs.fit.trainer import Trainer
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.io.json_file import parse_json

FILE = "checkpoint.safetensors"
_KEY, _VERSION = "lightfield_gs.fit", 1
_WAY_OUT = "give the same again, another --run folder, or --fresh to start over"


@dataclass(frozen=True)
class Origin:
    """Which fit a checkpoint is of: its settings, and of the capture what decides the result, each as a digest."""

    settings: dict[str, Any]
    capture: dict[str, str]

    @classmethod
    def of(
        cls, settings: FitSettings, capture: Capture, train: Sequence[int], shares: Sequence[float] | None = None
    ) -> Origin:
        """Of a fit to the photographs `train` of a capture, each of them in this share of the epochs; None: in all."""
        parts = {
            "names of photographs": json.dumps(capture.names).encode(),
            "sizes": np.asarray(capture.sizes_px, np.int64).tobytes(),
            "cameras": capture.world_to_camera.tobytes() + capture.intrinsics.tobytes(),
            "points": capture.points.tobytes() + capture.colours.tobytes(),
            "photographs held out": json.dumps(list(train)).encode(),
            "photographs in the cone": json.dumps(shares and list(shares)).encode(),
        }
        digests = {name: hashlib.sha256(data).hexdigest()[:16] for name, data in parts.items()}
        return cls(json.loads(json.dumps(asdict(settings))), digests)

    def check(self, path: Path, stored: Mapping[str, Any]) -> None:
        """Raises InputError that names what differs from a stored one."""
        settings, capture = stored["settings"], stored["capture"]
        changed = [
            f"{field.name} was {shown(settings.get(field.name))} and is {shown(self.settings[field.name])}"
            for field in fields(FitSettings)
            if settings.get(field.name) != self.settings[field.name]
        ]
        changed += [f"other {name}" for name, digest in self.capture.items() if capture.get(name) != digest]
        if changed:
            raise InputError(f"{path}: this run was begun otherwise: {'; '.join(changed)}; {_WAY_OUT}")


def save(path: Path, trainer: Trainer, origin: Origin, history: list[dict[str, Any]]) -> None:
    """Writes where the fit stands. history: evaluations so far, for JSON. Raises InputError where it cannot."""
    from safetensors.torch import save

    counters = {f"counters.{name}": tensor for name, tensor in vars(trainer.counters).items()}
    tally = {f"tally.{name}": tensor for name, tensor in trainer.tally.tensors().items()}
    extra = {f"extra.{name}": tensor for name, tensor in trainer.extra.items()}
    tensors = {f"fields.{name}": tensor for name, tensor in trainer.fields.tensors().items()}
    said = {"version": _VERSION, "step": trainer.done, "history": history, **asdict(origin)}
    on_host = {name: t.detach().to("cpu").contiguous() for name, t in {**tensors, **counters, **tally, **extra}.items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(on_host, {_KEY: json.dumps(said)}))


def restore(path: Path, trainer: Trainer, origin: Origin) -> list[dict[str, Any]]:
    """Brings a trainer to where a checkpoint stood, and returns the evaluations up to there.

    Raises InputError where the file is no checkpoint, and where it is of another capture or of other settings: it
    says which.
    """
    said, tensors = _read(path)
    origin.check(path, said)
    tensors = {name: tensor.to(trainer.device) for name, tensor in tensors.items()}
    trainer.fields = Fields.of_tensors(_below("fields", tensors))
    trainer.tally = Tally(trainer.fields.count, trainer.settings, trainer.device)
    trainer.tally.set(_below("tally", tensors))
    counters = _below("counters", tensors)
    for name, own in vars(trainer.counters).items():
        own.copy_(counters[name])
    extra = _below("extra", tensors)
    for name, own in trainer.extra.items():
        own.copy_(extra[name])
    trainer.done = int(said["step"])
    return said["history"]


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import load

    try:
        with safe_open(path, framework="pt") as file:
            said = parse_json((file.metadata() or {})[_KEY])
        if said["version"] != _VERSION:
            raise InputError(
                f"{path}: expected a checkpoint of version {_VERSION}, got {shown(said['version'])}; {_WAY_OUT}"
            )
        return said, load(path.read_bytes())
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        words = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected a checkpoint of a fit, but {words}; {_WAY_OUT}") from None


def _below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(f"{prefix}."): t for name, t in tensors.items() if name.startswith(f"{prefix}.")}
