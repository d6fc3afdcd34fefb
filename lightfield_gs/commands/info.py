"""`lightfield-gs info`: what a file holds."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from lightfield_gs.errors import InputError
from lightfield_gs.io.text_file import read_text
from lightfield_gs.io.yaml_file import MOST_BYTES
from lightfield_gs.panel import Panel


def run(args: argparse.Namespace) -> None:
    """Prints what args.file holds, a line a fact. Raises InputError."""
    for key, value in describe(args.file, args.device_serial):
        print(f"{key}: {value}")


def describe(path: Path, serial: str | None = None) -> list[tuple[str, object]]:
    """Facts about a .ply, an image, a panel or rig (.yaml, .json, or a panel's name) or a .safetensors file.

    serial: of the display, where the file has several.
    """
    suffix = path.suffix.lower()
    if serial is not None and suffix != ".json":
        raise InputError(f"--device-serial is about Looking Glass calibrations in a .json file, and {path} is none")
    if suffix in (".ply", ".spz", ".splat", ".ksplat", ".sog"):
        return _scene(path)
    if suffix == ".safetensors":
        return _checkpoint(path)
    if suffix in (".yaml", ".yml") and _is_rig(path):
        return _rig(path)
    if suffix in (".yaml", ".yml", ".json") or not suffix and not path.exists():
        return [("panel", path), *Panel.load(path, serial=serial).to_dict().items()]
    return _image(path)


def _scene(path: Path) -> list[tuple[str, object]]:
    from lightfield_gs.commands.encode import scene_hash
    from lightfield_gs.gaussians import Gaussians

    scene = Gaussians.load(path)
    quantile = [scene.means.sort(0).values[int(share * (scene.count - 1))].tolist() for share in (0.01, 0.5, 0.99)]
    facts: list[tuple[str, object]] = [
        ("gaussians", scene.count), ("sh_degree", scene.sh_degree), ("sha256", scene_hash(scene)),
        ("median opacity", f"{scene.opacities.median():.3f}"), ("median scale", f"{scene.scales.median():.4g}")]
    for name, values in zip(("1 %", "median", "99 %"), quantile):
        facts.append((f"centres, {name}", ", ".join(f"{value:.4g}" for value in values)))
    return facts


def _image(path: Path) -> list[tuple[str, object]]:
    from lightfield_gs.io.images import read_info

    info = read_info(path)
    return [("image", f"{info.width_px} x {info.height_px}, {info.channels} channels, {info.sample_type}"),
            *info.metadata.items()]


def _is_rig(path: Path) -> bool:
    return "world_to_camera" in read_text(path, MOST_BYTES, "YAML")


def _rig(path: Path) -> list[tuple[str, object]]:
    from lightfield_gs.rig import Rig

    return [("rig", path), *Rig.from_yaml(path).to_dict().items()]


def _checkpoint(path: Path) -> list[tuple[str, object]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "numpy") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}
            metadata = file.metadata() or {}
            counts = [_product(part.get_shape()) for part in slices.values()]
            types = sorted({part.get_dtype() for part in slices.values()})
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is no safetensors file: {' '.join(str(error).split())[:200]}") from error
    return [("checkpoint", path), ("parameters", sum(counts)), ("tensors", len(counts)),
            ("types", ", ".join(types)), ("bytes", path.stat().st_size),
            *((key, json.dumps(value) if not isinstance(value, str) else value) for key, value in metadata.items())]


def _product(shape: list[int]) -> int:
    count = 1
    for size in shape:
        count *= size
    return count
