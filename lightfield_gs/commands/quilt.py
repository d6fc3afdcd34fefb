"""`lightfield-gs quilt`: a photo or a scene becomes a quilt, the views of a fan of cameras in one picture."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.cameras import read_given
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.provenance import package_versions, scene_facts, software
from lightfield_gs.app.scene import check_scene_options, files_read, load_framed
from lightfield_gs.base.checks import expect
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import COMPRESSIONS, DEFAULT_CONE_DEG, DEVICES
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.cameras import add_camera, add_depth_report, add_look
from lightfield_gs.commands.options.panel import add_device_serial, add_viewing_distance
from lightfield_gs.commands.options.parser import whole_numbers, within
from lightfield_gs.commands.options.scene import add_antialiased, add_background, add_scene, add_view_filter
from lightfield_gs.io.atomic import check_output_path, check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import (
    QUILT_PRESETS,
    QuiltLayout,
    check_divides,
    panel_quilt,
    stated_layout,
    with_suffix,
)
from lightfield_gs.photo.side_by_side import is_rgbd_name

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.gaussians import Gaussians

_DEFAULT_PRESET = "65"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs quilt`."""
    parser.description = (
        "Renders the views of a photo or a scene of 3D Gaussians as a quilt, which Looking Glass displays and `weave` "
        "take: the left-most camera's view at the bottom left, then to the right, then up."
    )
    add = parser.add_argument
    add("input", type=Path, metavar="INPUT", help="a photo or a scene, as `encode` takes it")
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="NAME",
        help="the quilt, .png (default), .tif; its name gets _qs<columns>x<rows>a<aspect> unless it has it",
    )
    _add_layout(add)
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    add("--save-rig", type=Path, metavar="YAML", help="write the rig that was used, at the pixels of a tile")
    add(
        "--save-rgbd",
        type=Path,
        metavar="NAME",
        help="write the centre camera's picture beside its depth map too (right half, bright is near), as "
        "NAME_rgbd.png",
    )
    add_scene(add, "cut the object out of a photo with rembg")
    add_antialiased(add)
    add_view_filter(add)
    add_background(add)
    add("--device", choices=DEVICES, default="auto", help="where network and rasterizer run (default auto)")
    add("--compression", choices=COMPRESSIONS, default="fast", help="of the file: quick to write, or small")


def _add_layout(add) -> None:
    add(
        "--preset",
        "--device-preset",
        choices=tuple(QUILT_PRESETS),
        help="tiles, size and aspect that Looking Glass has for a device, by its name or its inches "
        f"(default {_DEFAULT_PRESET})",
    )
    add(
        "--panel",
        metavar="PANEL",
        help="in place of a preset: as many views as a panel has, its aspect and cone, each as large as the panel "
        "where that makes a quilt of 8192 pixels at most",
    )
    add_device_serial(add)
    add_viewing_distance(add, "of --panel, in place of its own, for framing")
    add(
        "--tiles",
        type=whole_numbers(1, 65536, "x", 2),
        metavar="CxR",
        help="columns and rows of views, in place of the preset's",
    )
    add("--size", type=whole_numbers(1, 65536, "x", 2), metavar="WxH", help="size of the whole quilt, pixels")
    add(
        "--aspect",
        type=within(0.01, 100),
        metavar="A",
        help="width by height of a view as it is seen; its tile may have another (default: the preset's)",
    )


def run(args: argparse.Namespace) -> None:
    """Renders args.input into a quilt. Raises InputError."""
    watch = Stopwatch(args.began)
    panel = None if args.panel is None else load_panel(args)
    if panel is None and (args.device_serial or args.viewing_distance):
        raise InputError("--device-serial and --viewing-distance are about a --panel; give one, or leave them out")
    if panel is None and args.depth_report:
        raise InputError("--depth-report is about the lens of a --panel; give one, or leave it out")
    layout = chosen_layout(args, panel)
    _check_files(args, layout)
    check_scene_options(args)
    frame = framed_for(layout, panel)
    import torch

    device = choose_device(args.device)
    given = read_given(args, frame)
    watch.lap("start")
    with torch.inference_mode():
        from lightfield_gs.encoding.quilt import quilt

        framed = load_framed(args, frame, given, device, watch)
        gaussians = framed.gaussians
        tile, fan_rig = layout.fitted(frame, framed.rig)
        drawn_as = {name: getattr(args, name) for name in ("background", "antialiased", "view_filter")}
        image = quilt(gaussians, layout, fan_rig, tile, **drawn_as).cpu()
        watch.lap("views")
        of_file = fan_rig.relative_to([-part for part in gaussians.origin])
        write_image(args.output, image.numpy(), _metadata(args, gaussians, layout, tile, of_file), args.compression)
        if args.save_rig is not None:
            of_file.to_yaml(args.save_rig)
        watch.lap("write")
        if args.save_rgbd is not None:
            framed.messages.append(_write_rgbd(args, gaussians, frame, framed.rig))
            watch.lap("RGB-D")
    width, height = layout.tile_px()
    print(f"{args.output}: {layout.views} views of {width} x {height} pixels, {gaussians.count} Gaussians")
    print(watch.line())
    print("".join(f"{line}\n" for line in framed.messages), end="")


