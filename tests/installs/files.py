"""Cases: what the other public names make, read and write."""

from __future__ import annotations

import inspect
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import lightfield_gs as lf
from installs.record import case, fields_of, refusal, warnings_kept, weights_of
from installs.scenes import PANELS, arc, depth, panel, photo, pose, rig, scene

Found = Iterator[tuple[str, Any]]


@case
def public_names(device: torch.device) -> Found:
    yield "names", list(lf.__all__)
    yield "version", lf.__version__
    yield "build", {key: lf.build_info()[key] for key in ("version", "simd_targets")}
    for name in lf.__all__:
        value = getattr(lf, name)
        yield f"parameters of {name}", _parameters(value)
        if inspect.isclass(value):
            members = {key: _parameters(member) for key, member in inspect.getmembers(value) if key[0] != "_"}
            yield f"members of {name}", {key: members[key] for key in sorted(members) if key not in _of_torch(value)}


def _parameters(value: Any) -> list[str]:
    """Names, kinds and defaults; what types are called may change."""
    if not callable(value):
        return []
    try:
        found = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return []
    return [
        f"{p.name}, {p.kind.name}" + ("" if p.default is inspect.Parameter.empty else f" = {p.default!r}")
        for p in found
    ]


def _of_torch(value: type) -> set[str]:
    return set(dir(torch.nn.Module)) if issubclass(value, torch.nn.Module) else set()


@case
def panels(device: torch.device) -> Found:
    for name in ("65in-8k-96v", "4k-71v", "bench-4k-71v", "bench-8k-96v", "toy-8v"):
        yield name, lf.Panel.load(name).to_dict()
    for name in PANELS:
        of = panel(name)
        of.to_yaml("panel.yaml")
        yield f"{name}: file", Path("panel.yaml").read_bytes()
        yield f"{name}: read", lf.Panel.load("panel.yaml").to_dict()
        yield f"{name}: phases", list(of.phase_steps())
        yield f"{name}: views", of.view_map()
        yield f"{name}: positions", of.view_map(continuous=True)
    physical = dict(width_px=90, height_px=60, views=12, lens_pitch_mm=0.9, slant_tan=0.2, viewing_distance_mm=700)
    yield "measures", lf.Panel.from_physical(**physical, lens_gap_mm=1.1, pixel_pitch_mm=0.3).to_dict()
    calibration = {
        "configVersion": "3.0",
        "serial": "LKG-E12345",
        "pitch": {"value": 47.57},
        "slope": {"value": "-5.48"},
        "center": {"value": 0.5},
        "screenW": {"value": 384.0},
        "screenH": {"value": 216.0},
        "DPI": {"value": 283.0},
        "viewCone": {"value": 40.0},
        "invView": {"value": 1.0},
        "flipImageX": {"value": 0.0},
        "flipImageY": {"value": 0.0},
    }
    Path("visual.json").write_text(json.dumps(calibration))
    with warnings_kept() as words:
        yield "Looking Glass", lf.Panel.load("visual.json").to_dict()
        del calibration["viewCone"]
        yield "Looking Glass, no cone", lf.Panel.from_looking_glass(calibration, views=45).to_dict()
    yield "Looking Glass: warnings", words


