"""`lightfield-gs quilt`: a photo or a scene becomes a quilt, the views of a fan of cameras in one picture."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.cameras import read_camera
from lightfield_gs.app.options import CameraOptions, LookOptions, PanelOptions, RenderOptions, SceneOptions, files_read
from lightfield_gs.app.panel import (
    connected_preset,
    load_panel,
    package_versions,
    panel_of_views,
    panel_words,
    software,
)
from lightfield_gs.app.scene import FramedScene, LoadedScene, check_scene_options, load_framed
from lightfield_gs.base.checks import expect
from lightfield_gs.base.cli_messages import Stopwatch, say, say_next
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_CONE_DEG, DEFAULT_QUILT, Compression
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_output_path, check_outputs, make_folder
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
from lightfield_gs.scene.gaussians import scene_facts
from lightfield_gs.webgpu.devices import choose_drawing_device

if TYPE_CHECKING:
    import numpy as np

    from lightfield_gs.panels.rig import Rig


@dataclass(frozen=True, slots=True)
class QuiltOptions:
    """A photo or a scene that becomes a quilt.

    Attributes:
        output: the quilt; its name is completed.
        scene, panel, camera, look, render: see there. Without a panel the layout is a preset's.
        preset: name of the device that the layout is for.
        tiles: columns and rows.
        size: width and height of the quilt, pixels.
        aspect: width by height of a view as it is seen.
        sweep: columns and rows of views that become files of their own, in a folder.
        save_rig: file for the rig.
        save_rgbd: file for the centre view beside its depth map.
        device: where network and rasterizer run.
        compression: of the file.
        stats: whether to print the times of the stages.
    """

    output: Path
    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    preset: str | None = None
    tiles: tuple[int, int] | None = None
    size: tuple[int, int] | None = None
    aspect: float | None = None
    sweep: tuple[int, int] | None = None
    save_rig: Path | None = None
    save_rgbd: Path | None = None
    device: str = "auto"
    compression: Compression = "fast"
    stats: bool = False


def run(args: argparse.Namespace) -> None:
    """Render args.input into a quilt. Raises InputError."""
    _quilt(read_options(QuiltOptions, args), Stopwatch(args.began))


def _quilt(options: QuiltOptions, watch: Stopwatch) -> None:
    options = _for_sweep(options)
    panel = None if options.panel.panel is None else load_panel(options.panel)
    if panel is None and (options.panel.device_serial or options.panel.viewing_distance):
        raise InputError("--device-serial and --viewing-distance are about a --panel; give one, or leave them out")
    if panel is None and options.look.depth_report:
        raise InputError("--depth-report is about the lens of a --panel; give one, or leave it out")
    layout = quilt_layout(options, panel)
    output, save_rgbd = _output_paths(options, layout)
    check_scene_options(options.scene, options.camera)
    frame = layout.panel(DEFAULT_CONE_DEG) if panel is None else panel_of_views(layout, panel)
    import torch

    pixels = (layout.width_px or 0) * (layout.height_px or 0)
    device, webgpu, decisions = choose_drawing_device(options.device, pixels)
    choice = read_camera(options.camera, frame)
    watch.lap("start")
    with torch.inference_mode():
        from lightfield_gs.encoding.quilt import quilt

        framed = load_framed(options.scene, choice, options.render, options.look, frame, device, watch)
        gaussians, render = framed.scene.gaussians, framed.scene.render
        tile, fan_rig = layout.fitted(frame, framed.rig)
        image = quilt(gaussians, layout, fan_rig, tile, **render.arguments(), device=webgpu).cpu()
        watch.lap("views")
        of_file = framed.scene.in_file(fan_rig)
        metadata = _metadata(options, framed.scene, layout, tile, of_file)
        if options.sweep is None:
            write_image(output, image.numpy(), metadata, options.compression)
        else:
            _write_views(options, layout, image.numpy(), metadata)
        if options.save_rig is not None:
            ratios = [rig.focal_px[0] / rig.focal_px[1] for rig in (fan_rig, framed.rig)]
            is_square = abs(ratios[0] / ratios[1] - 1) < 0.01  # else the tile is the size of no panel
            of_file.to_yaml(options.save_rig, tile if is_square else None)
        watch.lap("write")
        if save_rgbd is not None:
            framed.messages.append(_write_rgbd(save_rgbd, options, framed, frame))
            watch.lap("RGB-D")
    width, height = layout.tile_px()
    name = options.output if options.sweep else output
    print(f"{name}: {layout.views} views of {width} x {height} pixels, {gaussians.count} Gaussians")
    watch.say_if(options.stats)
    say(*decisions, *framed.messages)
    say_next("weave", name, "-o", f"{options.output.with_suffix('')}-3d.png", *panel_words(options.panel.panel))


def _for_sweep(options: QuiltOptions) -> QuiltOptions:
    """Return the options with the tiles of --sweep; raise InputError for what has no single views."""
    if options.sweep is None:
        return options
    if options.tiles is not None:
        raise InputError("--sweep takes the place of --tiles; leave out one of them")
    if options.sweep[1] != 1:
        raise InputError(
            f"--sweep {options.sweep[0]}x{options.sweep[1]}: the cameras stand in one row; give {options.sweep[0]}x1"
        )
    if options.output.suffix:
        raise InputError(f"{options.output}: --sweep writes files into a folder; leave the extension out")
    base = QUILT_PRESETS[options.preset or DEFAULT_QUILT]
    size = options.size
    if options.panel.panel is None and size is None:
        width, height = base.tile_px()
        size = width * options.sweep[0], height
    return replace(options, tiles=options.sweep, size=size)


def _write_views(options: QuiltOptions, layout: QuiltLayout, image: np.ndarray, metadata: dict[str, str]) -> None:
    """Write each view of a quilt into the folder, the left-most camera's first."""
    folder = make_folder(options.output)
    for view in range(layout.views):
        write_image(folder / f"view_{view:03}.png", image[layout.tile(view)], metadata, options.compression)


