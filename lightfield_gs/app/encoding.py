"""An input on its way to the image of a panel, in three parts: `encode` does them once, `batch` for each input."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lightfield_gs.app.cameras import load_view_cameras, read_camera, refuse_look, scene_comments
from lightfield_gs.app.options import EncodeOptions
from lightfield_gs.app.panel import file_facts, load_panel, package_versions, software
from lightfield_gs.app.scene import (
    LoadedScene,
    RenderSettings,
    build_scene,
    check_scene_options,
    check_scene_path,
    frame_scene,
    read_source,
)
from lightfield_gs.base.cli_messages import Stopwatch, note
from lightfield_gs.base.device import to_numpy
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import ONLY_FOR
from lightfield_gs.io.atomic import check_folder, check_output_path, check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.io.png import CompressedImage, compressed_image, deflate, is_deflated_on_gpu
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.stored_rigs import needs_rig_beside, write_rig_beside
from lightfield_gs.scene.gaussians import scene_facts
from lightfield_gs.webgpu.devices import choose_drawing_device

if TYPE_CHECKING:
    from torch import Tensor

    from lightfield_gs.app.photo import ReadPhoto
    from lightfield_gs.base.device import HostCopies, HostCopy
    from lightfield_gs.io.scenes.files import SceneFile
    from lightfield_gs.panels.rig import Rig


class Encoding:
    """One input to one image: `read`, then `draw`, then `write`, each in any thread.

    `draw` alone needs the device; `read` and `write` are the host's work, beside which other inputs are drawn. Options
    that can be refused before anything is read are refused when it is made. All methods raise InputError.

    Attributes:
        options: what is asked for.
        messages: lines on decisions.
        stats: the statistics of `lightfield_gs.encode`.
        scene: the scene, once it is drawn.
    """

    def __init__(self, options: EncodeOptions, watch: Stopwatch, copies: HostCopies | None = None) -> None:
        """Check the options.

        Args:
            options: what is asked for.
            watch: notes the times.
            copies: from CUDA to the host, one input after the other. With copies `draw` does not wait for the image,
                and collects no statistics.
        """
        self.options, self.watch, self.messages = options, watch, list[str]()
        self.bits = _check_files(options)
        check_options(options)
        self.panel = load_panel(options.panel)
        by_direct = int(options.method == "direct")
        drawing = choose_drawing_device(options.device, self.panel.width_px * self.panel.height_px, by_direct)
        self.device, self._webgpu, self._decisions = drawing
        self.rig: Rig | None = None
        self.stats: dict[str, Any] = {}
        self.scene: LoadedScene
        self.stored: np.ndarray | CompressedImage  # the image for the file
        self.image: np.ndarray  # its pixels, where the host has them
        self._camera = read_camera(options.camera, self.panel)
        self._sorted_views = _read_views(options, self.panel)
        self._counts = copies is None or self.device == "cpu"
        self._copies = copies
        self._copy: HostCopy | None = None
        self._deflated: Tensor | None = None  # the image as the device has compressed it
        self._source: SceneFile | ReadPhoto | None = None
        watch.lap("start")

    def read(self) -> None:
        """Read the files of the input."""
        self._source = read_source(self.options.scene, by_rig="cameras" not in self._sorted_views)

    def draw(self) -> None:
        """Build the scene, draw its image, and start the copy of the image to the host."""
        import torch

        options, panel = self.options, self.panel
        source, self._source = self._source, None  # frees its memory as soon as it is used
        with torch.inference_mode():
            self.scene = build_scene(
                options.scene,
                cast("SceneFile | ReadPhoto", source),
                options.render,
                options.look,
                panel,
                self.device,
                self.watch,
            )
            del source
            self.messages = [*self._decisions, *self.scene.messages]
            gaussians = self.scene.gaussians
            _note_slow_ways(options, self.scene.render, panel, self.device)
            # Files of cameras, read or written, are in the coordinates of the scene's file
            if "cameras" in self._sorted_views:
                self._sorted_views["cameras"] = self._sorted_views["cameras"].relative_to(gaussians.origin)
            else:
                self.rig, how = frame_scene(self._camera, options.look, self.scene, panel)
                self.messages += how
            parts = self._parts_to_copy(self._encode(self.stats if self._counts else None))
            if self._copies is not None and parts[0].is_cuda:
                self._copy = self._copies.begin([*parts, *gaussians.fields().values()])
            else:
                self._take([to_numpy(part) for part in parts])
        self.watch.lap("image", self.stats.get("stages_ms"))

    def _parts_to_copy(self, image: Tensor) -> list[Tensor]:
        """Return the parts of the image that the host needs: its pixels, or facts of the compressed image, or both."""
        options = self.options
        if not is_deflated_on_gpu(image, options.output, options.compression):
            return [image]
        self._deflated, facts = deflate(image)
        return [facts] if options.preview is None else [facts, image]

    def _take(self, parts: Sequence[np.ndarray]) -> None:
        """Take the parts on the host."""
        out, self._deflated = self._deflated, None
        if out is None:
            self.image = parts[0]
            self.stored = _to_bits(self.image, self.bits)
        else:
            facts = parts[0]
            if len(parts) > 1:
                self.image = parts[1]
            self.stored = compressed_image((self.panel.height_px, self.panel.width_px, 3), out, facts)

    def _encode(self, stats: dict[str, Any] | None) -> Tensor:
        """Return the image; `encode` writes its statistics into stats."""
        from lightfield_gs.encoding.encode import encode

        options, render = self.options, self.scene.render
        return encode(
            self.scene.gaussians,
            self.panel,
            self.rig,
            options.method,
            views=options.views,
            background=render.background,
            output="uint8" if self.bits == 8 else "float32",
            quality=options.quality,
            threads=options.threads,
            stats=stats,
            antialiased=render.antialiased,
            view_filter=render.view_filter,
            device=self._webgpu,
            **self._sorted_views,
        )

    def write(self) -> None:
        """Write all files that are asked for."""
        from lightfield_gs.scene.gaussians import from_tensors

        if self._copy is None:
            self._write()
            return
        import torch

        copies = self._copy.wait()
        gaussians = self.scene.gaussians
        try:
            count = len(copies) - len(gaussians.fields())
            with torch.cuda.stream(torch.cuda.Stream(self.device)):  # on which nothing is queued that is drawn since
                self._take([copy.numpy() for copy in copies[:count]])
            if self.options.preview is None:  # a preview is drawn on the device
                self.scene.gaussians = replace(from_tensors(copies[count:]), origin=gaussians.origin)
            self._write()
        finally:
            for name in ("scene", "image", "stored"):  # their memory is written over by other inputs
                vars(self).pop(name, None)
            self._copy.release()

    def _write(self) -> None:
        import torch

        options, scene, panel = self.options, self.scene, self.panel
        rig_of_file = self.rig and scene.in_file(self.rig)
        with torch.inference_mode():
            write_image(options.output, self.stored, _metadata(options, scene, panel, rig_of_file), options.compression)
            if options.save_rig is not None:
                cast("Rig", rig_of_file).to_yaml(options.save_rig, panel)
            if (path := options.save_gaussians) is not None:
                comments = scene_comments(options.camera.up, scene.render.antialiased, panel, scene.file, rig_of_file)
                scene.gaussians.save(path, comments)
                if not needs_rig_beside(path):
                    along = ", with the framing and what is up"
                elif rig_of_file is not None:
                    drawn = scene.render.background, scene.render.antialiased
                    along = f"; framing and background in {write_rig_beside(path, rig_of_file, panel, *drawn)}"
                else:
                    along = ""
                self.messages.append(f"{path}: the Gaussians in their own axes{along}")
            self.watch.lap("write")
            if options.preview is not None:
                from lightfield_gs.show.preview import write_preview

                render = scene.render
                drawn_as = render.background, render.antialiased, render.view_filter
                rig = cast("Rig", self.rig)
                write_preview(options.preview, self.image, scene.gaussians, panel, rig, *drawn_as)
                self.watch.lap("preview")
            self._note_if_empty()

    def _note_if_empty(self) -> None:
        if not self._counts:
            if not _is_plain(self.stored):
                return
            self.scene.gaussians = self.scene.gaussians.to(self.device)
            self._encode(self.stats)
        if self.stats["pairs"] == 0 and self.stats["gaussians_culled"] == (count := self.scene.gaussians.count):
            note(
                f"{self.options.output} is all background: none of {count} Gaussians is within what the cameras see, "
                "or opaque enough to show; look at the pose (OpenCV axes: z forward, y down) of the rig or the cameras"
            )


def check_options(options: EncodeOptions) -> None:
    """Raise InputError where options exclude each other."""
    if options.stereo.stereo is not None:
        raise InputError("--stereo is of one input, by `lightfield-gs encode`; leave it out")
    check_scene_options(options.scene, options.camera)
    if options.method != "direct" and options.device.startswith("webgpu"):
        raise InputError(
            f"--device {options.device} draws by --method direct, not {options.method}: leave out one of them"
        )
    quality = None if options.quality == "exact" else options.quality
    given = {"cameras": options.cameras, "view_map": options.view_map, "memory_budget": options.memory_budget}
    for name, value in {**given, "quality": quality}.items():
        if value is not None and options.method != (only := ONLY_FOR[name]):
            if name == "quality":
                raise InputError(
                    f"--quality {quality} is for --method {only}, not {options.method}; leave out one of them"
                )
            raise InputError(f"--{name.replace('_', '-')} is for --method {only}, not {options.method}")
    for option, value in (("--cameras", options.cameras), ("--view-map", options.view_map)):
        if value is not None and options.views == "continuous":
            raise InputError(
                f"--views continuous is for a rig and the panel's lens, and {option} takes the place of "
                "one; leave out one of them"
            )
    if options.cameras is None:
        return
    for option, is_given in (
        ("--view-filter", bool(options.render.view_filter)),
        ("--rig", options.camera.rig is not None),
        ("--camera", options.camera.camera is not None),
        ("--up", options.camera.up is not None),
        ("--save-rig", options.save_rig is not None),
        ("--preview", options.preview is not None),
        ("--depth-report", options.look.depth_report),
    ):
        if is_given:
            raise InputError(f"{option} is about a rig, and --cameras takes its place; leave out one of them")
    refuse_look(options.look, "is about a rig, and --cameras takes its place")


def _check_files(options: EncodeOptions) -> int:
    """Return the bits of the image. Raise InputError for files that cannot be written, or would be written over."""
    bits = _bit_depth(check_image_path(options.output), options.bit_depth)
    if options.save_rig is not None:
        check_output_path(options.save_rig)
    if options.save_gaussians is not None:
        check_scene_path(options.save_gaussians)
    if options.preview is not None:
        check_folder(options.preview)
    check_outputs(options.outputs(), options.inputs())
    return bits


def _bit_depth(path: Path, bit_depth: int | None) -> int:
    """Return the bits of a sample in the file: 8, 16 or 32 (float)."""
    suffix = path.suffix.lower()
    bits = bit_depth or (32 if suffix == ".exr" else 8)
    if (suffix == ".exr") != (bits == 32) and suffix not in (".tif", ".tiff"):
        raise InputError(
            f"{path}: {suffix} holds {'32' if suffix == '.exr' else '8 or 16'} bits, not {bits}; "
            "change --bit-depth or the extension"
        )
    return bits


def _read_views(options: EncodeOptions, panel: Panel) -> dict[str, Any]:
    """Return the arguments of `encode` that only the method sorted takes, as far as they are given."""
    from lightfield_gs.encoding.view_files import read_view_map

    views: dict[str, Any] = {}
    if options.cameras is not None:
        views["cameras"] = load_view_cameras(options.cameras, panel, options.view_map is not None)
    if options.view_map is not None:
        count = views["cameras"].count if "cameras" in views else panel.views
        views["view_map"] = read_view_map(options.view_map, panel, count)
    if options.memory_budget is not None:
        views["memory_budget"] = options.memory_budget
    return views


def _note_slow_ways(options: EncodeOptions, render: RenderSettings, panel: Panel, device: str) -> None:
    """Note a panel or an option that keeps the method `direct` from its fastest ways."""
    from lightfield_gs.panels.panel import slow_reason
    from lightfield_gs.rasterizer.quality import Quality

    if options.method == "direct" and panel.subpixel_cells:
        lattices = Quality.of(options.quality).lattice_error > 0
        if (why := slow_reason(panel, lattices and device == "cuda")) is not None:
            note(why)
    if (render.antialiased or render.view_filter) and options.quality != "exact" and device == "cuda":
        note(
            f"{'anti-aliased scenes' if render.antialiased else 'filtered views'} are drawn neither from lattices nor "
            f"in half precision on CUDA: --quality {options.quality} saves little time"
        )


def _is_plain(image: np.ndarray | CompressedImage) -> bool:
    """Return whether an image has one colour."""
    if isinstance(image, CompressedImage):
        return image.is_plain
    return all(bool((part == image[0, 0]).all()) for part in (image[::64, ::16], image))


def _to_bits(image: np.ndarray, bits: int) -> np.ndarray:
    if bits != 16:
        return image
    from lightfield_gs.show.preview import to_integers

    return to_integers(image, 16)


def use_threads(threads: int) -> None:
    """Set the number of threads of torch and OpenImageIO."""
    import OpenImageIO as oiio
    import torch

    torch.set_num_threads(threads)
    oiio.attribute("threads", threads)


def _metadata(options: EncodeOptions, scene: LoadedScene, panel: Panel, rig: Rig | None) -> dict[str, str]:
    """Return the input, the settings and the versions of an image; all but "software" and "input" are JSON."""
    gaussians, render = scene.gaussians, scene.render
    facts = scene_facts(gaussians)
    if any(gaussians.origin):
        facts["origin"] = gaussians.origin
    encoding: dict[str, Any] = {
        "method": options.method,
        "views": options.views,
        "background": list(render.background),
        "quality": options.quality,
        **({"antialiased": True} if render.antialiased else {}),
        **({"view_filter": render.view_filter} if render.view_filter else {}),
    }
    photo = options.scene.photo if scene.photo is None else scene.photo.options
    for name, path in (
        ("cameras", options.cameras),
        ("view_map", options.view_map),
        ("depth", photo.depth_file),
        ("camera", options.camera.camera and options.camera.camera[0]),
    ):
        if path is not None:
            encoding[name] = file_facts(path)
    if photo.is_estimated:
        encoding["depth"] = {"model": photo.depth_network}
    elif photo.is_flat:
        encoding["depth"] = "flat"
    maker = {} if rig is None else {"rig": json.dumps(rig.to_dict())}
    return {
        "software": software(),
        "input": options.scene.input.name,
        "panel": json.dumps(panel.to_dict()),
        **maker,
        "scene": json.dumps(facts),
        "encoding": json.dumps(encoding),
        "versions": json.dumps(package_versions()),
    }
