"""python -m fuzzing.seeds, in tests/: write the good files of the corpus with this package's writers."""

from __future__ import annotations

import gzip
import json
import math
import shutil
import struct
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scene_formats
import torch
from capture_scene import MODELS, parameters, ring, write_model
from gltf_maker import Gltf, attributes
from heic_maker import heic
from icc_profile import SRGB_BLUE, SRGB_GREEN, SRGB_RED, matrix_profile
from PIL import Image

from fuzzing.readers import CORPUS, READERS, SMALL_PANEL
from lightfield_gs import Gaussians, Panel, Rig, SplatterNet
from lightfield_gs.io.images import write_image
from lightfield_gs.io.scenes.plausibility import import_zstd
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.models.unet import UNetConfig
from lightfield_gs.panels.stored_rigs import framing_comment

_RGB = ("red", "green", "blue")


def _gaussians(degree: int) -> Gaussians:
    count = (degree + 1) ** 2
    return Gaussians(
        torch.tensor([[0.0, 0, 2], [1, 2, 3]]),
        torch.eye(4)[:2],
        torch.full((2, 3), 0.1),
        torch.tensor([0.5, 0.9]),
        torch.linspace(-1, 1, 6 * count).view(2, count, 3),
    )


def _scenes(folder: Path) -> None:
    """Write .ply files in all encodings, with elements before and after the vertices."""
    for degree in (0, 3):
        _gaussians(degree).save(folder / f"degree{degree}.ply")
    replace(_gaussians(0), origin=(500123.0, 5412345.0, -420.0)).save(folder / "double.ply")
    names = ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    lines = [
        "comment Vertical Axis: z",
        "element face 2",
        "property list uchar short v",
        "property uchar flag",
        "element vertex 24",
        *(f"property double {name}" for name in "xyz"),
        *(f"property float {name}" for name in names),
        *(f"property uchar {name}" for name in _RGB),
        "element size 1",
        "property ushort px",
        "end_header\n",
    ]
    rows = [(0.1 * i, 3.0, 2.0 - i, 0.5, -2.0, -3.0, -4.0, 1.0, 0.0, 0.5, 0.0, 10 * i, 255 - i, 7) for i in range(24)]
    text = "3 0 1 2 9\n0 8\n" + "".join(" ".join(map(str, row)) + "\n" for row in rows) + "640\n"
    (folder / "text.ply").write_text("\n".join(["ply", "format ascii 1.0", *lines]) + text)
    body = struct.pack(">B3hBBB", 3, 0, 1, 2, 9, 0, 8) + b"".join(struct.pack(">3d8f3B", *row) for row in rows)
    header = "\n".join(["ply", "format binary_big_endian 1.0", *lines])
    (folder / "big-endian.ply").write_bytes(header.encode() + body + struct.pack(">H", 640) + b"\n")


def _moving_scene(path: Path) -> None:
    """Write two Gaussians with the properties of Spacetime Gaussians."""
    names = [*"xyz", "trbf_center", "trbf_scale", *(f"motion_{i}" for i in range(9)), *(f"f_dc_{i}" for i in range(3))]
    names += ["opacity", *(f"scale_{i}" for i in range(2)), *(f"{n}_{i}" for n in ("rot", "omega") for i in range(4))]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    path.write_bytes(header.encode() + np.linspace(0.1, 1, 2 * len(names), dtype="<f4").tobytes())


