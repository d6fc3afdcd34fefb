"""Captures whose cameras and points COLMAP found: a folder with sparse/0, sparse, or the files of a model themselves,
and a folder of photographs."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import lens_of
from lightfield_gs.io.captures.colmap import is_model, read_model
from lightfield_gs.io.captures.photo_files import first_names, photographs_in
from lightfield_gs.io.captures.shot import Shot, Shots

_MODELS = ("sparse/0", "sparse", "")
_INNER_MODELS = ("colmap/sparse/0", "distorted/sparse/0")  # what nerfstudio's and Inria's scripts worked on
_IMAGES = ("images", "input", "images_2", "images_4", "images_8", "")


def model_folder(folder: Path, inner: bool = True) -> Path | None:
    """Where below a capture's folder the model is, or the folder itself; None where there is none. inner: also where
    scripts keep the model that they made the capture from."""
    names = (*_MODELS, *_INNER_MODELS) if inner else _MODELS
    return next((folder / name for name in names if is_model(folder / name)), None)


def colmap_shots(folder: Path, images: Path | None) -> Shots:
    """What COLMAP says of the photographs of a capture. images: their folder; None: one of the usual names, the first
    that has them. Raises InputError."""
    model_at = model_folder(folder)
    if model_at is None:
        raise InputError(f"{folder}: expected a COLMAP model in sparse/0, sparse or the folder itself")
    model = read_model(model_at)
    posed = [(image, image.world_to_camera) for image in model.images if image.world_to_camera is not None]
    unposed = [image.name for image in model.images if image.world_to_camera is None]
    if not posed:
        raise InputError(f"{model_at}: expected photographs with poses, got {len(model.images)} without")
    roots = [folder, folder.parent, folder.parent.parent] if model_at == folder else [folder]
    folders = [images] if images else [root / name for root in roots for name in _IMAGES]
    files, paths = photographs_in(folders, [image.name for image, _ in posed])
    # In a folder that holds the model too there are pictures of other kinds, as masks
    unknown = [] if model_at.is_relative_to(files.folder) else files.without(paths)
    _say_what_is_left_out(model_at, unknown, unposed)
    shots = []
    for (image, pose), path in zip(posed, paths):
        camera = model.cameras[image.camera]
        lens = lens_of(camera.model, camera.coefficients)
        size = camera.width_px, camera.height_px
        shots.append(Shot(image.name, path, pose, camera.intrinsics, size, lens))
    return Shots(model_at, files.folder, shots, model.points, model.colours)


def _say_what_is_left_out(model: Path, unknown: list[str], unposed: list[str]) -> None:
    if model.name.isdigit():
        others = sorted(path.name for path in model.parent.iterdir() if path != model and is_model(path))
        if others:
            assume(
                f"the model {model} is read, not {first_names(others)} beside it: give one's own folder to choose it"
            )
    if unposed:
        assume(f"{model}: {len(unposed)} photographs have no pose there and are left out: {first_names(unposed)}")
    if unknown:
        assume(f"{len(unknown)} photographs are not in the model {model} and are left out: {first_names(unknown)}")
