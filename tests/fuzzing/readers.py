"""All readers of files, as functions of a path, and the corpus of small files for each."""

from __future__ import annotations

import resource
import shutil
import signal
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import features
from scene_formats import gsplat_png, sog, streamed, written

from lightfield_gs import Panel, Rig, SplatterNet, load_photo
from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.batch.items import Item, read_items
from lightfield_gs.batch.manifest import Manifest, make_plan
from lightfield_gs.encoding.view_files import read_cameras, read_view_map
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.captures.camera_files import read_camera_file
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.captures.colmap_files import read_model_file
from lightfield_gs.io.captures.objects import read_intrinsics, read_nerf_object, read_pose
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.io.text_files import read_object
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.panels.simulate import Psf
from lightfield_gs.panels.stored_rigs import photo_camera, stored_framing
from lightfield_gs.photo.depth import read_depth
from lightfield_gs.photo.embedded_depth import embedded_facts
from lightfield_gs.scene.axes import find_up

CORPUS = Path(__file__).parent / "corpus"
SMALL_PANEL = Panel(width_px=4, height_px=2, views=3, line_number=4.0, slant_tan=0.1)
SECONDS_PER_INPUT = 10
BYTES_PER_INPUT = 1 << 30  # growth of the address space


def _read_transforms(path: Path) -> Any:
    """Read a transforms.json beside an image that its frames may name."""
    image = path.with_name("view.png")
    if not image.exists():
        shutil.copyfile(CORPUS / "image" / "rgba.png", image)
    return read_nerf_object(path)


def _read_capture(path: Path) -> None:
    """Read the cameras of a capture, and one of its two photographs without lens distortion."""
    for name in ("view.png", "other.png"):
        if not (image := path.with_name(name)).exists():
            shutil.copyfile(CORPUS / "image" / "rgba.png", image)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Assumption)
        capture = read_capture(path)
    capture.image(0)
    capture.mask(0)


def _read_record3d(path: Path) -> None:
    """Read a Record3D capture with the two photographs of its poses."""
    (path.parent / "rgb").mkdir(exist_ok=True)
    for name in ("rgb/0.png", "rgb/1.png"):
        if not (image := path.parent / name).exists():
            shutil.copyfile(CORPUS / "image" / "rgba.png", image)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Assumption)
        read_capture(path)


def _read_own_camera(path: Path) -> Any:
    """Read the axes and cameras in a scene's file."""
    scene = read_scene(path)
    return find_up(scene.comments), stored_framing(scene.comments), photo_camera(scene.elements)


def _read_spz_inside(path: Path) -> Any:
    """Read an .spz that is compressed after the changes."""
    with reading(path):
        path.with_name("inside.spz").write_bytes(zlib.compress(path.read_bytes(), 1, wbits=31))
    return read_scene(path.with_name("inside.spz"), skip_invalid=True)


def _read_sog_meta(path: Path) -> Any:
    """Read a SOG with this meta.json and good images."""
    folder = path.with_name("sog")
    if not folder.exists():
        written(folder, sog())
    with reading(path):
        (folder / "meta.json").write_bytes(path.read_bytes())
    return read_scene(folder)


def _read_lod_meta(path: Path) -> Any:
    """Read a streamed SOG with this lod-meta.json and good files."""
    folder = path.with_name("streamed")
    if not folder.exists():
        folder.mkdir()
        streamed(folder)
    with reading(path):
        (folder / "lod-meta.json").write_bytes(path.read_bytes())
    return read_scene(folder)


def _read_gsplat_meta(path: Path) -> Any:
    """Read gsplat's PNG compression with this meta.json and good images."""
    folder = path.with_name("gsplat")
    if not folder.exists():
        gsplat_png(folder)
    with reading(path):
        (folder / "meta.json").write_bytes(path.read_bytes())
    return read_scene(folder)