@case
def rigs_and_cameras(device: torch.device) -> Found:
    for name in ("stripes", "inverted"):
        of = panel(name)
        fan = rig(of, cone_deg=30.0)
        fan.to_yaml("rig.yaml")
        yield f"{name}: file", Path("rig.yaml").read_bytes()
        yield f"{name}: read", lf.Rig.from_yaml("rig.yaml").to_dict()
        yield f"{name}: relative", fan.relative_to([1, 2, 3]).to_dict()
        yield f"{name}: offsets", [fan.half_width(of), *fan.offset(np.arange(4.0), of), *fan.offset_range(of)]
        yield f"{name}: limits", list(fan.jacobian_limits(of))
        for words, cameras in (("all", fan.cameras(of)), ("some", fan.cameras_at(of, [0.0, 3.7]))):
            yield f"{name}, {words}: poses", cameras.world_to_camera
            yield f"{name}, {words}: intrinsics", cameras.intrinsics()
            yield f"{name}, {words}: limits", cameras.limits()
    own = arc(4, 50, 40)
    yield "chosen: poses", own.select([2, 0]).relative_to([1, 2, 3]).world_to_camera
    yield "chosen: limits", own.select([2, 0]).limits()
    _write_camera_files()
    for words, cameras in (
        ("cameras.json", lf.Cameras.from_inria("cameras.json")),
        ("transforms.json", lf.Cameras.from_transforms("transforms.json", 1)),
    ):
        yield f"{words}: poses", cameras.world_to_camera
        yield f"{words}: intrinsics", cameras.intrinsics()
        yield f"{words}: size", [cameras.width_px, cameras.height_px]