def chosen_layout(args: argparse.Namespace, panel: Panel | None) -> QuiltLayout:
    """The layout by the options, or else the name of the output, the panel or the preset. Raises InputError."""
    if panel is not None and args.preset is not None:
        raise InputError("--panel takes the place of --preset; leave out one of them")
    stated = stated_layout(args.output)
    tiles = args.tiles or (stated and args.preset is None and (stated.columns, stated.rows)) or None
    base = QUILT_PRESETS[args.preset or _DEFAULT_PRESET] if panel is None else panel_quilt(panel, tiles)
    if panel is None and args.preset is None and tiles:
        alike = [one for one in QUILT_PRESETS.values() if (one.columns, one.rows) == tiles]
        base = alike[0] if alike else base
    columns, rows = tiles or (base.columns, base.rows)
    aspect = args.aspect or (stated.aspect if stated and args.preset is None else base.aspect)
    width, height = base.width_px or 0, base.height_px or 0
    if args.size is not None:
        width, height = args.size
    elif (columns, rows) != (base.columns, base.rows):
        width, height = width // columns * columns, height // rows * rows
    if width < columns or height < rows:
        raise InputError(f"--size: {width} x {height} pixels are too few for {columns} x {rows} tiles")
    layout = QuiltLayout(columns, rows, aspect, width, height)
    check_divides(layout, "--size")
    return layout


def framed_for(layout: QuiltLayout, panel: Panel | None) -> Panel:
    """The panel that scenes are framed for: that of --panel itself, where the views have its aspect."""
    if panel is None:
        return layout.panel(DEFAULT_CONE_DEG)
    own = replace(panel, views=layout.views, invert_views=False)
    if abs(layout.aspect * panel.height_px / panel.width_px - 1) < 0.01:
        return own
    return replace(own, width_px=max(1, round(panel.height_px * layout.aspect)))


def _check_files(args: argparse.Namespace, layout: QuiltLayout) -> None:
    """Completes the names of the outputs; raises InputError for those that cannot be written, or would be written
    over."""
    args.output = check_image_path(with_suffix(args.output, layout))
    if args.output.suffix.lower() == ".exr":
        raise InputError(f"cannot write {args.output}: a quilt has 8 bits; give .png or .tif")
    if args.save_rgbd is not None:
        path = args.save_rgbd
        if not is_rgbd_name(path):
            path = path.with_name(f"{path.stem}_rgbd{path.suffix}")
        args.save_rgbd = check_image_path(path if path.suffix else path.with_name(f"{path.name}.png"))
    if args.save_rig is not None:
        check_output_path(args.save_rig)
    check_outputs((args.output, args.save_rig, args.save_rgbd), files_read(args))


def _write_rgbd(args: argparse.Namespace, gaussians: Gaussians, panel: Panel, rig: Rig) -> str:
    """Writes the RGB-D image of the centre view, and returns how to read it."""
    import math

    from lightfield_gs.encoding.quilt import rgbd

    image, (near, far) = rgbd(gaussians, panel, rig, background=args.background, antialiased=args.antialiased)
    longer = max(panel.width_px / rig.focal_px[0], panel.height_px / rig.focal_px[1])
    angle = 2 * math.degrees(math.atan(longer / 2))
    depths = {"kind": "disparity", "near": near, "far": far, "field_of_view_deg": angle}
    metadata = {"software": software(), "input": args.input.name, "depth": json.dumps(depths)}
    write_image(args.save_rgbd, image.cpu().numpy(), metadata, args.compression)
    return f"{args.save_rgbd}: read it with --depth-range {near:.6g},{far:.6g} --fov {angle:.5g}"


def _metadata(
    args: argparse.Namespace, gaussians: Gaussians, layout: QuiltLayout, panel: Panel, rig: Rig
) -> dict[str, str]:
    """What the quilt was made from and how it is divided; the values but "software" and "input" are JSON."""
    expect("layout", layout, QuiltLayout)
    width, height = layout.tile_px()
    tiles = {
        "columns": layout.columns,
        "rows": layout.rows,
        "aspect": layout.aspect,
        "views": layout.views,
        "tile_px": [width, height],
        "cone_deg": rig.cone_deg or panel.cone_deg,
        **({"view_filter": args.view_filter} if args.view_filter else {}),
    }
    return {
        "software": software(),
        "input": args.input.name,
        "quilt": json.dumps(tiles),
        "rig": json.dumps(rig.to_dict()),
        "scene": json.dumps(scene_facts(gaussians)),
        "versions": json.dumps(package_versions()),
    }
