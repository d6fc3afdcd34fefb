"""`lightfield-gs encode`: a photo, with or without a depth map, or a file of Gaussians becomes the image of a panel."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lightfield_gs.base.complaint import note
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.camera import add_camera, comments_of, read_given
from lightfield_gs.commands.options.drawn import add_antialiased, add_background, add_view_filter
from lightfield_gs.commands.options.encode import add_file, add_method, add_views, bits_of, check_options, views_given
from lightfield_gs.commands.options.estimated import depth_file, depth_model, is_estimated
from lightfield_gs.commands.options.framed import files_read, frame_scene, load_drawn
from lightfield_gs.commands.options.look import add_depth_report, add_look
from lightfield_gs.commands.options.panel import add_panel, load_panel, why_no_eye
from lightfield_gs.commands.options.provenance import file_facts, package_versions, scene_facts, software
from lightfield_gs.commands.options.scene import add_scene, check_scene_path
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
    add_views(add)
    add("--save-rig", type=Path, metavar="YAML", help="write the rig that was used")
    add_scene(
        add, "cut the object out of a photo with rembg (pip install 'lightfield-gs[rembg]'; downloads 176 MB once)"
    )
    add(
        "--save-gaussians",
        type=Path,
        metavar="SCENE",
        help="write the scene as .ply, .spz or .splat; a .ply has the framing: encoding it gives the same picture",
    )
    add_method(add)
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
    add_file(add)


def run(args: argparse.Namespace) -> None:
    """Encodes args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    bits = _check_files(args)
    check_options(args)
    panel = load_panel(args)
    import torch

    if args.threads is not None:
        _use_threads(args.threads)
    device = choose_device(args.device)
    given, views = read_given(args, panel), views_given(args, panel)
    watch.lap("start")
    with torch.inference_mode():
        gaussians, file, said = load_drawn(args, panel, device, watch)
        _note_slow_ways(args, panel, device)
        # Files of cameras are in the coordinates of the scene's file, and so is what is written of them
        rig: Rig | None = None
        if "cameras" in views:
            views["cameras"] = views["cameras"].relative_to(gaussians.origin)
        else:
            rig, how = frame_scene(args, panel, given, gaussians, file)
            said += how
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

            drawn_as = args.background, args.antialiased, args.view_filter
            write_preview(args.preview, image, gaussians, panel, cast("Rig", rig), *drawn_as)
            watch.lap("preview")
    _say(args, panel, gaussians.count, stats, watch.line(), said)


def _check_files(args: argparse.Namespace) -> int:
    """Raises InputError for files that cannot be written, or would be written over; returns the bits of the image."""
    bits = bits_of(check_image_path(args.output), args.bit_depth)
    if args.save_rig is not None:
        check_output_path(args.save_rig)
    if args.save_gaussians is not None:
        check_scene_path(args.save_gaussians)
    if args.preview is not None:
        check_folder(args.preview)
    check_outputs(_outputs(args), files_read(args))
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
    scene = scene_facts(gaussians)
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
            encoding[name] = file_facts(path)
    if is_estimated(args):
        encoding["depth"] = {"model": depth_model(args)}
    maker = {} if rig is None else {"rig": json.dumps(rig.to_dict())}
    return {
        "software": software(),
        "input": args.input.name,
        "panel": json.dumps(panel.to_dict()),
        **maker,
        "scene": json.dumps(scene),
        "encoding": json.dumps(encoding),
        "versions": json.dumps(package_versions()),
    }
