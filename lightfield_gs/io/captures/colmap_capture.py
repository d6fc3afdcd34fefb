"""Captures whose cameras and points COLMAP found: a folder with sparse/0, sparse, or the files of a model themselves,
and a folder of photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import lens_of
from lightfield_gs.io.captures.colmap import count_photographs, is_model, names_decoded, read_model
from lightfield_gs.io.captures.colmap_records import ColmapImage, is_undecoded
from lightfield_gs.io.captures.photo_files import first_names, how_many_there, outside, photographs_in
from lightfield_gs.io.captures.point_files import points_beside
from lightfield_gs.io.captures.readable import readable
from lightfield_gs.io.captures.shot import Shot, Shots

_MODELS = ("sparse/0", "sparse", "")
# What nerfstudio's and Inria's scripts worked on, and what programs export in COLMAP's form beside the photographs
_INNER_MODELS = ("colmap/sparse/0", "distorted/sparse/0", "colmap/sparse", "distorted/sparse", "colmap/0", "colmap")
_IMAGES = ("images", "input", "images_2", "images_4", "images_8", "")
# Windows' code pages that names may be of, the likeliest first: western, Japanese, Chinese, Korean, central European,
# Cyrillic, Greek, Turkish
_CODE_PAGES = ("cp1252", "cp932", "cp936", "cp950", "cp949", "cp1250", "cp1251", "cp1253", "cp1254")


def model_folder(folder: Path, inner: bool = True) -> Path | None:
    """Where below a capture's folder the model is, or the folder itself; None where there is none. inner: also where
    scripts keep the model that they made the capture from."""
    names = (*_MODELS, *_INNER_MODELS) if inner else _MODELS
    numbered = (path for name in names if name.endswith("/0") for path in _models_in((folder / name).parent))
    return next((folder / name for name in names if is_model(folder / name)), next(numbered, None))


def colmap_shots(folder: Path, images: Path | None, masks: Path | None = None) -> Shots:
    """What COLMAP says of the photographs of a capture. images: their folder; None: one of the usual names, the first
    that has them. masks: the folder of masks, if it was given. Of several models beside each other the one of the most
    photographs counts. Raises InputError."""
    model_at = model_folder(folder)
    if model_at is None:
        raise InputError(f"{folder}: expected a COLMAP model in sparse/0, sparse or the folder itself")
    if model_at != folder:
        model_at = _largest(model_at)
    model = read_model(model_at)
    roots = [folder, folder.parent, folder.parent.parent] if model_at == folder else [folder]
    folders = [images] if images else [root / name for root in roots for name in _IMAGES]
    known = _with_names(model_at, model.images, folders)
    posed = [(image, image.world_to_camera) for image in known if image.world_to_camera is not None]
    unposed = [image.name for image in known if image.world_to_camera is None]
    if not posed:
        raise InputError(f"{model_at}: expected photographs with poses, got {len(known)} without")
    found = photographs_in(folders, [image.name for image, _ in posed])
    # A folder that was not given and holds the model too has pictures of other kinds, as masks
    is_mixed = images is None and model_at.is_relative_to(found.folder)
    unknown = [] if is_mixed else outside(masks, found.folder, found.others)
    _say_what_is_left_out(model_at, [name for name in unknown if name not in unposed], unposed)
    places = readable(found.places, found.folder)
    shots = []
    for image, pose in posed:
        if image.name in places:
            camera = model.cameras[image.camera]
            lens = lens_of(camera.model, camera.coefficients)
            size = camera.width_px, camera.height_px
            shots.append(Shot(*places[image.name], pose, camera.intrinsics, size, lens))
    points, colours = model.points, model.colours
    if not len(points):
        points, colours = points_beside(model_at, [folder])
    return Shots(model_at, found.folder, shots, points, colours)


def _models_in(folder: Path) -> list[Path]:
    """The models in the folders 0, 1, ... of this one, in order of their numbers."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if path.name.isdecimal() and is_model(path)]
    return sorted(found, key=lambda path: int(path.name))


def _largest(model: Path) -> Path:
    """The model with the most photographs of those beside this one, which is said; of as many, the first."""
    models = _models_in(model.parent) if model.name.isdecimal() else []
    if len(models) < 2:
        return model
    counts = {path: _count(path) for path in models}
    best = max(models, key=lambda path: counts[path])
    others = [f"{path.name} of {counts[path]}" for path in models if path != best]
    assume(
        f"the model {best} of {counted(counts[best], 'photograph')} is read, not {first_names(others)} beside it: "
        "give one's own folder to choose it"
    )
    return best


def _count(model: Path) -> int:
    """How many photographs a model has; none where it cannot be read."""
    try:
        return count_photographs(model)
    except InputError:
        return 0


def _with_names(model: Path, images: Sequence[ColmapImage], folders: Sequence[Path]) -> Sequence[ColmapImage]:
    """These photographs, names that are no UTF-8 read as of the code page that most files of them are there by."""
    strange = [image for image in images if is_undecoded(image.name)]
    if not strange:
        return images
    decoded = {page: [image.name for image in names_decoded(strange, page)] for page in _CODE_PAGES}
    page = max(_CODE_PAGES, key=lambda page: how_many_there(folders, decoded[page]))  # of as many, the first
    assume(
        f"{model}: the names of {len(strange)} of {len(images)} photographs are no UTF-8 and are read as of Windows' "
        f"code page {page.removeprefix('cp')}: {first_names(decoded[page][:1])}"
    )
    return names_decoded(images, page)


def _say_what_is_left_out(model: Path, unknown: list[str], unposed: list[str]) -> None:
    if unposed:
        words = counted(len(unposed), "photograph", does="have no pose there and are left out")
        assume(f"{model}: {words}: {first_names(unposed)}")
    if unknown:
        words = counted(len(unknown), "photograph", does=f"are not in the model {model} and are left out")
        assume(f"{words}: {first_names(unknown)}")
