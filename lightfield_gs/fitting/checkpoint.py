"""Checkpoints of a fit, from which it goes on to the same bits.

A checkpoint is a safetensors file; it is written completely or not at all. Its tensors are the parameters with their
moments, the counters, the statistics of density control, and poses and exposure; its metadata identify the fit. Random
numbers, orders and schedules follow from settings and step.
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
from lightfield_gs.fitting.density import DensityStatistics
from lightfield_gs.fitting.settings import FORMER_NAMES, FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.atomic import atomic_path, remove_file
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.io.text_files import parse_json

FILE = "checkpoint.safetensors"
_KEY, _VERSION = "lightfield-gs fit", 1
_FORMER_MOST, _FORMER_FEW, _FORMER_MANY = 0.2, 12, 48  # a former default of dropout, see _former_dropout
_FORMER_SETTINGS = {"loss": "l1-ssim"}  # of checkpoints from before there was a choice
_WAY_OUT = "give the same again, another folder=, or fresh=True to start over"


@dataclass(frozen=True)
class Identity:
    """The fit of a checkpoint.

    Attributes:
        settings: as JSON has them.
        capture: digests of the parts of the capture that decide the result.
        photographs: the sum of the weights of the training photographs: their number, if there is no cone.
    """

    settings: dict[str, Any]
    capture: dict[str, str]
    photographs: float

    @classmethod
    def make(
        cls,
        settings: FitSettings,
        capture: Capture,
        train: Sequence[int],
        weights: Sequence[float] | None = None,
        loss: Any = None,
    ) -> Identity:
        """Return the identity of a fit.

        Args:
            settings: of the fit.
            capture: its photographs and cameras.
            train: indices of the training photographs.
            weights: of the training photographs, in a cone.
            loss: the function in place of the usual loss, known by its name.
        """
        cameras = capture.world_to_camera, capture.intrinsics, capture.readouts
        parts = {
            "names of photographs": json.dumps(capture.names).encode(),
            "cameras": b"".join(part.tobytes() for part in cameras if part is not None),
            "points": capture.points.tobytes() + capture.colours.tobytes(),
            "photographs held out": json.dumps(list(train)).encode(),
            "cone": json.dumps(weights).encode(),
        }
        if loss is not None:
            parts["loss"] = loss_name(loss).encode()
        digests = {name: _digest(data) for name, data in parts.items()} | {"sizes": sizes_digest(capture)}
        return cls(json.loads(json.dumps(asdict(settings))), digests, len(train) if weights is None else sum(weights))

    def check_file(self, path: Path, fresh: bool) -> None:
        """Check a checkpoint if there is one; with `fresh`, remove it instead."""
        if fresh:
            remove_file(path)
        elif path.exists():
            with _explain_damage(path):
                self.check(path, _read(path, with_tensors=False)[0])

    def check(self, path: Path, stored: Mapping[str, Any]) -> None:
        """Raise an InputError that names the differences from the metadata of a checkpoint, if there are any."""
        known = {FORMER_NAMES.get(name, name): value for name, value in stored["settings"].items()}
        settings = _FORMER_SETTINGS | known
        capture = stored["capture"]
        if settings.get("dropout", 0.0) is None:
            settings = {**settings, "dropout": _former_dropout(self.photographs)}
        changed = [
            f"{field.name} was {shown(settings.get(field.name))} and is {shown(self.settings[field.name])}"
            for field in fields(FitSettings)
            if settings.get(field.name) != self.settings[field.name]
        ]
        names = dict.fromkeys([*self.capture, *capture])
        changed += [f"other {name}" for name in names if capture.get(name) != self.capture.get(name)]
        if changed:
            raise InputError(f"{path}: this run was begun otherwise: {'; '.join(changed)}; {_WAY_OUT}")


def loss_name(loss: Any) -> str:
    """Return the name by which a function of one's own is known."""
    return str(getattr(loss, "__qualname__", type(loss).__qualname__))


