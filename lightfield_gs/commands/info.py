"""`lightfield-gs info`: the contents of a file, or the devices of this machine."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.file_kinds import refuse_stand_in, refuse_unsupported
from lightfield_gs.io.scenes.files import is_scene_path
from lightfield_gs.io.text_files import MOST_BYTES, read_text
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from torch import Tensor

_CAMERAS_SHOWN = 20


def run(args: argparse.Namespace) -> None:
    """Print the facts of args.file, or of the devices, a line each. Raises InputError."""
    if args.devices == (args.file is not None):
        raise InputError("info: a FILE or --devices is required, and not both")
    if args.report and not args.devices:
        raise InputError("info: --report is of --devices: info --devices --report")
    if args.devices:
        print("\n".join(f"{name}: {facts}" for name, facts in describe_devices()))
        if args.report:
            _print_report()
        return
    for key, value in describe(args.file, args.device_serial, args.skip_invalid, args.up, args.time, args.lod):
        print(f"{key}: {value}")


def _print_report() -> None:
    """Print what to send of the adapters. Raises InputError."""
    from lightfield_gs.webgpu.adapters import missing

    if (lacking := missing()) is not None:
        raise InputError(f"info --report: {lacking}")
    from lightfield_gs.webgpu.report import report

    print(f"\n{report()}")


def describe_devices() -> list[tuple[str, str]]:
    """Return a line on each device of this machine, with the result of its self-test."""
    from lightfield_gs.base.device import missing_for_cuda
    from lightfield_gs.base.system import cores
    from lightfield_gs.webgpu.adapters import adapters, missing
    from lightfield_gs.webgpu.self_test import self_test

    lines = [("cpu", f"{len(cores())} cores"), ("cuda", missing_for_cuda() or "ready")]
    if (lacking := missing() or (None if adapters() else "no adapter for Vulkan, Metal or D3D12")) is not None:
        lines.append(("webgpu", lacking))
    for index, adapter in enumerate(adapters()):
        limits = adapter.limits
        facts = f"{adapter}, driver {adapter.driver or 'unnamed'}"
        room = f"buffers of {limits.buffer_bytes >> 20} MiB, {limits.binding_bytes >> 20} MiB at once"
        result = "not drawn on, a program of the CPU" if adapter.is_cpu else self_test(adapter).words()
        lines.append((f"webgpu:{index}", f"{facts}; {room}; {result}"))
    return lines


def describe(
    path: Path,
    serial: str | None = None,
    skip_invalid: bool = False,
    up: str | None = None,
    time: float | None = None,
    lod: int | None = None,
) -> list[tuple[str, object]]:
    """Return facts about a file.

    Args:
        path: a file of Gaussians, an image, a panel or rig (.yaml, .json, a panel's name) or a .safetensors file.
        serial: of the display, where the file has several.
        skip_invalid: of a scene, see `read_scene`.
        up: the axis that points up in a scene, in place of the file's.
        time: of a scene, see `read_scene`.
        lod: of a scene, see `read_scene`.

    Raises:
        InputError: the file cannot be read, or does not take an option.
    """
    suffix = path.suffix.lower()
    if serial is not None and suffix != ".json":
        raise InputError(f"--device-serial is about Looking Glass calibrations in a .json file, and {path} is none")
    if is_scene_path(path):
        return _scene(path, skip_invalid, up, time, lod)
    for option, value in (("--up", up), ("--time", time), ("--lod", lod)):
        if value is not None:
            raise InputError(f"{option} is for files of Gaussians, and {path} is none; leave it out")
    if suffix == ".safetensors":
        return _checkpoint(path)
    if suffix in (".yaml", ".yml") and _is_rig(path):
        return _rig(path)
    if suffix == ".json" and _is_camera_file(path):
        return _camera_file(path)
    refuse_unsupported(path)
    if suffix in (".yaml", ".yml", ".json") or not suffix and not path.exists():
        return [("panel", path), *Panel.load(path, serial=serial).to_dict().items()]
    return _image(path)


def _scene(
    path: Path, skip_invalid: bool, up: str | None, time: float | None, lod: int | None
) -> list[tuple[str, object]]:
    import torch

    from lightfield_gs.app.cameras import fit_and_cameras, scene_up
    from lightfield_gs.app.scene import read_noted
    from lightfield_gs.scene.gaussians import scene_hash

    file = read_noted(path, skip_invalid, time, lod)
    scene = file.gaussians
    centres = (scene.means.double() + scene.means.new_tensor(scene.origin, dtype=torch.float64)).sort(0).values
    quantile = [centres[int(fraction * (scene.count - 1))].tolist() for fraction in (0.01, 0.5, 0.99)]
    facts: list[tuple[str, object]] = [
        ("format", file.kind),
        ("gaussians", scene.count),
        ("sh_degree", scene.sh_degree),
        ("sha256", scene_hash(scene)),
        ("axes", scene_up(up, file).describe()),
        *fit_and_cameras(file),
        ("opacity", _range(scene.opacities)),
        ("median opacity", f"{scene.opacities.median():.3f}"),
        ("scale", _range(scene.scales)),
        ("median scale", f"{scene.scales.median():.4g}"),
    ]
    digits = _digits(centres)
    if any(scene.origin):
        facts.append(("origin", ", ".join(f"{part:.0f}" for part in scene.origin)))
    for name, values in (
        ("lowest", centres[0].tolist()),
        *zip(("1 %", "median", "99 %"), quantile),
        ("highest", centres[-1].tolist()),
    ):
        facts.append((f"centres, {name}", ", ".join(f"{value:.{digits}g}" for value in values)))
    facts.append(
        (
            "extent",
            " x ".join(f"{side:.4g}" for side in (centres[-1] - centres[0]).tolist())
            + " (1 % to 99 %: "
            + " x ".join(f"{b - a:.4g}" for a, b in zip(quantile[0], quantile[2]))
            + ")",
        )
    )
    return facts


def _range(values: Tensor) -> str:
    return f"{values.min():.4g} to {values.max():.4g}"


def _digits(centres: Tensor) -> int:
    """Return the digits, 4 to 17, that show centres [N, 3] to a ten-thousandth of the extent of most."""
    spread = float((centres[int(0.99 * (len(centres) - 1))] - centres[int(0.01 * (len(centres) - 1))]).max())
    farthest = float(centres.abs().max())
    return 4 if spread <= 0 or farthest <= 0 else min(17, 4 + max(0, math.ceil(math.log10(farthest / spread))))


def _image(path: Path) -> list[tuple[str, object]]:
    from lightfield_gs.io.images import read_info
    from lightfield_gs.photo.embedded_depth import embedded_facts

    info = read_info(path)
    return [
        ("image", f"{info.width_px} x {info.height_px}, {info.channels} channels, {info.sample_type}"),
        *info.metadata.items(),
        *embedded_facts(path),
    ]


def _is_rig(path: Path) -> bool:
    return "world_to_camera" in read_text(path, MOST_BYTES, "YAML")


def _is_camera_file(path: Path) -> bool:
    from lightfield_gs.io.captures.camera_files import LIMIT_BYTES, is_camera_file
    from lightfield_gs.io.text_files import read_json

    return is_camera_file(read_json(path, LIMIT_BYTES))


def _camera_file(path: Path) -> list[tuple[str, object]]:
    """Return the cameras by the index that --camera takes; of many the first."""
    from lightfield_gs.io.captures.camera_files import read_camera_file

    cameras = read_camera_file(path)
    facts: list[tuple[str, object]] = [("cameras", len(cameras))]
    for index, camera in enumerate(cameras[:_CAMERAS_SHOWN]):
        centre = -camera.world_to_camera[:3, :3].T @ camera.world_to_camera[:3, 3]
        facts.append(
            (
                f"camera {index}",
                f"{camera.name}, {camera.width_px:g} x {camera.height_px:g}, at "
                + ", ".join(f"{part:.6g}" for part in centre + 0.0),
            )
        )
    return facts


def _rig(path: Path) -> list[tuple[str, object]]:
    from lightfield_gs.panels.stored_rigs import read_rig_file

    read = read_rig_file(path)
    size = "not said" if read.size_px is None else "{} x {}".format(*read.size_px)
    return [("rig", path), ("of a panel of", size), *read.rig.to_dict().items()]


def _checkpoint(path: Path) -> list[tuple[str, object]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "numpy") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}
            metadata = file.metadata() or {}
            counts = [_product(part.get_shape()) for part in slices.values()]
            types = sorted({part.get_dtype() for part in slices.values()})
    except (SafetensorError, OSError) as error:
        refuse_stand_in(path)
        raise InputError(f"{path} is no safetensors file: {' '.join(str(error).split())[:200]}") from error
    return [
        ("checkpoint", path),
        ("parameters", sum(counts)),
        ("tensors", len(counts)),
        ("types", ", ".join(types)),
        ("bytes", path.stat().st_size),
        *((key, json.dumps(value) if not isinstance(value, str) else value) for key, value in metadata.items()),
    ]


def _product(shape: list[int]) -> int:
    count = 1
    for size in shape:
        count *= size
    return count