def quilt_layout(options: QuiltOptions, panel: Panel | None) -> QuiltLayout:
    """Return the layout by the options, or else by the output's name, the panel or the preset. Raises InputError."""
    if panel is not None and options.preset is not None:
        raise InputError("--panel takes the place of --preset; leave out one of them")
    stated = stated_layout(options.output)
    tiles = options.tiles or (stated and options.preset is None and (stated.columns, stated.rows)) or None
    if panel is not None:
        base = panel_quilt(panel, tiles)
    else:
        asked = options.preset or (None if stated or options.tiles else connected_preset())
        base = QUILT_PRESETS[asked or DEFAULT_QUILT]
    if panel is None and options.preset is None and tiles:
        alike = [one for one in QUILT_PRESETS.values() if (one.columns, one.rows) == tiles]
        base = alike[0] if alike else base
    columns, rows = tiles or (base.columns, base.rows)
    aspect = options.aspect or (stated.aspect if stated and options.preset is None else base.aspect)
    width, height = base.width_px or 0, base.height_px or 0
    if options.size is not None:
        width, height = options.size
    elif (columns, rows) != (base.columns, base.rows):
        width, height = width // columns * columns, height // rows * rows
    if width < columns or height < rows:
        raise InputError(f"--size: {width} x {height} pixels are too few for {columns} x {rows} tiles")
    layout = QuiltLayout(columns, rows, aspect, width, height)
    check_divides(layout, "--size")
    return layout


def _output_paths(options: QuiltOptions, layout: QuiltLayout) -> tuple[Path, Path | None]:
    """Return the complete names of the quilt and of the RGB-D image.

    Raises:
        InputError: an output cannot be written, or would be written over an input.
    """
    output = check_image_path(with_suffix(options.output, layout))
    if output.suffix.lower() == ".exr":
        raise InputError(f"cannot write {output}: a quilt has 8 bits; give .png or .tif")
    save_rgbd = None
    if (path := options.save_rgbd) is not None:
        if not is_rgbd_name(path):
            path = path.with_name(f"{path.stem}_rgbd{path.suffix}")
        save_rgbd = check_image_path(path if path.suffix else path.with_name(f"{path.name}.png"))
    if options.save_rig is not None:
        check_output_path(options.save_rig)
    inputs = files_read(options.scene, options.camera, options.panel)
    check_outputs((output, options.save_rig, save_rgbd), inputs)
    return output, save_rgbd


def _write_rgbd(path: Path, options: QuiltOptions, framed: FramedScene, panel: Panel) -> str:
    """Write the RGB-D image of the centre view, and return how to read it."""
    import math

    from lightfield_gs.encoding.quilt import rgbd

    rig, render = framed.rig, framed.scene.render
    image, (near, far) = rgbd(
        framed.scene.gaussians, panel, rig, background=render.background, antialiased=render.antialiased
    )
    longer = max(panel.width_px / rig.focal_px[0], panel.height_px / rig.focal_px[1])
    angle = 2 * math.degrees(math.atan(longer / 2))
    depths = {"kind": "disparity", "near": near, "far": far, "field_of_view_deg": angle}
    metadata = {"software": software(), "input": options.scene.input.name, "depth": json.dumps(depths)}
    write_image(path, image.cpu().numpy(), metadata, options.compression)
    return f"{path}: read it with --depth-range {near:.6g},{far:.6g} --fov {angle:.5g}"


def _metadata(options: QuiltOptions, scene: LoadedScene, layout: QuiltLayout, panel: Panel, rig: Rig) -> dict[str, str]:
    """Return the input, the tiles and the versions of a quilt; all but "software" and "input" are JSON."""
    expect("layout", layout, QuiltLayout)
    width, height = layout.tile_px()
    view_filter = scene.render.view_filter
    tiles = {
        "columns": layout.columns,
        "rows": layout.rows,
        "aspect": layout.aspect,
        "views": layout.views,
        "tile_px": [width, height],
        "cone_deg": rig.cone_deg or panel.cone_deg,
        **({"view_filter": view_filter} if view_filter else {}),
    }
    return {
        "software": software(),
        "input": options.scene.input.name,
        "quilt": json.dumps(tiles),
        "rig": json.dumps(rig.to_dict()),
        "scene": json.dumps(scene_facts(scene.gaussians)),
        "versions": json.dumps(package_versions()),
    }