def _write_camera_files() -> None:
    turned = pose(0.3)
    inria = {"id": 0, "img_name": "a", "width": 64, "height": 48, "fx": 60.0, "fy": 61.0}
    places = [{"position": [0.1, 0.2, 0.3 * i], "rotation": turned[:3, :3].tolist()} for i in range(3)]
    Path("cameras.json").write_text(json.dumps([inria | place for place in places]))
    frames = [{"file_path": f"{i}.png", "transform_matrix": np.linalg.inv(pose(0.1 * i)).tolist()} for i in range(2)]
    nerf = {"fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 25.0, "w": 64, "h": 48, "frames": frames}
    Path("transforms.json").write_text(json.dumps(nerf))


@case
def scene_files(device: torch.device) -> Found:
    rotation = pose(0.4, 0.3)[:3, :3]
    for degree in range(4):
        gaussians = scene(50, degree, degree)
        gaussians.save("scene.ply")
        yield f"degree {degree}: file", Path("scene.ply").read_bytes()
        yield from fields_of(f"degree {degree}: read", lf.Gaussians.load("scene.ply"))
        yield from fields_of(f"degree {degree}: turned", gaussians.rotated(rotation))
    yield from fields_of("turned, batch of doubles", scene(9, 2, 1, dtype=torch.float64, batch=2).rotated([1, 2, 3, 4]))
    yield "repr", repr(scene(5))
    with warnings_kept() as words:
        for name, header, rows in _odd_scenes():
            Path("odd.ply").write_bytes(header + rows)
            yield f"{name}: complaint", refusal(lambda: lf.Gaussians.load("odd.ply"))
            yield f"{name}: skipping", refusal(lambda: lf.Gaussians.load("odd.ply", skip_invalid=True))
    yield "warnings", words


def _odd_scenes() -> Iterator[tuple[str, bytes, bytes]]:
    names = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
    names += tuple(f"scale_{i}" for i in range(3)) + tuple(f"rot_{i}" for i in range(4))
    good = [0.1, 0.2, 2.0, 0.3, -0.3, 0.1, 1.0, -3.0, -3.0, -3.0, 1.0, 0.0, 0.0, 0.0]
    for name, kind, code, place, value in (
        ("doubles far away", "double", "d", 0, 4_000_000.25),
        ("not finite", "float", "f", 1, float("nan")),
        ("no rotation", "float", "f", 10, 0.0),
        ("linear scales", "float", "f", 7, 0.5),
        ("opaque", "float", "f", 6, float("inf")),
    ):
        rows = [[*good] for _ in range(4)]
        rows[2][place] = value
        lines = ["ply", "format binary_little_endian 1.0", "element vertex 4"]
        lines += [*(f"property {kind} {n}" for n in names), "end_header", ""]
        yield name, "\n".join(lines).encode(), b"".join(struct.pack(f"<{len(row)}{code}", *row) for row in rows)


@case
def photos(device: torch.device) -> Found:
    Image.fromarray(photo()).save("cut.png")
    yield "alpha", lf.load_photo("cut.png")
    plain = Image.new("RGB", (150, 120), (235, 235, 240))
    plain.paste(Image.fromarray(photo()), mask=Image.fromarray(photo()[..., 3]))
    plain.save("plain.png")
    plain.save("plain.jpg", quality=95)
    Image.fromarray(photo()[..., 3]).save("mask.png")
    yield "plain background", lf.load_photo("plain.png")
    yield "JPEG", lf.load_photo("plain.jpg")
    yield "mask", lf.load_photo("plain.png", "mask.png")
    yield "whole", lf.load_photo("plain.png", whole=True)
    colours = photo()[..., :3] / np.float32(255)
    yield from fields_of("depth", lf.from_depth(colours, depth()))
    rgba = torch.from_numpy(photo() / np.float32(255)).to(device)
    yield from fields_of("depth, alpha, focal", lf.from_depth(rgba, depth(), (130.0, 140.0), (70.0, 66.0)))


@case
def network(device: torch.device) -> Found:
    net, of = lf.SplatterNet.from_pretrained().to(device), panel()
    yield "configuration", net.config.to_dict()
    stats: dict[str, Any] = {}
    draw = lf.PhotoEncoder(net, of, quality="high", background=(0.2, 0.5, 0.9))
    image = draw(photo(), stats)
    yield "stages", sorted(stats["stages_ms"])
    if device.type == "cpu":  # on CUDA the algorithms of convolutions are chosen anew in every process
        yield "image", image
        yield "rig", draw.rig.to_dict()
        yield from fields_of("drawn", draw.gaussians)
        net.save("net.safetensors", {"note": "kept"})
        yield from weights_of("net.safetensors")


@case
def refusals(device: torch.device) -> Found:
    """The library's errors for senseless arguments."""
    of, gaussians = panel(), scene(5, device=device)
    bad = scene(5, device=device)
    bad.scales[2] = -1
    calls = {
        "scales": lambda: encode(bad),
        "method": lambda: encode(gaussians, method="guess"),
        "views": lambda: encode(gaussians, views="all"),
        "background": lambda: encode(gaussians, background=(1, 2)),
        "background, range": lambda: encode(gaussians, background=(1, 2, 3)),
        "threads": lambda: encode(gaussians, threads=0),
        "quality": lambda: encode(gaussians, quality="best"),
        "quality of sorted": lambda: encode(gaussians, method="sorted", quality="fast"),
        "budget of direct": lambda: encode(gaussians, memory_budget=9),
        "budget too small": lambda: encode(gaussians, method="sorted", memory_budget=9),
        "no rig": lambda: lf.encode(gaussians, of),
        "panel": lambda: lf.encode(gaussians, "65in-8k-96v", rig(of)),
        "out": lambda: encode(gaussians, out=torch.zeros(3)),
        "batch": lambda: encode(scene(5, batch=2, device=device)),
        "knob": lambda: lf.Quality(opacity_cut=0),
        "line number": lambda: panel(line_number=0),
        "order": lambda: panel(subpixel_order="GRB"),
        "pose": lambda: rig(of, world_to_camera=np.ones((4, 4))),
        "zero depth": lambda: rig(of, zero_depth=-1),
        "file": lambda: lf.Gaussians.load("no.ply"),
        "photo": lambda: lf.load_photo("no.png"),
        "profile": lambda: lf.Panel.load("65in"),
        "rotation": lambda: gaussians.rotated(np.ones((3, 3))),
        "view map": lambda: lf.SortedPlan(of, np.zeros((2, 2, 3), np.int32)),
        "interlace": lambda: lf.interlace(torch.zeros(2, 2, 2, 3), of),
        "prune": lambda: lf.prune(gaussians, of, rig(of), 2),
        "encoder": lambda: lf.Encoder(of, None),
        "depth": lambda: lf.from_depth(np.zeros((4, 4, 3), np.float32), np.zeros((4, 4), np.float32)),
    }
    for name, call in calls.items():
        yield name, refusal(call)


def encode(gaussians: lf.Gaussians, **options: Any) -> torch.Tensor:
    return lf.encode(gaussians, panel(), rig(panel()), **options)
