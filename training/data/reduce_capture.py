"""Make a small capture of a large one: `python -m training.data.reduce_capture --source FOLDER --output FOLDER`.

The photographs need poses of COLMAP. An area filter shrinks them to JPEG without metadata. The model becomes text: its
cameras fit the smaller photographs, its lenses stay, and it has no observations. The capture in
lightfield_gs/data/banana was made so and has less than a megabyte. `make demo-fit` fits it, and tests use it as real
photographs.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path, PurePosixPath

import numpy as np
from PIL import Image

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.atomic import atomic_folder, check_new_folder, make_folder
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS
from lightfield_gs.io.captures.capture import Capture, read_capture
from lightfield_gs.io.captures.colmap import ColmapModel, model_folder, read_model
from lightfield_gs.io.captures.colmap_files import ColmapCamera
from training.command import with_line_errors
from training.data.text_model import joined_numbers, write_text_model

LONGEST_PX, QUALITY = 564, 88


def reduce_capture(source: Path, output: Path, longest_px: int = LONGEST_PX, quality: int = QUALITY) -> None:
    """Make the folder `output` of a capture with a COLMAP model; it is complete or absent.

    Args:
        longest_px: Longer side of a photograph.
        quality: Quality of JPEG, 1..95.

    Raises:
        InputError: `output` exists and is not empty, `source` is no such capture, or a file cannot be read or written.
    """
    output = check_new_folder(output)
    capture, folder = read_capture(source), model_folder(Path(source))
    if folder is None:
        raise InputError(f"{source}: expected a capture with a COLMAP model in sparse/0, sparse or the folder itself")
    model = read_model(folder)
    with atomic_folder(output) as temporary:
        sizes = _write_photographs(temporary / "images", capture, longest_px, quality)
        _write_model(make_folder(temporary / "sparse" / "0"), model, sizes, capture)


def _write_photographs(folder: Path, capture: Capture, longest_px: int, quality: int) -> dict[str, tuple[int, int]]:
    """Writes the photographs, still distorted as they are; returns width and height of each by its name."""
    sizes = {}
    for name, photograph in zip(capture.names, capture.photographs):
        with reading(photograph.path), Image.open(photograph.path) as image:
            scale = min(1.0, longest_px / max(image.size))
            width, height = (max(1, round(side * scale)) for side in image.size)
            small = image.convert("RGB").resize((width, height), Image.Resampling.BOX)
        path = folder / _jpeg(name)
        small.save(make_folder(path.parent) / path.name, quality=quality, optimize=True)
        sizes[name] = width, height
    return sizes


def _write_model(folder: Path, model: ColmapModel, sizes: dict[str, tuple[int, int]], capture: Capture) -> None:
    """The model's three files, as text, of the photographs that were written."""
    images = [image for image in model.images if image.world_to_camera is not None and image.name in sizes]
    size_of = {image.camera: sizes[image.name] for image in images}
    cameras = [_camera_line(key, model.cameras[key], size) for key, size in sorted(size_of.items())]
    poses = [
        (_jpeg(image.name), capture.world_to_camera[capture.names.index(image.name)], image.camera)
        for image in sorted(images, key=lambda image: image.name)
    ]
    write_text_model(folder, cameras, poses, capture.points, capture.colours)


def _camera_line(number: int, camera: ColmapCamera, size: tuple[int, int]) -> str:
    """Scale a camera to photographs of another size; one focal length stays one, by the mean ratio of the axes."""
    ratio = np.array(size) / (camera.width_px, camera.height_px)
    focal = camera.intrinsics[:2] * ratio
    if COLMAP_MODELS[camera.model].focal_lengths == 1:
        focal = np.array([math.sqrt(focal[0] * focal[1])])
    parameters = [*focal, *camera.intrinsics[2:] * ratio, *camera.coefficients]
    return f"{number} {camera.model} {size[0]} {size[1]} {joined_numbers(parameters, 10)}"


def _jpeg(name: str) -> str:
    return PurePosixPath(name).with_suffix(".jpg").as_posix()


@with_line_errors("training.data.reduce_capture")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.data.reduce_capture",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--source", type=Path, required=True, help="a folder with photographs and COLMAP's sparse/0")
    parser.add_argument("--output", type=Path, required=True, help="folder for the small capture")
    parser.add_argument(
        "--longest-px", type=int, default=LONGEST_PX, help=f"longer side of a photograph (default: {LONGEST_PX})"
    )
    parser.add_argument("--quality", type=int, default=QUALITY, help=f"of JPEG, 1..95 (default: {QUALITY})")
    options = parser.parse_args(arguments)
    longest_px = whole_number("--longest-px", options.longest_px, 16, 1 << 16)
    reduce_capture(options.source, options.output, longest_px, whole_number("--quality", options.quality, 1, 95))
    size = sum(path.stat().st_size for path in options.output.rglob("*") if path.is_file())
    print(f"{options.output}: {size / 1e6:.2f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