def _scene_formats(folders: dict[str, Path]) -> None:
    """Write all formats and versions, packed by hand."""
    for version in (1, 2, 3):
        (folders["spz"] / f"v{version}.spz").write_bytes(scene_formats.spz(version, 3))
        (folders["spz-inside"] / f"v{version}.bin").write_bytes(scene_formats.spz_plain(version, 3))
    (folders["spz"] / "v4.spz").write_bytes(scene_formats.spz4(import_zstd().compress))
    (folders["glb"] / "degree1.glb").write_bytes(Gltf().gaussians(attributes(1)).glb())
    packed = Gltf()
    packed.extension["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    packed.view(scene_formats.spz(2))
    (folders["glb"] / "spz.glb").write_bytes(packed.gaussians({}).glb())
    (folders["gltf"] / "inside.gltf").write_bytes(Gltf().gaussians(attributes(0)).gltf())
    (folders["splat"] / "small.splat").write_bytes(scene_formats.splat())
    for level in (0, 1, 2):
        (folders["ksplat"] / f"level{level}.ksplat").write_bytes(scene_formats.ksplat(level))
    for degree in (0, 3):
        (folders["ply-compressed"] / f"degree{degree}.ply").write_bytes(scene_formats.compressed_ply(degree))
    for version in (1, 2):
        files = scene_formats.sog(version)
        (folders["sog"] / f"v{version}.sog").write_bytes(scene_formats.zipped(files))
        (folders["sog-meta"] / f"v{version}.json").write_bytes(files["meta.json"])
    (folders["sog"] / "deflated.sog").write_bytes(scene_formats.zipped(files, zipfile.ZIP_DEFLATED, "scene/"))
    with tempfile.TemporaryDirectory() as temporary:
        for name, maker in (("lod", scene_formats.streamed), ("gsplat", scene_formats.gsplat_png)):
            made = maker(Path(temporary))
            source = made / ("lod-meta.json" if name == "lod" else "meta.json")
            (folders[f"{name}-meta"] / "small.json").write_bytes(source.read_bytes())
    plain = (folders["ply"] / "degree0.ply").read_bytes()
    (folders["scene-zip"] / "one.zip").write_bytes(scene_formats.zipped({"in/a.ply": plain}, zipfile.ZIP_DEFLATED))
    (folders["scene-gzip"] / "one.ply.gz").write_bytes(gzip.compress(plain, mtime=0))
    (folders["sog-image"] / "small.webp").write_bytes(files["sh0.webp"])


def _images(folder: Path, metadata: dict[str, str] | None = None) -> None:
    ramp = np.linspace(0, 1, 16 * 12 * 4).reshape(16, 12, 4)
    write_image(folder / "rgba.png", np.round(255 * ramp).astype(np.uint8), metadata, "small")
    write_image(folder / "grey16.png", np.round(65535 * ramp[..., :1]).astype(np.uint16), metadata, "small")
    write_image(folder / "float.exr", ramp[..., :3].astype(np.float32), metadata, "small")
    write_image(folder / "float.tif", ramp[..., :1].astype(np.float32), metadata)
    write_image(folder / "bytes.tif", np.round(255 * ramp[..., :3]).astype(np.uint8), metadata, "small")
    in_bytes = np.round(255 * ramp).astype(np.uint8)
    profile = matrix_profile(SRGB_GREEN, SRGB_RED, SRGB_BLUE)
    Image.fromarray(in_bytes).save(folder / "profile.tif", icc_profile=profile)
    Image.fromarray(in_bytes[..., :3]).save(folder / "colour.jpg", quality=60)
    Image.fromarray(in_bytes[..., :3]).save(folder / "colour.webp", lossless=True)


def _looking_at_the_origin(azimuth_rad: float) -> list[list[float]]:
    """Return a camera's pose as in transforms.json."""
    sine, cosine = round(math.sin(azimuth_rad), 6), round(math.cos(azimuth_rad), 6)
    return [[cosine, 0, sine, 1.3 * sine], [0, 1, 0, 0], [-sine, 0, cosine, 1.3 * cosine], [0, 0, 0, 1]]


def _camera_files(folder: Path) -> None:
    entry = {
        "id": 0,
        "img_name": "a",
        "width": 40,
        "height": 30,
        "position": [0, 0.5, -3],
        "fx": 44.0,
        "fy": 45.0,
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    }
    (folder / "cameras.json").write_text(json.dumps([entry, {**entry, "id": 1, "cx": 21.0}]))
    frames = [{"file_path": "view", "transform_matrix": _looking_at_the_origin(angle)} for angle in (-0.3, 0.2)]
    (folder / "transforms.json").write_text(json.dumps({"w": 40, "h": 30, "fl_x": 44.0, "k1": 0.1, "frames": frames}))
    (folder / "angle.json").write_text(json.dumps({"camera_angle_x": 0.9, "frames": frames}))


def _own_cameras(folder: Path) -> None:
    rig = Rig(np.eye(4), (9.0, 9.0), (2.0, 1.0), 2.0, 30.0)
    _gaussians(0).save(folder / "framed.ply", ["Vertical Axis: -z", framing_comment(rig, SMALL_PANEL)])
    _gaussians(0).save(folder / "photo.ply")
    elements = {
        "extrinsic": np.eye(4),
        "intrinsic": np.array([[9.0, 0, 2], [0, 9, 1], [0, 0, 1]]),
        "image_size": np.array([4.0, 2]),
    }
    header = "".join(f"element {name} {values.size}\nproperty float {name}\n" for name, values in elements.items())
    data = (folder / "photo.ply").read_bytes().replace(b"end_header\n", header.encode() + b"end_header\n", 1)
    (folder / "photo.ply").write_bytes(data + b"".join(values.astype("<f4").tobytes() for values in elements.values()))


def _calibrations(folder: Path, calibration: dict[str, Any]) -> None:
    """Write a calibration alone, in another encoding, and among displays, as a mapping and as JSON in a string."""
    (folder / "visual.json").write_text(json.dumps(calibration))
    (folder / "utf16.json").write_bytes(json.dumps({**calibration, "pitch": "42.0"}).encode("utf-16"))
    cells = {**calibration, "subpixelCells": [{"ROffsetX": -0.3, "ROffsetY": 0.25}], "CellPatternMode": {"value": 2}}
    displays = {
        "0": {"hwid": "A", "calibration": cells, "defaultQuilt": {"tileX": 8}},
        "1": {"hwid": {"value": "B"}, "calibration": {"value": json.dumps(calibration)}},
    }
    (folder / "one-display.json").write_text(json.dumps({"devices": {"0": displays["1"]}}))
    (folder / "displays.json").write_text(json.dumps({"devices": displays}))


def _captures(folder: Path) -> None:
    names = ("./view.png", "other")
    frames = [{"file_path": name, "transform_matrix": _looking_at_the_origin(0.2)} for name in names]
    lenses = {"opencv": {"k1": 0.1, "p2": -0.01}, "opencv_fisheye": {"k1": 0.1, "k4": 0.02}, "fov": {"omega": 0.9}}
    for model, lens in lenses.items():
        camera = {"camera_model": model.upper(), "fl_x": 9.0, "fl_y": 9.5, **lens, "frames": frames}
        (folder / f"{model}.json").write_text(json.dumps(camera))


def _colmap_models() -> None:
    """Write a camera of every model, photographs and points, as text and binary."""
    cameras = [(number, model, 96, 72, parameters(model)) for number, model in enumerate(MODELS)]
    images = [("a/b c.png", 0, *ring(2)[0]), ("d.png", 2, *ring(2)[1])]
    points = [((0.1, 0.2, 0.3), (255, 0, 7)), ((-1.0, 2.0, 0.5), (1, 2, 3))]
    for form, ending in (("bin", ""), ("txt", "-text")):
        with tempfile.TemporaryDirectory() as folder:
            write_model(Path(folder), form, cameras, images, points)
            for kind, name in (("cameras", "cameras"), ("images", "images"), ("points3D", "points")):
                shutil.copy(Path(folder) / f"{kind}.{form}", CORPUS / f"colmap-{name}{ending}/small.{form}")


def _batches(folder: Path, manifests: Path) -> None:
    """Write a list of inputs, and the manifest of a run over it."""
    options = {"input": "b.ply", "output": "deep/b.png", "zoom": 2, "pan": [0.1, -0.2], "fit_options": "--steps 9"}
    (folder / "two.txt").write_text(f"# mine\na.png\n{json.dumps(options)}\n")
    held = {"stamp": [3, 5], "sha256": "0" * 64}
    ended = {"item": "a.png", "status": "done", "job": "0" * 64, "inputs": {"a": held}, "outputs": {"a.png": held}}
    lines = [{"run": "1", "options": {}}, ended, {"item": "deep/b.png", "status": "begun", "job": ""}]
    (manifests / "two.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def main() -> None:
    folders = {reader.corpus: CORPUS / reader.corpus for reader in READERS.values()}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    slope = np.arange(0, 240, 15, np.uint8)[None].repeat(16, 0)
    with_depth = heic(slope[..., None].repeat(3, 2), slope, facts={"d_min": 0.25, "d_max": 2.0})
    (folders["heif"] / "depth.heic").write_bytes(with_depth)
    if "heif" in READERS:  # and small.heic, of an encoder that is not at hand
        Image.linear_gradient("L").resize((16, 12)).convert("RGB").save(folders["heif"] / "small.avif", quality=50)
    _batches(folders["batch-list"], folders["batch-manifest"])
    _scenes(folders["ply"])
    _moving_scene(folders["ply"] / "moving.ply")
    _scene_formats(folders)
    _images(folders["image"], {"panel": "small"})
    np.save(folders["depth-npy"] / "millimetres.npy", np.arange(1, 13, dtype=np.uint16).reshape(3, 4))
    np.save(folders["depth-npy"] / "metres.npy", np.linspace(0.5, 2, 12, dtype=np.float32).reshape(3, 4).T)
    np.savez_compressed(
        folders["depth-npz"] / "metres.npz", depth=np.linspace(0.5, 2, 12).reshape(3, 4), focallength_px=np.float32(9)
    )
    np.save(folders["view-map"] / "map.npy", SMALL_PANEL.view_map())
    cameras = Rig(np.eye(4), (9.0, 9.0), (2.0, 1.0), 2.0).cameras(SMALL_PANEL)
    fields = ("world_to_camera", "focal_px", "principal_point_px")
    (folders["cameras"] / "three.json").write_text(json.dumps({n: getattr(cameras, n).tolist() for n in fields}))
    _camera_files(folders["camera-file"])
    _own_cameras(folders["own-camera"])
    calibration = {
        "pitch": {"value": 42.0},
        "slope": {"value": -6.0},
        "center": {"value": 0.3},
        "DPI": {"value": 136},
        "screenW": {"value": 7680},
        "screenH": {"value": 4320},
        "viewCone": 40,
        "invView": 1,
        "flipSubp": 0,
    }
    _calibrations(folders["looking-glass"], calibration)
    Panel(**{**SMALL_PANEL.to_dict(), "pixel_pitch_mm": 0.2}).to_yaml(folders["panel"] / "small.yaml")
    Rig(np.eye(4), (9.0, 9.0), (2.0, 1.0), 2.0, 30.0).to_yaml(folders["rig"] / "small.yaml")
    unet = UNetConfig(base_channels=4, multipliers=(1,), blocks=1, attention_px=(), heads=1)
    net = SplatterNet(ModelConfig(image_size_px=8, features=4, layers=1, unet=unet))
    net.save(folders["checkpoint"] / "small.safetensors")
    yaml = "input: rgb\nlayers: 1\nnear: 0.75\nunet: {base_channels: 8, multipliers: [1, 2], heads: 2}\n"
    (folders["model"] / "small.yaml").write_text(yaml)
    frames = [{"file_path": "view", "transform_matrix": _looking_at_the_origin(angle)} for angle in (-0.3, 0.2)]
    camera = {"camera_angle_x": 0.7, "frames": frames}
    (folders["transforms"] / "two.json").write_text(json.dumps(camera))
    _captures(folders["capture"])
    _colmap_models()
    (folders["object"] / "nested.json").write_text('{"a": [1, 2.5e-3, null, true, {"b": "\\u00e4"}]}')
    (folders["srn-intrinsics"] / "intrinsics.txt").write_text("131.25 64. 64. 0.\n0. 0. 0.\n1.\n128 128\n")
    (folders["psf"] / "lens.csv").write_text("# measured\n-2, 0.1\n-0.5 0.6\n0; 1\n2.5, 0\n")
    (folders["srn-pose"] / "pose.txt").write_text(" ".join(map(str, np.diag([1.0, 1, 1, 1]).ravel())))


if __name__ == "__main__":
    main()
