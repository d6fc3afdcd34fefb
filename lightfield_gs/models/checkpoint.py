"""Checkpoint files: float16 weights as safetensors, with the model's configuration as JSON in the metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.file_kinds import refuse_stand_in
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.models.config import ModelConfig

_CONFIG_KEY = "lightfield_gs.model_config"


def save_weights(path: Path, config: ModelConfig, state: Mapping[str, Tensor], notes: dict[str, str]) -> None:
    """Write the weights of a network to path; the file appears complete or not at all. notes: further metadata."""
    from safetensors.torch import save

    weights = {name: tensor.detach().to("cpu", torch.float16).contiguous() for name, tensor in state.items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(weights, notes | {_CONFIG_KEY: json.dumps(config.to_dict())}))


def read_weights(path: Path) -> tuple[ModelConfig, dict[str, Tensor]]:
    """Configuration and float32 weights of a checkpoint. Raises InputError when the file is none."""
    from safetensors import SafetensorError, safe_open
    from safetensors.torch import load

    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
        # Read at once: one by one the open file would never free 64 bytes for each (safetensors 0.8)
        weights = {name: tensor.float() for name, tensor in load(path.read_bytes()).items()}
        config = parse_json(metadata[_CONFIG_KEY])
    except FileNotFoundError:
        raise InputError(f"{path}: found no such checkpoint") from None
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        refuse_stand_in(path)
        raise InputError(
            f"{path}: expected a SplatterNet checkpoint (safetensors with its configuration), "
            f"but {' '.join(str(error).split())[:200]}"
        ) from None
    return ModelConfig.from_dict(config), weights
