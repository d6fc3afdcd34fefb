"""Open a network for depths, by the files in its folder."""

from __future__ import annotations

import functools
import json
from pathlib import Path

from lightfield_gs.photo.depth_models.model import DepthModel


@functools.lru_cache(maxsize=1)
def open_model(folder: str, device: str) -> DepthModel:
    """Return the network in a folder; the last one stays in memory.

    Args:
        folder: Of its files.
        device: "cpu" or "cuda".

    Raises:
        InputError: It is of no family that is read, or its weights are not.
    """
    root = Path(folder)
    if (path := root / "model.pt").is_file():
        from lightfield_gs.photo.depth_models.moge import MoGe2

        return MoGe2(path, device)
    if paths := sorted(root.glob("*.pth")):
        from lightfield_gs.photo.depth_models.video_depth_anything import VideoDepthAnything

        return VideoDepthAnything(paths[0], device)
    if any(root.glob("*.safetensors")) and _is_of_depth_anything_3(root / "config.json"):
        from lightfield_gs.photo.depth_models.depth_anything_3 import DepthAnything3

        return DepthAnything3(root, device)
    from lightfield_gs.photo.depth_models.pipeline import Pipeline

    return Pipeline(root, device)


def _is_of_depth_anything_3(path: Path) -> bool:
    """Return whether a configuration is that of a Depth Anything 3; those of transformers name a model type."""
    try:
        facts = json.loads(path.read_text())
    except (OSError, ValueError):
        return False
    return isinstance(facts, dict) and "model_type" not in facts and str(facts.get("model_name", "")).startswith("da3")