def _read_sog_image(path: Path) -> Any:
    """Read a SOG with this image among good ones."""
    folder = path.with_name("sog-image")
    if not folder.exists():
        written(folder, sog())
    with reading(path):
        (folder / "sh0.webp").write_bytes(path.read_bytes())
    return read_scene(folder)


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes:
        suffix: ending of its files.
        read: function of a path; it may raise InputError and nothing else.
        corpus: folder in CORPUS.
    """

    suffix: str
    read: Callable[[Path], Any]
    corpus: str


def _read_image(path: Path) -> None:
    read_info(path)
    read_image(path, as_stored=True)


def _read_display(path: Path) -> None:
    """Load a display without a serial, then with the serial of the seeds."""
    try:
        Panel.load(path)
    except InputError:
        Panel.load(path, serial="B")


def _read_manifest(path: Path) -> Any:
    """Read a manifest in its folder, and plan two items; damaged lines are skipped."""
    folder = make_folder(path.with_name("folder"))
    with reading(path):
        (folder / "batch.jsonl").write_bytes(path.read_bytes())
    items = [Item("a.png", "a.png"), Item("deep/b.png", "b.ply", "encode", ("--zoom=2",))]
    with Manifest(folder) as manifest:
        make_plan(items, manifest, {"all": {}}, check=True)
        if manifest.damaged:
            raise InputError("passed over")


READERS = {
    "batch-list": Reader(".txt", lambda path: read_items(path, ".png", path.parent / "out"), "batch-list"),
    "batch-manifest": Reader(".jsonl", _read_manifest, "batch-manifest"),
    "ply": Reader(".ply", lambda path: read_scene(path).gaussians.validate(), "ply"),
    "ply-valid": Reader(".ply", lambda path: read_scene(path, skip_invalid=True).gaussians.validate(), "ply"),
    "ply-compressed": Reader(".ply", lambda path: read_scene(path).gaussians.validate(), "ply-compressed"),
    "glb": Reader(".glb", lambda path: read_scene(path, skip_invalid=True).gaussians.validate(), "glb"),
    "gltf": Reader(".gltf", lambda path: read_scene(path, skip_invalid=True).gaussians.validate(), "gltf"),
    "splat": Reader(".splat", lambda path: read_scene(path, skip_invalid=True).gaussians.validate(), "splat"),
    "ksplat": Reader(".ksplat", lambda path: read_scene(path, skip_invalid=True).gaussians.validate(), "ksplat"),
    "spz": Reader(".spz", lambda path: read_scene(path).gaussians.validate(), "spz"),
    "spz-inside": Reader(".bin", _read_spz_inside, "spz-inside"),
    "sog": Reader(".sog", lambda path: read_scene(path).gaussians.validate(), "sog"),
    "sog-meta": Reader(".json", _read_sog_meta, "sog-meta"),
    "lod-meta": Reader(".json", _read_lod_meta, "lod-meta"),
    "gsplat-meta": Reader(".json", _read_gsplat_meta, "gsplat-meta"),
    "scene-zip": Reader(".zip", lambda path: read_scene(path).gaussians.validate(), "scene-zip"),
    "scene-gzip": Reader(".ply.gz", lambda path: read_scene(path).gaussians.validate(), "scene-gzip"),
    "sog-image": Reader(".webp", _read_sog_image, "sog-image"),
    "image": Reader(".png", _read_image, "image"),
    "cut-out": Reader(".png", load_photo, "image"),
    "photo": Reader(".png", lambda path: load_photo(path, whole=True), "image"),
    "photo-inside": Reader(".jpg", lambda path: (read_info(path), embedded_facts(path)), "photo-inside"),
    "depth": Reader(".png", lambda path: read_depth(path, limits=(0.5, 2.0)), "image"),
    "depth-npz": Reader(".npz", lambda path: read_depth(path, scale=0.001), "depth-npz"),
    "depth-npy": Reader(".npy", lambda path: read_depth(path, scale=0.001), "depth-npy"),
    "view-map": Reader(".npy", lambda path: read_view_map(path, SMALL_PANEL, 3), "view-map"),
    "cameras": Reader(".json", lambda path: read_cameras(path, SMALL_PANEL), "cameras"),
    "camera-file": Reader(".json", read_camera_file, "camera-file"),
    "own-camera": Reader(".ply", _read_own_camera, "own-camera"),
    "looking-glass": Reader(".json", _read_display, "looking-glass"),
    "panel": Reader(".yaml", Panel.from_yaml, "panel"),
    "rig": Reader(".yaml", Rig.from_yaml, "rig"),
    "model": Reader(".yaml", ModelConfig.from_yaml, "model"),
    "srn-intrinsics": Reader(".txt", read_intrinsics, "srn-intrinsics"),
    "srn-pose": Reader(".txt", read_pose, "srn-pose"),
    "transforms": Reader(".json", _read_transforms, "transforms"),
    "capture": Reader(".json", _read_capture, "capture"),
    "colmap-cameras": Reader(".bin", lambda path: read_model_file(path, "cameras"), "colmap-cameras"),
    "colmap-images": Reader(".bin", lambda path: read_model_file(path, "images"), "colmap-images"),
    "colmap-points": Reader(".bin", lambda path: read_model_file(path, "points3D"), "colmap-points"),
    "colmap-cameras-text": Reader(".txt", lambda path: read_model_file(path, "cameras"), "colmap-cameras-text"),
    "colmap-images-text": Reader(".txt", lambda path: read_model_file(path, "images"), "colmap-images-text"),
    "colmap-points-text": Reader(".txt", lambda path: read_model_file(path, "points3D"), "colmap-points-text"),
    "colmap-rigs": Reader(".bin", lambda path: read_model_file(path, "rigs"), "colmap-rigs"),
    "colmap-frames": Reader(".bin", lambda path: read_model_file(path, "frames"), "colmap-frames"),
    "colmap-rigs-text": Reader(".txt", lambda path: read_model_file(path, "rigs"), "colmap-rigs-text"),
    "colmap-frames-text": Reader(".txt", lambda path: read_model_file(path, "frames"), "colmap-frames-text"),
    "record3d": Reader(".json", _read_record3d, "record3d"),
    "psf": Reader(".csv", Psf.load, "psf"),
    "object": Reader(".json", lambda path: read_object(path, 1 << 16), "object"),
    "checkpoint": Reader(".safetensors", SplatterNet.from_pretrained, "checkpoint"),
}

if features.check("avif"):  # of Pillow
    READERS["heif"] = Reader(".avif", lambda path: (_read_image(path), embedded_facts(path)), "heif")


def corpus(name: str) -> list[bytes]:
    """Return a reader's files: good ones, and files that it mishandled once."""
    return [path.read_bytes() for path in sorted((CORPUS / READERS[name].corpus).iterdir())]


def attempt(name: str, data: bytes, folder: Path) -> bool:
    """Let a reader read a file with these bytes; return whether it did, and raise for any failure but InputError."""
    path = folder / f"input{READERS[name].suffix}"
    path.write_bytes(data)
    try:
        with time_limit(SECONDS_PER_INPUT):
            READERS[name].read(path)
    except InputError as error:
        message = str(error)
        if "\n" in message or len(message) > 2000:
            raise AssertionError(f"expected one line that is no novel, got {message[:3000]!r}") from error
        return False
    return True


class TooSlow(BaseException):
    """A reader took too long; no Exception, so that no reader swallows it."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise TooSlow(f"more than {seconds} s for one file")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def memory_limit(more: int = BYTES_PER_INPUT) -> Iterator[None]:
    """Limit the growth of the address space to `more` bytes; larger allocations fail."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
