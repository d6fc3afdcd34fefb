"""`lightfield-gs encode`: a photo, with or without a depth map, or a file of Gaussians becomes the image of a panel."""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lightfield_gs.base.complaint import note
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import COMPRESSIONS, DEVICES, METHODS, QUALITY_NAMES, VIEWS, of_other_methods
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.camera import add_camera, choose_rig, comments_of, read_given
from lightfield_gs.commands.options.drawn import add_antialiased, add_background, add_view_filter, settle_drawing
from lightfield_gs.commands.options.estimated import depth_file, depth_model, is_estimated
from lightfield_gs.commands.options.look import add_depth_report, add_look, apply_look, refuse_look, report_depth
from lightfield_gs.commands.options.panel import add_panel, load_panel, why_no_eye
from lightfield_gs.commands.options.photo import add_depth
from lightfield_gs.commands.options.rig import load_cameras
from lightfield_gs.commands.options.scene import add_skip_invalid, check_scene_options, check_scene_path, load_scene
from lightfield_gs.commands.options.values import byte_size, threads
from lightfield_gs.io.atomic import check_folder, check_output_path, check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.gaussians import Gaussians


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs encode`."""
    parser.description = "Encodes a photo of one object, or a scene of 3D Gaussians, for a slanted-lenticular panel."
    add = parser.add_argument
    add(
        "input",
        type=Path,
        metavar="INPUT",
        help="a photo of an object (RGBA, or RGB with a plain background, --mask "
        "or --remove-background), a photo of a scene with --depth, or a file of Gaussians (.ply, "
        ".spz, .sog or its folder, .splat, .ksplat)",
    )
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=".png (8 or 16 bit), .tif or .exr (float)")
    add_panel(add, "for --preview, for framing, and for `simulate` afterwards")
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    add(
        "--cameras",
        type=Path,
        metavar="JSON",
        help="one camera for each view, the right-most eye's first, for --method sorted, in place of a rig: "
        "world_to_camera [N,4,4] (OpenCV axes, scene units), focal_px [N,2] and principal_point_px [N,2] (pixels of "
        "the panel)",
    )
    add(
        "--view-map",
        type=Path,
        metavar="NPY",
        help="the view of each sub-pixel, for --method sorted, in place of the panel's lens: int32 [H,W,3], 0..N-1, or "
        "-1 for the background",
    )
    add("--save-rig", type=Path, metavar="YAML", help="write the rig that was used")
    add("--mask", type=Path, metavar="IMAGE", help="cut-out of a photo, of its size: bright or opaque on the object")
    add(
        "--remove-background",
        action="store_true",
        help="cut the object out of a photo with rembg (pip install 'lightfield-gs[rembg]'; downloads 176 MB once)",
    )
    add_depth(add)
    add("--checkpoint", type=Path, metavar="FILE", help="weights of the network, .safetensors (default: those inside)")
    add(
        "--save-gaussians",
        type=Path,
        metavar="SCENE",
        help="write the scene as .ply, .spz or .splat; a .ply has the framing: encoding it gives the same picture",
    )
    add_skip_invalid(add)
    add(
        "--method",
        choices=METHODS,
        default="direct",
        help="direct: all sub-pixels in one pass; sorted: view by view, for any --cameras and --view-map; classic: a "
        "picture a view, then interlaced (slow; for comparison)",
    )
    add(
        "--memory-budget",
        type=byte_size,
        metavar="SIZE",
        help="work memory of --method sorted beside the image, for example 256MB (B, KB, MB, GB, KiB, MiB, GiB; "
        "default 256MiB, or 1GiB on cuda, beside the sorted sub-pixels, 0.2GB on an 8K panel)",
    )
    add(
        "--device",
        choices=DEVICES,
        default="auto",
        help="where network and rasterizer run (default auto: cuda where there is a GPU and this build can use it)",
    )
    add(
        "--views",
        choices=VIEWS,
        default="integer",
        help="integer: N views; continuous: every sub-pixel its own viewpoint (default integer)",
    )
    add(
        "--quality",
        choices=QUALITY_NAMES,
        default="exact",
        help="less time for more error, of --method direct (default exact)",
    )
    add_antialiased(add)
    add_view_filter(add)
    add_background(add)
    add(
        "--preview",
        type=Path,
        metavar="DIR",
        help="write views.png, look-around.webp, look-around.html (follows the mouse, needs no network) and, where the "
        "panel has a pixel pitch and a viewing distance (see there), left-eye.png and right-eye.png",
    )
    add(
        "--bit-depth",
        type=int,
        choices=(8, 16, 32),
        metavar="BITS",
        help="8, 16 or 32 (float: .exr, .tif); default 8, .exr 32",
    )
    add("--compression", choices=COMPRESSIONS, default="fast", help="of the file: quick to write, or small")
    add("--threads", type=threads, metavar="N", help="number of threads (default: all cores)")
    add("--stats", action="store_true", help="print what was drawn and what was skipped")


def run(args: argparse.Namespace) -> None:
    """Encodes args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    bits = _check_files(args)
    _check_options(args)
    panel = load_panel(args)
    import torch

    if args.threads is not None:
        _use_threads(args.threads)
    device = choose_device(args.device)
    given, views = read_given(args, panel), _views(args, panel)
    watch.lap("start")
    with torch.inference_mode():
        gaussians, file = load_scene(args, device, watch)
        drawn_so = settle_drawing(args, file)
        _note_slow_ways(args, panel, device)
        # Files of cameras are in the coordinates of the scene's file, and so is what is written of them
        rig: Rig | None = None
        said: list[str] = []
        if "cameras" in views:
            views["cameras"] = views["cameras"].relative_to(gaussians.origin)
        else:
            chosen, said = choose_rig(given, args, panel, gaussians, file)
            rig, looks = apply_look(args, chosen, panel, gaussians)
            said += looks + report_depth(args, rig, panel, gaussians)
        rig_of_file = rig and rig.relative_to([-part for part in gaussians.origin])
        image, stats = _drawn(args, gaussians, panel, rig, views, bits)
        watch.lap("image", stats["stages_ms"])
        write_image(args.output, _stored(image, bits), _metadata(args, gaussians, panel, rig_of_file), args.compression)
        if args.save_rig is not None:
            cast("Rig", rig_of_file).to_yaml(args.save_rig)
        if args.save_gaussians is not None:
            gaussians.save(args.save_gaussians, comments_of(args, panel, file, rig_of_file))
            along = ", with the framing and what is up" if args.save_gaussians.suffix.lower() == ".ply" else ""
            said.append(f"{args.save_gaussians}: the Gaussians in their own axes{along}")
        watch.lap("write")
        if args.preview is not None:
            from lightfield_gs.show.preview import write_preview

            write_preview(args.preview, image, gaussians, panel, cast("Rig", rig), args.background, args.antialiased)
            watch.lap("preview")
    _say(args, panel, gaussians.count, stats, watch.line(), drawn_so + said)


def _check_files(args: argparse.Namespace) -> int:
    """Raises InputError for files that cannot be written, or would be written over; returns the bits of the image."""
    bits = _bits(check_image_path(args.output), args.bit_depth)
    if args.save_rig is not None:
        check_output_path(args.save_rig)
    if args.save_gaussians is not None:
        check_scene_path(args.save_gaussians)
    if args.preview is not None:
        check_folder(args.preview)
    camera_file = args.camera and args.camera[0]
    read = (args.input, args.rig, args.panel, args.mask, args.depth, args.cameras, args.view_map, args.checkpoint)
    check_outputs(_outputs(args), (*read, camera_file))
    return bits


def _note_slow_ways(args: argparse.Namespace, panel: Panel, device: str) -> None:
    """Says where a panel or an option keeps the method `direct` from its fastest ways."""
    from lightfield_gs.panels.lens import slow_way
    from lightfield_gs.rasterizer.quality import Quality

    lattices = args.method == "direct" and Quality.of(args.quality).lattice_error > 0
    if args.method == "direct" and (why := slow_way(panel, lattices and device == "cuda")):
        note(why)
    if (args.antialiased or args.view_filter) and args.quality != "exact" and device == "cuda":
        note(
            f"{'anti-aliased scenes' if args.antialiased else 'filtered views'} are drawn neither from lattices nor in "
            f"half precision on CUDA: --quality {args.quality} saves little time"
        )


def _drawn(
    args: argparse.Namespace, gaussians: Gaussians, panel: Panel, rig: Rig | None, views: dict[str, Any], bits: int
) -> tuple[np.ndarray, dict[str, Any]]:
    """The image on the host, and what `encode` tells of it; views: arguments in place of the rig."""
    from lightfield_gs.encoding.encode import encode

    stats: dict[str, Any] = {}
    drawn = encode(
        gaussians,
        panel,
        rig,
        args.method,
        views=args.views,
        background=args.background,
        output="uint8" if bits == 8 else "float32",
        quality=args.quality,
        threads=args.threads,
        stats=stats,
        antialiased=args.antialiased,
        view_filter=args.view_filter,
        **views,
    )
    return drawn.cpu().numpy(), stats


def _say(
    args: argparse.Namespace, panel: Panel, gaussians: int, stats: dict[str, Any], times: str, said: list[str]
) -> None:
    """What was made, how long it took, and what was decided or looks wrong."""
    if args.preview is not None and (why := why_no_eye(panel)):
        note(f"{args.preview} has no left-eye.png and right-eye.png: {why}")
    if stats["pairs"] == 0 and stats["gaussians_culled"] == gaussians:
        note(
            f"{args.output} is all background: none of {gaussians} Gaussians is within what the cameras see, or "
            "opaque enough to show; look at the pose (OpenCV axes: z forward, y down) of the rig or the cameras"
        )
    print(f"{args.output}: {panel.width_px} x {panel.height_px}, {panel.views} views, {gaussians} Gaussians")
    print(times)
    if args.stats:
        print("\n".join(_stats_lines(stats, gaussians)))
    print("".join(f"{line}\n" for line in said), end="")


def _outputs(args: argparse.Namespace) -> list[Path | None]:
    """All files that the command writes; None for what was not asked for."""
    outputs = [args.output, args.save_rig, args.save_gaussians]
    if args.preview is None:
        return outputs
    from lightfield_gs.show.preview import FILES

    return [*outputs, *(args.preview / name for name in FILES)]


def _stats_lines(stats: dict[str, Any], gaussians: int) -> list[str]:
    from lightfield_gs.rasterizer import skips

    each = stats["evaluations_per_subpixel"]
    lines = [f"pairs of tile and Gaussian: {stats['pairs']}", *skips.lines(stats.get("skipped", {}), gaussians)]
    return lines if each is None else [*lines, f"evaluations per sub-pixel: {each:.1f}"]


def _check_options(args: argparse.Namespace) -> None:
    """Raises InputError where options do not go together."""
    check_scene_options(args)
    quality = None if args.quality == "exact" else args.quality
    given = {"cameras": args.cameras, "view_map": args.view_map, "memory_budget": args.memory_budget}
    for name, its in of_other_methods(args.method, **given, quality=quality):
        if name == "quality":
            raise InputError(f"--quality {quality} is for --method {its}, not {args.method}; leave out one of them")
        raise InputError(f"--{name.replace('_', '-')} is for --method {its}, not {args.method}")
    for option, value in (("--cameras", args.cameras), ("--view-map", args.view_map)):
        if value is not None and args.views == "continuous":
            raise InputError(
                f"--views continuous is for a rig and the panel's lens, and {option} takes the place of "
                "one; leave out one of them"
            )
    if args.cameras is not None:
        for option, value in (
            ("--view-filter", args.view_filter or None),
            ("--rig", args.rig),
            ("--camera", args.camera),
            ("--up", args.up),
            ("--save-rig", args.save_rig),
            ("--preview", args.preview),
            ("--depth-report", args.depth_report or None),
        ):
            if value is not None:
                raise InputError(f"{option} is about a rig, and --cameras takes its place; leave out one of them")
        refuse_look(args, "is about a rig, and --cameras takes its place")


def _views(args: argparse.Namespace, panel: Panel) -> dict[str, Any]:
    """The arguments of `encode` that only the method sorted has, those that were given."""
    from lightfield_gs.encoding.view_files import read_view_map

    views: dict[str, Any] = {}
    if args.cameras is not None:
        views["cameras"] = load_cameras(args, panel)
    if args.view_map is not None:
        count = views["cameras"].count if "cameras" in views else panel.views
        views["view_map"] = read_view_map(args.view_map, panel, count)
    if args.memory_budget is not None:
        views["memory_budget"] = args.memory_budget
    return views


def _bits(path: Path, bit_depth: int | None) -> int:
    """Bits of a sample in the file: 8, 16 or 32 (float)."""
    suffix = path.suffix.lower()
    bits = bit_depth or (32 if suffix == ".exr" else 8)
    if (suffix == ".exr") != (bits == 32) and suffix not in (".tif", ".tiff"):
        raise InputError(
            f"{path}: {suffix} holds {'32' if suffix == '.exr' else '8 or 16'} bits, not {bits}; "
            "change --bit-depth or the extension"
        )
    return bits


def _stored(image: np.ndarray, bits: int) -> np.ndarray:
    if bits != 16:
        return image
    from lightfield_gs.show.preview import to_integers

    return to_integers(image, 16)


def _use_threads(threads: int) -> None:
    import OpenImageIO as oiio
    import torch

    torch.set_num_threads(threads)
    oiio.attribute("threads", threads)


def _metadata(args: argparse.Namespace, gaussians: Gaussians, panel: Panel, rig: Rig | None) -> dict[str, str]:
    """What the image was made from and by; the values but "software" and "input" are JSON."""
    scene = {"gaussians": gaussians.count, "sh_degree": gaussians.sh_degree, "sha256": scene_hash(gaussians)}
    if any(gaussians.origin):
        scene["origin"] = gaussians.origin
    encoding = {
        "method": args.method,
        "views": args.views,
        "background": list(args.background),
        "quality": args.quality,
        **({"antialiased": True} if args.antialiased else {}),
        **({"view_filter": args.view_filter} if args.view_filter else {}),
    }
    for name, path in (
        ("cameras", args.cameras),
        ("view_map", args.view_map),
        ("depth", depth_file(args)),
        ("camera", args.camera and args.camera[0]),
    ):
        if path is not None:
            encoding[name] = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    if is_estimated(args):
        encoding["depth"] = {"model": depth_model(args)}
    versions = package_versions()
    maker = {} if rig is None else {"rig": json.dumps(rig.to_dict())}
    return {
        "software": f"lightfield-gs {versions['lightfield-gs']}",
        "input": args.input.name,
        "panel": json.dumps(panel.to_dict()),
        **maker,
        "scene": json.dumps(scene),
        "encoding": json.dumps(encoding),
        "versions": json.dumps(versions),
    }


def scene_hash(gaussians: Gaussians) -> str:
    """SHA-256 of the five fields as little-endian float32, one after the other, hexadecimal."""
    digest = hashlib.sha256()
    for tensor in gaussians.fields().values():
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy(), "<f4").data)
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
