"""Resumable checkpoints: complete or not there at all."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Protocol

import torch

from lightfield_gs.base.cli_messages import is_out_of_memory
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path


class RunConfig(Protocol):
    """Configuration of a run."""

    def differences(self, stored: object) -> list[str]:
        """Return the names of the fields that differ from those that a checkpoint stores as its identity."""


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write state to path; a crash at any moment leaves the former file."""
    with atomic_path(path) as temporary:
        with open(temporary, "wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())


def load_checkpoint(path: Path, config: RunConfig) -> dict[str, Any]:
    """Read a checkpoint. Raises InputError when it is damaged or belongs to a run with another configuration.

    What may come of a whole file is let through: OSError, and errors of memory.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        stored = json.loads(state["identity"])
    except Exception as error:  # torch.load raises many types on damaged files
        if isinstance(error, OSError) or is_out_of_memory(error):
            raise
        reason = type(error).__name__
        raise InputError(f"{path}: damaged checkpoint ({reason}): remove it to start the run anew") from None
    if changed := config.differences(stored):
        raise InputError(
            f"{path}: belongs to a run with another configuration ({', '.join(changed)} differ): choose "
            "another output_dir, or remove the checkpoint"
        )
    return state


def cut_log(path: Path, step: int) -> None:
    """Drop the lines of a JSON-lines log that were written at or after a step, or that a crash left unfinished."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text().splitlines():
        try:
            if json.loads(line)["step"] < step:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError):  # no JSON, or no object with a step
            break
    with atomic_path(path) as temporary:
        temporary.write_text("".join(kept))
