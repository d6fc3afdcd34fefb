"""Cases: the command lines, in this process as `python -m` runs them."""

from __future__ import annotations

import importlib.util
import io
import json
import os
import runpy
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
import yaml
from PIL import Image, ImageSequence

from installs.record import case, weights_of, without_times
from installs.scenes import arc, depth, panel, photo, rig, scene, view_map

Found = Iterator[tuple[str, Any]]
_TRAINING = (
    "training.train training.evaluate training.compare training.average training.profile training.data.make_small"
)
_TRAINING_PROGRAMS = (*_TRAINING.split(), "training.data.validate")


class _Captured(io.BytesIO):
    name = "<captured>"  # a stream of a program has one


def run(line: str, module: str = "lightfield_gs", streams: tuple[str, ...] = ("stdout", "stderr")) -> str:
    """The exit code of a command and what it prints; without a stream that has times or progress."""
    out, err = (io.TextIOWrapper(_Captured(), "utf-8") for _ in range(2))
    with _arguments(line), redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr)
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
            code: Any = 0
        except SystemExit as stop:
            code = stop.code
    lines = [f"exit code {code}"]
    for name, stream in (("stdout", out), ("stderr", err)):
        stream.flush()
        if name in streams:
            lines.append(f"{name}: {without_times(stream.buffer.getvalue().decode())}")
    return "\n".join(lines)


@contextmanager
def _arguments(line: str) -> Iterator[None]:
    before = sys.argv
    sys.argv = ["program", *line.split()]
    try:
        yield
    finally:
        sys.argv = before


def picture(path: str) -> Found:
    """Pixels and notes of an image file; not its bytes, for another compression is no other image."""
    source = oiio.ImageInput.open(path)
    spec = source.spec()
    yield path, source.read_image(0, 0, 0, spec.nchannels, str(spec.format))
    yield f"{path}: notes", {key: spec.getattribute(key) for key in ("ImageDescription", "Software")}
    source.close()


@case
def help_texts(device: torch.device) -> Found:
    os.environ["COLUMNS"] = "100"
    for command in ("", "encode", "prune", "simulate", "info", "bench"):
        yield command or "lightfield-gs", run(f"{command} --help")
    yield "--version", run("--version")
    for module in _TRAINING_PROGRAMS if _has_training() else ():
        yield module, run("--help", module)


@case
def command_encode(device: torch.device) -> Found:
    _write_inputs()
    on = f"--panel p.yaml --device {device.type}"
    for name, options in {
        "scene.png": "--up -y --save-rig r.yaml --save-gaussians g.ply --stats --threads 2",
        "small.png": "--compression small --quality fast",
        "deep.png": "--bit-depth 16 --antialiased --background 0,0.2,0.1",
        "scene.exr": "--views continuous --rig given.yaml",
        "scene.tif": "--method sorted --cameras c.json --view-map m.npy --memory-budget 4MB",
        "classic.png": "--method classic --camera given.yaml",
    }.items():
        yield f"{name}: printed", run(f"encode s.ply -o {name} {on} {options}")
        yield from picture(name)
    yield "rig", Path("r.yaml").read_bytes()
    yield "Gaussians", Path("g.ply").read_bytes()
    for name, options in {
        "rgbd.png": "plain.png --depth d.npy --save-rig depth-rig.yaml",
        "far.png": "plain.png --depth d.png --depth-kind disparity --depth-range 1,1.6 --fov 50",
    }.items():
        yield f"{name}: printed", run(f"encode -o {name} {options} {on}")
        yield from picture(name)
    if device.type == "cpu":  # see the case `network`
        yield "photo.png: printed", run(f"encode cut.png -o photo.png {on}")
        yield from picture("photo.png")


@case
def command_others(device: torch.device) -> Found:
    _write_inputs()
    on = f"--device {device.type}"
    yield "prune", run(f"prune s.ply -o less.ply --panel p.yaml --contribution-cut 0.01 --save-rig kept.yaml {on}")
    yield "pruned", Path("less.ply").read_bytes()
    yield "pruned: rig", Path("kept.yaml").read_bytes()
    yield "encode", run(f"encode less.ply -o o.png --panel p.yaml {on}")
    for name, options in {"eye.png": "", "eye.exr": "--spread 2 --panel p.yaml --viewing-distance 500"}.items():
        yield f"simulate {name}", run(f"simulate o.png --eye 30,0,600 -o {name} {options}")
        yield from picture(name)
    for file in ("s.ply", "less.ply", "o.png", "p.yaml", "given.yaml", "c.json", "cut.png", "65in-8k-96v"):
        yield f"info {file}", run(f"info {file}")
    yield "bench", run(f"bench --panel p.yaml --scene sheet:16 --repeats 1 {on} --json rows.json", streams=())
    yield "bench: rows", _untimed(json.loads(Path("rows.json").read_text()))


def _untimed(rows: Any) -> Any:
    """Return the file of `bench`; of times, bytes and the machine only the keys."""
    if isinstance(rows, list):
        return [_untimed(row) for row in rows]
    if not isinstance(rows, dict):
        return rows
    kept: dict[str, Any] = {}
    for key, value in rows.items():
        measured = key == "machine" or "ms" in key.split("_") or "bytes" in key
        kept[key] = _untimed(value) if not measured else sorted(value) if isinstance(value, dict) else "measured"
    return kept


