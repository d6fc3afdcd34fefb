"""`lightfield-gs encode`: a photo or a file of Gaussians becomes the image of a panel."""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightfield_gs.commands.stopwatch import Stopwatch
from lightfield_gs.errors import InputError
from lightfield_gs.io.atomic import check_output_path
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.gaussians import Gaussians
    from lightfield_gs.rig import Rig

_SCENE_SUFFIXES = (".ply", ".spz", ".splat", ".ksplat", ".sog")


def run(args: argparse.Namespace) -> None:
    """Encodes args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    bits = _bits(check_image_path(args.output), args.bit_depth)
    for path in (args.save_rig, args.save_gaussians):
        if path is not None:
            check_output_path(path)
    panel = Panel.load(args.panel)
    import torch

    from lightfield_gs.rendering import encode
    from lightfield_gs.rig import Rig

    if args.threads is not None:
        _use_threads(args.threads)
    rig = None if args.rig is None else Rig.from_yaml(args.rig)
    watch.lap("start")
    with torch.inference_mode():
        gaussians, rig = _scene(args, panel, rig, watch)
        stats: dict = {}
        image = encode(gaussians, panel, rig, args.method, views=args.views, background=args.background,
                       output="uint8" if bits == 8 else "float32", threads=args.threads, stats=stats).numpy()
        watch.lap("image", stats["stages_ms"])
        write_image(args.output, _stored(image, bits), _metadata(args, gaussians, panel, rig), args.compression)
        if args.save_rig is not None:
            rig.to_yaml(args.save_rig)
        if args.save_gaussians is not None:
            gaussians.save(args.save_gaussians)
        watch.lap("write")
        if args.preview is not None:
            from lightfield_gs.preview import write_preview

            write_preview(args.preview, image, gaussians, panel, rig, args.background)
            watch.lap("preview")
    print(f"{args.output}: {panel.width_px} x {panel.height_px}, {panel.views} views, {gaussians.count} Gaussians")
    print(watch.line())


def _scene(args: argparse.Namespace, panel: Panel, rig: "Rig | None",
           watch: Stopwatch) -> "tuple[Gaussians, Rig]":
    """The Gaussians of the input and a rig for them."""
    from lightfield_gs.gaussians import Gaussians
    from lightfield_gs.rig import Rig

    camera = None
    if args.input.suffix.lower() in _SCENE_SUFFIXES:
        for option, value in (("--mask", args.mask), ("--checkpoint", args.checkpoint)):
            if value is not None:
                raise InputError(f"{option} is for photos, and {args.input} is a file of Gaussians; leave it out")
        gaussians = Gaussians.load(args.input)
        watch.lap("load")
    else:
        from lightfield_gs.io.photo import load_photo
        from lightfield_gs.models import SplatterNet

        photo = load_photo(args.input, args.mask)
        network = SplatterNet.from_pretrained(args.checkpoint)
        watch.lap("load")
        gaussians = network.predict(photo)
        watch.lap("network")
        camera = np.eye(4)  # the photo's own
    return gaussians, rig or Rig.frame(gaussians, panel, camera)


def _bits(path: Path, bit_depth: int | None) -> int:
    """Bits of a sample in the file: 8, 16 or 32 (float)."""
    suffix = path.suffix.lower()
    bits = bit_depth or (32 if suffix == ".exr" else 8)
    if (suffix == ".exr") != (bits == 32) and suffix not in (".tif", ".tiff"):
        raise InputError(f"{path}: {suffix} holds {'32' if suffix == '.exr' else '8 or 16'} bits, not {bits}; "
                         "change --bit-depth or the extension")
    return bits


def _stored(image: np.ndarray, bits: int) -> np.ndarray:
    if bits != 16:
        return image
    from lightfield_gs.preview import to_integers

    return to_integers(image, 16)


def _use_threads(threads: int) -> None:
    import OpenImageIO as oiio
    import torch

    torch.set_num_threads(threads)
    oiio.attribute("threads", threads)


def _metadata(args: argparse.Namespace, gaussians: "Gaussians", panel: Panel, rig: "Rig") -> dict[str, str]:
    """What the image was made from and by; the values but "software" and "input" are JSON."""
    scene = {"gaussians": gaussians.count, "sh_degree": gaussians.sh_degree, "sha256": scene_hash(gaussians)}
    encoding = {"method": args.method, "views": args.views, "background": list(args.background)}
    versions = package_versions()
    return {"software": f"lightfield-gs {versions['lightfield-gs']}", "input": args.input.name,
            "panel": json.dumps(panel.to_dict()), "rig": json.dumps(rig.to_dict()), "scene": json.dumps(scene),
            "encoding": json.dumps(encoding), "versions": json.dumps(versions)}


def scene_hash(gaussians: "Gaussians") -> str:
    """SHA-256 of the five fields as little-endian float32, one after the other, hexadecimal."""
    digest = hashlib.sha256()
    for tensor in gaussians.fields().values():
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy(), "<f4"))
    return digest.hexdigest()


def package_versions() -> dict[str, str]:
    """Versions of this package and of those that decide what comes out."""
    from importlib.metadata import PackageNotFoundError, version

    versions = {}
    for name in ("lightfield-gs", "torch", "numpy", "openimageio"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return versions
