"""An input on its way to the image of a panel, in three parts: what `encode` does once, and `batch` over and over."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lightfield_gs.app.cameras import comments_of, load_cameras, read_given
from lightfield_gs.app.look import refuse_look
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.photo_depth import depth_file, depth_model, is_estimated
from lightfield_gs.app.provenance import file_facts, package_versions, scene_facts, software
from lightfield_gs.app.scene import (
    check_scene_options,
    check_scene_path,
    drawn_of,
    files_read,
    frame_scene,
    read_source,
)
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.cuda import to_numpy
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import of_other_methods
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.io.atomic import check_folder, check_output_path, check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.io.png import CompressedImage
from lightfield_gs.io.png_cuda import compressed_image, deflate, is_deflated_on_gpu
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from torch import Tensor

    from lightfield_gs.app.photo import ReadPhoto
    from lightfield_gs.base.cuda import HostCopies, HostCopy
    from lightfield_gs.io.scenes.files import SceneFile
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.gaussians import Gaussians


class Encoding:
    """args.input to args.output: `read`, then `draw`, then `write`, each in any thread.

    `draw` alone needs the device; `read` and `write` are the host's work, beside which other inputs are drawn. What can
    be refused before anything is read is refused when it is made. messages: lines on what was decided; stats: those of
    `encode`. copies: of one input after the other from CUDA to the host; with them `draw` does not wait for the image,
    and counts nothing for the stats. All raise InputError.
    """

    def __init__(self, args: argparse.Namespace, watch: Stopwatch, copies: HostCopies | None = None) -> None:
        self.args, self.watch, self.messages = args, watch, list[str]()
        self.bits = _check_files(args)
        check_options(args)
        self.panel = load_panel(args)
        self.device = choose_device(args.device)
        self.given, self.views = read_given(args, self.panel), views_given(args, self.panel)
        self.rig: Rig | None = None
        self.stats: dict[str, Any] = {}
        self.stored: np.ndarray | CompressedImage  # the image as it is written
        self.image: np.ndarray  # its pixels, where the host has them
        self._counts = copies is None or self.device == "cpu"
        self._copies = copies
        self._copy: HostCopy | None = None
        self._deflated: Tensor | None = None  # the image as the device has compressed it
        self._source: SceneFile | ReadPhoto | None = None
        watch.lap("start")

    def read(self) -> None:
        """Reads the files of the input."""
        self._source = read_source(self.args)

    def draw(self) -> None:
        """Makes the scene of what was read, and the image of the scene, which is on its way to the host then."""
        import torch

        args, panel = self.args, self.panel
        source, self._source = self._source, None  # its memory is of no use any more
        with torch.inference_mode():
            gaussians, self.file, self.messages = drawn_of(
                args, cast("SceneFile", source), panel, self.device, self.watch
            )
            _note_slow_ways(args, panel, self.device)
            # Files of cameras are in the coordinates of the scene's file, and so is what is written of them
            if "cameras" in self.views:
                self.views["cameras"] = self.views["cameras"].relative_to(gaussians.origin)
            else:
                self.rig, how = frame_scene(args, panel, self.given, gaussians, self.file)
                self.messages += how
            self.gaussians = gaussians
            parts = self._parts(self._drawn(self.stats if self._counts else None))
            if self._copies is not None and parts[0].is_cuda:
                self._copy = self._copies.begin([*parts, *gaussians.fields().values()])
            else:
                self._take([to_numpy(part) for part in parts])
        self.watch.lap("image", self.stats.get("stages_ms"))

    def _parts(self, image: Tensor) -> list[Tensor]:
        """What the host needs of the image: the facts of what the device has compressed, or the pixels, or both."""
        args = self.args
        if not is_deflated_on_gpu(image, args.output, args.compression):
            return [image]
        self._deflated, facts = deflate(image)
        return [facts] if args.preview is None else [facts, image]

    def _take(self, parts: Sequence[np.ndarray]) -> None:
        """Takes these parts on the host."""
        out, self._deflated = self._deflated, None
        if out is None:
            self.image = parts[0]
            self.stored = _stored(self.image, self.bits)
        else:
            facts = parts[0]
            if len(parts) > 1:
                self.image = parts[1]
            self.stored = compressed_image((self.panel.height_px, self.panel.width_px, 3), out, facts)

    def _drawn(self, stats: dict[str, Any] | None) -> Tensor:
        """The image, and what `encode` tells of it in stats."""
        from lightfield_gs.encoding.encode import encode

        args = self.args
        return encode(
            self.gaussians,
            self.panel,
            self.rig,
            args.method,
            views=args.views,
            background=args.background,
            output="uint8" if self.bits == 8 else "float32",
            quality=args.quality,
            threads=args.threads,
            stats=stats,
            antialiased=args.antialiased,
            view_filter=args.view_filter,
            **self.views,
        )

    def write(self) -> None:
        """Writes all that was asked for."""
        from lightfield_gs.scene.gaussians import from_tensors

        if self._copy is None:
            self._write()
            return
        import torch

        copies = self._copy.wait()
        try:
            count = len(copies) - len(self.gaussians.fields())
            with torch.cuda.stream(torch.cuda.Stream(self.device)):  # on which nothing is queued that is drawn since
                self._take([copy.numpy() for copy in copies[:count]])
            if self.args.preview is None:  # which is drawn where they were
                self.gaussians = replace(from_tensors(copies[count:]), origin=self.gaussians.origin)
            self._write()
        finally:
            for name in ("gaussians", "image", "stored"):  # which are in memory that others write over
                vars(self).pop(name, None)
            self._copy.release()

    def _write(self) -> None:
        import torch

        args, gaussians, panel = self.args, self.gaussians, self.panel
        rig_of_file = self.rig and self.rig.relative_to([-part for part in gaussians.origin])
        with torch.inference_mode():
            facts = _metadata(args, gaussians, panel, rig_of_file)
            write_image(args.output, self.stored, facts, args.compression)
            if args.save_rig is not None:
                cast("Rig", rig_of_file).to_yaml(args.save_rig)
            if args.save_gaussians is not None:
                gaussians.save(args.save_gaussians, comments_of(args, panel, self.file, rig_of_file))
                along = ", with the framing and what is up" if args.save_gaussians.suffix.lower() == ".ply" else ""
                self.messages.append(f"{args.save_gaussians}: the Gaussians in their own axes{along}")
            self.watch.lap("write")
            if args.preview is not None:
                from lightfield_gs.show.preview import write_preview

                drawn_as = args.background, args.antialiased, args.view_filter
                write_preview(args.preview, self.image, gaussians, panel, cast("Rig", self.rig), *drawn_as)
                self.watch.lap("preview")
            self._note_if_empty()

    def _note_if_empty(self) -> None:
        count = self.gaussians.count
        if not self._counts:
            if not _is_plain(self.stored):
                return
            self.gaussians = self.gaussians.to(self.device)
            self._drawn(self.stats)
        if self.stats["pairs"] == 0 and self.stats["gaussians_culled"] == count:
            note(
                f"{self.args.output} is all background: none of {count} Gaussians is within what the cameras see, or "
                "opaque enough to show; look at the pose (OpenCV axes: z forward, y down) of the rig or the cameras"
            )


def _check_files(args: argparse.Namespace) -> int:
    """Raises InputError for files that cannot be written, or would be written over; returns the bits of the image."""
    bits = bits_of(check_image_path(args.output), args.bit_depth)
    if args.save_rig is not None:
        check_output_path(args.save_rig)
    if args.save_gaussians is not None:
        check_scene_path(args.save_gaussians)
    if args.preview is not None:
        check_folder(args.preview)
    check_outputs(outputs_of(args), files_read(args))
    return bits


def _note_slow_ways(args: argparse.Namespace, panel: Panel, device: str) -> None:
    """Says where a panel or an option keeps the method `direct` from its fastest ways."""
    from lightfield_gs.panels.lens import slow_reason
    from lightfield_gs.rasterizer.quality import Quality

    lattices = args.method == "direct" and Quality.of(args.quality).lattice_error > 0
    if args.method == "direct" and (why := slow_reason(panel, lattices and device == "cuda")):
        note(why)
    if (args.antialiased or args.view_filter) and args.quality != "exact" and device == "cuda":
        note(
            f"{'anti-aliased scenes' if args.antialiased else 'filtered views'} are drawn neither from lattices nor in "
            f"half precision on CUDA: --quality {args.quality} saves little time"
        )


def _is_plain(image: np.ndarray | CompressedImage) -> bool:
    """Whether an image has one colour."""
    if isinstance(image, CompressedImage):
        return image.is_plain
    return all(bool((part == image[0, 0]).all()) for part in (image[::64, ::16], image))


def outputs_of(args: argparse.Namespace) -> list[Path | None]:
    """All files that the command writes; None for what was not asked for."""
    outputs = [args.output, args.save_rig, args.save_gaussians]
    if args.preview is None:
        return outputs
    from lightfield_gs.show.preview import FILES

    return [*outputs, *(args.preview / name for name in FILES)]


def _stored(image: np.ndarray, bits: int) -> np.ndarray:
    if bits != 16:
        return image
    from lightfield_gs.show.preview import to_integers

    return to_integers(image, 16)


def use_threads(threads: int) -> None:
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


def check_options(args: argparse.Namespace) -> None:
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


def views_given(args: argparse.Namespace, panel: Panel) -> dict[str, Any]:
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


def bits_of(path: Path, bit_depth: int | None) -> int:
    """Bits of a sample in the file: 8, 16 or 32 (float)."""
    suffix = path.suffix.lower()
    bits = bit_depth or (32 if suffix == ".exr" else 8)
    if (suffix == ".exr") != (bits == 32) and suffix not in (".tif", ".tiff"):
        raise InputError(
            f"{path}: {suffix} holds {'32' if suffix == '.exr' else '8 or 16'} bits, not {bits}; "
            "change --bit-depth or the extension"
        )
    return bits