@case
def command_preview(device: torch.device) -> Found:
    """Apart from the rest: what a preview shows may be changed on purpose."""
    _write_inputs()
    yield "printed", run(f"encode s.ply -o o.png --panel p.yaml --device {device.type} --preview preview")
    yield "files", sorted(path.name for path in Path("preview").iterdir())
    for name in ("left-eye.png", "right-eye.png", "views.png"):
        yield from picture(f"preview/{name}")
    frames = ImageSequence.Iterator(Image.open("preview/look-around.webp"))
    yield "animation", np.stack([np.asarray(frame.convert("RGB")) for frame in frames])


@case
def command_refusals(device: torch.device) -> Found:
    _write_inputs()
    Path("text.png").write_text("hello")
    Path("cut.ply").write_bytes(Path("s.ply").read_bytes()[:-9])
    for line in (
        "",
        "paint x",
        "encode s.ply",
        "encode s.ply -o o.jpg",
        "encode s.ply -o no/o.png",
        "encode s.ply -o s.ply",
        "encode s.ply -o o.png --panel nix",
        "encode s.ply -o o.png --rig p.yaml",
        "encode no.ply -o o.png",
        "encode text.png -o o.png",
        "encode cut.ply -o o.png",
        "encode s.ply -o o.png --mask m.png",
        "encode s.ply -o o.png --memory-budget 1GB",
        "encode s.ply -o o.png --method sorted --memory-budget 1KB --panel p.yaml",
        "encode s.ply -o o.png --background red",
        "encode s.ply -o o.png --bit-depth 32",
        "encode s.ply -o o.png --threads 0",
        "encode s.ply -o o.png --save-rig o.png",
        "encode s.ply -o o.png --unknown",
        "encode plain.png -o o.png --depth d.npy --depth-scale inf",
        "encode plain.png -o o.png --depth d.npy --checkpoint x.safetensors",
        "simulate cut.png --eye 0,0,600 -o e.png",
        "simulate o.png --eye 0,0 -o e.png",
        "prune s.ply -o l.ply --contribution-cut 2",
        "info text.png",
        "info nix",
        "bench --scene guess:3",
    ):
        yield line or "nothing", run(line)


@case
def training(device: torch.device) -> Found:
    if not _has_training():
        yield "training", "no folder training/ in this install"
        return
    yield "data", run("--output set --objects 2", "training.data.make_small", ())
    for path in sorted(Path("set").rglob("*.png"))[::7]:
        yield str(path), np.asarray(Image.open(path))
    if device.type == "cuda":  # there sums have no fixed order
        return
    unet = {"base_channels": 8, "multipliers": [1, 2], "blocks": 1, "attention_px": [8], "heads": 2, "dropout": 0.1}
    model = {"image_size_px": 16, "features": 8, "patch_px": 1, "unet": unet}
    run_file = {
        "output_dir": "run",
        "data": ["set"],
        "cache_dir": "cache",
        "model": "model.yaml",
        "device": "cpu",
        "stages": [{"steps": 1, "image_size_px": 16, "objects": 2}, {"steps": 1, "image_size_px": 32, "objects": 1}],
        "targets": 1,
        "procedural": 0.25,
        "optimizer": {"warmup_steps": 2},
    }
    Path("model.yaml").write_text(yaml.safe_dump(model))
    Path("run.yaml").write_text(yaml.safe_dump(run_file, sort_keys=False))
    yield "train", run("--config run.yaml", "training.train", ())
    yield "files", sorted(path.name for path in Path("run").iterdir())
    yield "losses", Path("run/losses.jsonl").read_text()
    yield from weights_of("run/model.safetensors")
    yield from _tensors("last.pt", torch.load("run/last.pt", weights_only=True))
    scored = "--data set --checkpoint run/model.safetensors --json s.json"
    yield "evaluate", run(scored, "training.evaluate", ("stdout",))
    yield "scores", Path("s.json").read_text()
    yield "unknown option", run("--config run.yaml --guess 1", "training.train")


def _tensors(name: str, value: Any) -> Found:
    """Return the contents of a checkpoint, tensor by tensor."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _tensors(f"{name}/{key}", part)
    elif isinstance(value, (list, tuple)):
        for index, part in enumerate(value):
            yield from _tensors(f"{name}/{index}", part)
    else:
        yield name, value


def _has_training() -> bool:
    return importlib.util.find_spec("training") is not None


def _write_inputs() -> None:
    """A scene, a panel, a rig, cameras, a view map, a photo and its depths, in the current folder."""
    of = panel()
    of.to_yaml("p.yaml")
    rig(of).to_yaml("given.yaml")
    scene(300, 1).save("s.ply")
    cameras = arc(7, of.width_px, of.height_px)
    fields = ("world_to_camera", "focal_px", "principal_point_px")
    Path("c.json").write_text(json.dumps({name: getattr(cameras, name).tolist() for name in fields}))
    np.save("m.npy", view_map(of, 7))
    Image.fromarray(photo()).save("cut.png")
    Image.fromarray(photo()[..., :3]).save("plain.png")
    np.save("d.npy", depth())
    Image.fromarray(np.round(255 / np.nan_to_num(depth(), nan=3.0)).clip(0, 255).astype(np.uint8)).save("d.png")