def sizes_digest(capture: Capture) -> str:
    """Return the digest of the photographs' sizes, as an Identity has it."""
    return _digest(np.asarray(capture.sizes_px, np.int64).tobytes())


def stored_sizes_digest(path: Path) -> str | None:
    """Return the digest of the sizes of a checkpoint's photographs; None where there is no checkpoint.

    Raises:
        InputError: the file is no checkpoint.
    """
    if not path.exists():
        return None
    with _explain_damage(path):
        return str(_read(path, with_tensors=False)[0]["capture"]["sizes"])


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def save(path: Path, trainer: Trainer, identity: Identity, history: list[dict[str, Any]]) -> None:
    """Write a checkpoint.

    Args:
        path: where to.
        trainer: the fit.
        identity: of the fit.
        history: evaluations so far, for JSON.

    Raises:
        InputError: the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    owned = {f"fields.{name}": tensor for name, tensor in trainer.state.tensors().items()} | _targets(trainer)
    tensors = {name: tensor.detach().to("cpu").contiguous() for name, tensor in owned.items()}
    metadata = {"version": _VERSION, "step": trainer.done, "history": history, **asdict(identity)}
    with atomic_path(path) as temporary:
        try:
            save_file(tensors, temporary, {_KEY: json.dumps(metadata)})
        except SafetensorError as error:
            raise InputError(f"cannot write {path}: {' '.join(str(error).split())[:200]}") from None


def restore(path: Path, trainer: Trainer, identity: Identity) -> list[dict[str, Any]]:
    """Bring a trainer to the step of a checkpoint, and return the evaluations up to there.

    Args:
        path: the checkpoint.
        trainer: a trainer before its first step.
        identity: of its fit.

    Raises:
        InputError: the file is no checkpoint, or is of another capture or of other settings; the message names them.
    """
    with _explain_damage(path):
        metadata, tensors = _read(path)
        identity.check(path, metadata)
        fields = {name.removeprefix("fields."): t for name, t in tensors.items() if name.startswith("fields.")}
        trainer.state = trainer.state.restored(fields)
        trainer.statistics = DensityStatistics(trainer.state.count, trainer.settings, trainer.device)
        for name, own in _targets(trainer).items():
            own.copy_(tensors[name])
        trainer.done = int(metadata["step"])
        return list(metadata["history"])


def _former_dropout(photographs: float) -> float:
    """Return the dropout of a fit whose checkpoint holds null: 0.2 up to 12 photographs, falling to 0 at 48."""
    return _FORMER_MOST * min(1.0, max(0.0, (_FORMER_MANY - photographs) / (_FORMER_MANY - _FORMER_FEW)))


def _read(path: Path, with_tensors: bool = True) -> tuple[dict[str, Any], dict[str, Tensor]]:
    from safetensors import safe_open
    from safetensors.torch import load

    with safe_open(path, framework="pt") as file:
        metadata = parse_json((file.metadata() or {})[_KEY])
    if metadata["version"] != _VERSION:
        raise InputError(
            f"{path}: expected a checkpoint of version {_VERSION}, got {shown(metadata['version'])}; {_WAY_OUT}"
        )
    # Read at once: one by one the open file would never free 64 bytes for each (safetensors 0.8)
    return metadata, load(path.read_bytes()) if with_tensors else {}


@contextmanager
def _explain_damage(path: Path) -> Iterator[None]:
    """Raise InputError for the errors of a file that is no checkpoint, or is incomplete."""
    from safetensors import SafetensorError

    try:
        yield
    except InputError:
        raise
    except (SafetensorError, OSError, LookupError, TypeError, ValueError, AttributeError) as error:
        words = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: expected a checkpoint of a fit, but {words}; {_WAY_OUT}") from None


def _targets(trainer: Trainer) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint beside the Gaussians; restoring writes to them."""
    groups = {"counters": trainer.counters.tensors(), "tally": trainer.statistics.tensors(), "extra": trainer.extra}
    return {f"{group}.{name}": tensor for group, tensors in groups.items() for name, tensor in tensors.items()}
