"""Checkpoints: everything that a fit needs to go on to the same bits, in one file that is whole or not there.

A safetensors file. Its tensors are the fields with their moments, the counters, the tally and what else is optimised;
its metadata say of which fit it is. Random numbers, orders and schedules follow from settings and step, so that they
need no place in it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.dropout import former_default
from lightfield_gs.fitting.fields import Fields
from lightfield_gs.fitting.settings import FORMER_NAMES, FitSettings
from lightfield_gs.fitting.tally import Tally
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.atomic import atomic_path, remove_file
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.io.text_files import parse_json

FILE = "checkpoint.safetensors"
_KEY, _VERSION = "lightfield-gs fit", 1
_WAY_OUT = "give the same again, another --run folder, or --fresh to start over"


@dataclass(frozen=True)
class Identity:
    """Which fit a checkpoint is of: its settings, and of the capture what decides the result, each as a digest.

    photographs: how many it is to; in a cone, the sum of their shares.
    """

    settings: dict[str, Any]
    capture: dict[str, str]
    photographs: float

    @classmethod
    def of(
        cls, settings: FitSettings, capture: Capture, train: Sequence[int], shares: Sequence[float] | None = None
    ) -> Identity:
        """Of a fit to the photographs `train` of a capture. shares: in how many of the epochs each is, in a cone."""
        parts = {
            "names of photographs": json.dumps(capture.names).encode(),
            "sizes": np.asarray(capture.sizes_px, np.int64).tobytes(),
            "cameras": capture.world_to_camera.tobytes() + capture.intrinsics.tobytes(),
            "points": capture.points.tobytes() + capture.colours.tobytes(),
            "photographs held out": json.dumps(list(train)).encode(),
            "cone": json.dumps(shares).encode(),
        }
        digests = {name: hashlib.sha256(data).hexdigest()[:16] for name, data in parts.items()}
        return cls(json.loads(json.dumps(asdict(settings))), digests, len(train) if shares is None else sum(shares))

    def check_file(self, path: Path, fresh: bool) -> None:
        """As check, of a checkpoint where there is one. fresh: it is removed instead."""
        if fresh:
            remove_file(path)
        elif path.exists():
            with _a_checkpoint(path):
                self.check(path, _read(path, with_tensors=False)[0])

    def check(self, path: Path, stored: Mapping[str, Any]) -> None:
        """Raises InputError that names what differs from a stored one."""
        settings = {FORMER_NAMES.get(name, name): value for name, value in stored["settings"].items()}
        capture = stored["capture"]
        if settings.get("dropout", 0.0) is None:
            settings = {**settings, "dropout": former_default(self.photographs)}
        changed = [
            f"{field.name} was {shown(settings.get(field.name))} and is {shown(self.settings[field.name])}"
            for field in fields(FitSettings)
            if settings.get(field.name) != self.settings[field.name]
        ]
        names = dict.fromkeys([*self.capture, *capture])
        changed += [f"other {name}" for name in names if capture.get(name) != self.capture.get(name)]
        if changed:
            raise InputError(f"{path}: this run was begun otherwise: {'; '.join(changed)}; {_WAY_OUT}")


def save(path: Path, trainer: Trainer, identity: Identity, history: list[dict[str, Any]]) -> None:
    """Writes where the fit stands. history: evaluations so far, for JSON. Raises InputError where it cannot."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    groups = {
        "fields": trainer.fields.tensors(),
        "counters": vars(trainer.counters),
        "tally": trainer.tally.tensors(),
        "extra": trainer.extra,
    }
    tensors = {
        f"{group}.{name}": tensor.detach().to("cpu").contiguous()
        for group, named_tensors in groups.items()
        for name, tensor in named_tensors.items()
    }
    said = {"version": _VERSION, "step": trainer.done, "history": history, **asdict(identity)}
    with atomic_path(path) as temporary:
        try:
            save_file(tensors, temporary, {_KEY: json.dumps(said)})
        except SafetensorError as error:
            raise InputError(f"cannot write {path}: {' '.join(str(error).split())[:200]}") from None


def restore(path: Path, trainer: Trainer, identity: Identity) -> list[dict[str, Any]]:
    """Brings a trainer to where a checkpoint stood, and returns the evaluations up to there.

    Raises InputError where the file is no checkpoint, and where it is of another capture or of other settings: it
    says which.
    """
    with _a_checkpoint(path):
        said, on_host = _read(path)
        identity.check(path, said)
        tensors = {name: tensor.to(trainer.device) for name, tensor in on_host.items()}
        trainer.fields = Fields.from_tensors(_below("fields", tensors))
        trainer.tally = Tally(trainer.fields.count, trainer.settings, trainer.device)
        trainer.tally.set(_below("tally", tensors))
        for prefix, owned in (("counters", vars(trainer.counters)), ("extra", trainer.extra)):
            stored = _below(prefix, tensors)
            for name, own in owned.items():
                own.copy_(stored[name])
        trainer.done = int(said["step"])
        return list(said["history"])


def _read(path: Path, with_tensors: bool = True) -> tuple[dict[str, Any], dict[str, Tensor]]:
    from safetensors import safe_open
    from safetensors.torch import load

    with safe_open(path, framework="pt") as file:
        said = parse_json((file.metadata() or {})[_KEY])
    if said["version"] != _VERSION:
        raise InputError(
            f"{path}: expected a checkpoint of version {_VERSION}, got {shown(said['version'])}; {_WAY_OUT}"
        )
    # Read at once: one by one the open file would never free 64 bytes for each (safetensors 0.8)
    return said, load(path.read_bytes()) if with_tensors else {}


@contextmanager
def _a_checkpoint(path: Path) -> Iterator[None]:
    """Turns what goes wrong with a file that is no checkpoint, or not a whole one, into an InputError."""
    from safetensors import SafetensorError

    try:
        yield
    except InputError:
        raise
    except (SafetensorError, OSError, LookupError, TypeError, ValueError, AttributeError) as error:
        words = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected a checkpoint of a fit, but {words}; {_WAY_OUT}") from None


def _below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(f"{prefix}."): t for name, t in tensors.items() if name.startswith(f"{prefix}.")}
