"""Structure from motion: poses of photographs, and points, by COLMAP.

Source: Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, through its package pycolmap, an optional
dependency. COLMAP's own settings want an initial pair 16 degrees apart and photographs that determine the focal
length. Where they pose few photographs, mapping is tried again with other settings. Features and matches are a GPU's
where pycolmap is built with CUDA (the package pycolmap-cuda12).
"""

from __future__ import annotations

import copy
import shutil
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.options import POSE_MODEL, Device
from lightfield_gs.io.atomic import checked_path, scratch_folder
from lightfield_gs.io.captures.photo_files import PhotoFiles, names_outside
from lightfield_gs.io.images import as_floats, read_info, read_picture
from lightfield_gs.pose_estimation.exif import ORIENTATION, lens_key, read_exif

LEAST_PHOTOGRAPHS = 3
_MOST_FOR_ALL_PAIRS = 200  # beyond, only successive photographs are matched: all pairs take hours
_COLMAP_READS = (b"\xff\xd8", b"\x89PNG", b"II*\0", b"MM\0*", b"BM")  # how files of JPEG, PNG, TIFF and BMP begin
_MOST_LISTED = 4
CameraKey = tuple[Any, ...]
Progress = Callable[[str], None]
_ENOUGH = 0.9  # fraction of posed photographs that ends the tries
# Range of focal lengths, of the longer side: 9 mm to 144 mm on 35 mm film
_SHORTEST, _LONGEST = 0.25, 4.0
# Directions within _NARROW_DEG hardly determine a focal length. Then it must be within a factor _LARGEST_CHANGE of
# COLMAP's guess, _GUESS of the longer side
_NARROW_DEG, _GUESS = 10.0, 1.2
_LARGEST_CHANGE = 2.0  # factor of the last refinement: beyond, the photographs do not determine the focal length


class NotPosed(InputError):
    """COLMAP finds no poses of these photographs, or of too few."""


def structure_from_motion(
    photographs: str | Path,
    output: str | Path,
    progress: Progress = lambda words: None,
    masks: Path | None = None,
    names: Sequence[str] | None = None,
    device: Device = "auto",
    feature_masks: Path | None = None,
    least: float = 0.0,
) -> Path:
    """Find the poses of the photographs in and below a folder, and write the model to output/sparse/0.

    The model appears whole or not at all. Photographs of one size and lens, by their Exif, share a camera
    (SIMPLE_RADIAL). Masks among them are not posed. read_capture notes photographs without a pose.

    Args:
        photographs: the folder.
        output: the folder of the new capture.
        progress: called with messages about the current stage.
        masks: a folder of masks, whose images are not posed.
        names: the photographs, by their paths in the folder; None: all that are no masks.
        device: "auto" and "cuda" match on a GPU where pycolmap can.
        feature_masks: a folder with NAME.png, black where photographs are not matched.
        least: fraction of the photographs that must pose, 0..1.

    Returns:
        The model's folder, for read_capture(output, images=photographs).

    Raises:
        InputError: where pycolmap is missing or there are too few photographs.
        NotPosed: where they do not pose.
    """
    pycolmap = pycolmap_library()
    files = PhotoFiles(photograph_folder(photographs))
    names = photographs_to_pose(files, masks) if names is None else names
    if len(names) < LEAST_PHOTOGRAPHS:
        raise InputError(f"{photographs}: expected {LEAST_PHOTOGRAPHS} photographs or more, got {len(names)}")
    target = checked_path(output) / "sparse" / "0"
    if target.exists():
        raise InputError(f"{target}: there is a model already: read it without sfm=True, or remove it")
    target.parent.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(target.parent.parent / "sfm") as work:
        best = _reconstruct(pycolmap, files, names, work, progress, _uses_gpu(pycolmap, device), feature_masks)
        if (posed := best.num_reg_images()) < least * len(names):
            raise NotPosed(f"{files.folder}: COLMAP posed {posed} of {len(names)} photographs alone")
        model = work / "best"
        model.mkdir()
        best.write(str(model))
        target.parent.mkdir(exist_ok=True)
        model.rename(target)
    progress(f"posed {best.num_reg_images()} of {len(names)} photographs, {len(best.points3D)} points")
    return target


def _uses_gpu(pycolmap: ModuleType, device: Device) -> bool:
    return device != "cpu" and bool(pycolmap.has_cuda) and torch.cuda.is_available()


def _reconstruct(
    pycolmap: ModuleType,
    files: PhotoFiles,
    names: Sequence[str],
    work: Path,
    progress: Progress,
    on_gpu: bool,
    masks: Path | None,
) -> Any:
    """Return the largest of pycolmap's reconstructions. Raises NotPosed where there is none."""
    paths, database = {name: files.paths[name] for name in names}, work / "database.db"
    cameras = group_by_camera(paths)
    photographs = files_for_colmap(paths, files.folder, work)
    pycolmap.set_random_seed(0)
    progress(f"features of {len(names)} photographs{' on the GPU' if on_gpu else ''}")
    device = pycolmap.Device.cuda if on_gpu else pycolmap.Device.cpu
    readers = {} if masks is None else {"reader_options": pycolmap.ImageReaderOptions(mask_path=str(masks))}
    mode = pycolmap.CameraMode.SINGLE
    try:
        for group in cameras:
            pycolmap.extract_features(
                str(database), str(photographs), group, camera_mode=mode, device=device, **readers
            )
        if len(names) <= _MOST_FOR_ALL_PAIRS:
            progress(f"matches of {len(names) * (len(names) - 1) // 2} pairs")
            pycolmap.match_exhaustive(str(database), device=device)
        else:
            assume(f"the names of {len(names)} photographs are in the order of the camera's way: only near ones match")
            progress("matches of photographs with those that follow")
            pycolmap.match_sequential(str(database), device=device)
        best = best_model(pycolmap, database, photographs, len(names), progress)
    except (RuntimeError, ValueError) as error:
        raise NotPosed(f"{files.folder}: COLMAP failed: {' '.join(str(error).split())[:300]}") from error
    if best is None:
        raise NotPosed(
            f"{files.folder}: the {len(names)} photographs did not pose in {len(MAPPING_SETTINGS)} tries: expected "
            "sharp ones of a scene that stands still, each overlapping the next by two thirds, from many places; a "
            f"network may pose them: pose_model={POSE_MODEL}"
        )
    return best


def photographs_to_pose(files: PhotoFiles, masks: Path | None = None) -> list[str]:
    """Return the names of the photographs in a folder that are no masks, and note how many pictures are.

    Args:
        files: of the folder.
        masks: a folder of masks.
    """
    names = names_outside(masks, files.folder, files.photographs)
    if others := len(files.paths) - len(names):
        assume(f"{files.folder}: {others} of {len(files.paths)} pictures are masks by their names or folder: not posed")
    return names


def pycolmap_library() -> ModuleType:
    """Import pycolmap, an optional extra. Raises InputError where it is missing."""
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            f"sfm=True takes pycolmap, which cannot be imported ({error}): pip install lightfield-gs[sfm]"
        ) from None
    pycolmap.logging.minloglevel = 2  # errors only
    return pycolmap


def photograph_folder(folder: str | Path) -> Path:
    """Return the folder; raise InputError where there is none."""
    folder = checked_path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of photographs, there is none")
    return folder


def group_by_camera(paths: Mapping[str, Path]) -> list[list[str]]:
    """Group names of photographs by size and, where they have Exif, by lens, with a note. Raises InputError."""
    groups: dict[CameraKey, list[str]] = defaultdict(list)
    for name, path in paths.items():
        info = read_info(path)
        groups[(info.width_px, info.height_px, *lens_key(path))].append(name)
    if len(groups) == 1:
        assume(f"the {len(paths)} photographs are of one camera")
    else:
        words = [f"{len(names)} of {_describe(camera)}" for camera, names in groups.items()]
        more = f" and {len(words) - _MOST_LISTED} more" if len(words) > _MOST_LISTED else ""
        assume(
            f"the {len(paths)} photographs are of {len(groups)} cameras, by size and Exif: "
            f"{', '.join(words[:_MOST_LISTED])}{more}"
        )
    return list(groups.values())


def files_for_colmap(paths: Mapping[str, Path], folder: Path, work: Path) -> Path:
    """Return a folder with all photographs in formats that COLMAP reads.

    That is their own folder, if COLMAP reads all of them. Else it is one in `work`, with links, and with JPEG copies
    of other formats, which keep the Exif and the name. Raises InputError.
    """
    others = [name for name, path in paths.items() if not _start(path).startswith(_COLMAP_READS)]
    if not others:
        return folder
    assume(f"COLMAP reads {len(others)} of {len(paths)} photographs as JPEG files, for it knows no {_kinds(others)}")
    copies = work / "photographs"
    for name, path in paths.items():
        target = copies / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name in others:
            _write_jpeg(path, target)
        else:
            link_file(path, target)
    return copies


def _start(path: Path) -> bytes:
    with reading(path), path.open("rb") as file:
        return file.read(4)


def _kinds(names: Sequence[str]) -> str:
    return " or ".join(sorted({Path(name).suffix.lower() for name in names}))


def _describe(camera: CameraKey) -> str:
    width, height, *_, focal, equivalent = camera
    length = f" at {equivalent:g} mm (35 mm film)" if equivalent else f" at {focal:g} mm" if focal else ""
    return f"{width} x {height}{length}"


def _write_jpeg(path: Path, target: Path) -> None:
    """Write a photograph as stored as JPEG, with its Exif without the orientation, which COLMAP and poses ignore."""
    from PIL import Image

    pixels = as_floats(read_picture(path, turn=False).pixels)
    colours = np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] < 3 else pixels[..., :3]
    exif = read_exif(path)
    exif.pop(ORIENTATION, None)
    image = Image.fromarray(np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8))
    image.save(target, "JPEG", quality=95, subsampling=0, exif=exif)


def link_file(path: Path, target: Path) -> None:
    """Link to a file, or copy it where the system has no links."""
    try:
        target.symlink_to(path.resolve())
    except OSError:
        shutil.copyfile(path, target)


@dataclass(frozen=True)
class MappingSettings:
    """Settings of a try of COLMAP's mapping. None: COLMAP's own.

    Attributes:
        first_deg: least angle at a point between the two initial photographs, degrees.
        other_deg: least angle between any others, degrees.
        focal: initial focal length in units of the photographs' longer side, where Exif has none. It stays fixed until
            all photographs are posed.
    """

    first_deg: float | None = None
    other_deg: float | None = None
    focal: float | None = None

    @property
    def words(self) -> str:
        """A description for messages."""
        if self.focal is None:
            return "by COLMAP's own settings"
        return (
            f"from photographs {self.first_deg:g} degrees apart or more, and a focal length of {self.focal:g} x the "
            "longer side where Exif has none"
        )


# Focal length of phones: wide cameras 0.72 of the longer side; telephoto and most other cameras above 1
MAPPING_SETTINGS = (
    MappingSettings(),
    MappingSettings(4, 1.5, 1.2),
    MappingSettings(4, 1.5, 0.75),
    MappingSettings(1.5, 0.5, 1.2),
)


def best_model(pycolmap: ModuleType, database: Path, photographs: Path, count: int, progress: Progress) -> Any:
    """Reconstruct with one setting after the other, and return the best reconstruction, or None.

    Tries end when nearly all photographs are posed with plausible focal lengths. Plausible models of at least half of
    the photographs go before others; then the number of photographs decides. Raises the errors of pycolmap.

    Args:
        pycolmap: the module.
        database: COLMAP's, with features and matches.
        photographs: their folder.
        count: their number.
        progress: called with a message about each try.
    """
    best, chosen, guessed, rank = None, MAPPING_SETTINGS[0], _cameras_without_focal(pycolmap, database), (False, 0)
    for number, settings in enumerate(MAPPING_SETTINGS, 1):
        if settings.focal not in (None, MAPPING_SETTINGS[1].focal) and not guessed:
            continue  # Exif has all focal lengths, and nothing else differs
        if settings.focal is not None:
            _set_focal_lengths(pycolmap, database, guessed, settings.focal)
        model = _map(pycolmap, database, photographs, settings, progress)
        posed = 0 if model is None else model.num_reg_images()
        wrong = None if model is None else _implausible_focal_length(model, guessed)
        found = f"{posed} of {count} photographs" if posed else "none posed"
        progress(f"poses, try {number}, {settings.words}: {found}{'' if wrong is None else f', {wrong}'}")
        if posed and (own := (wrong is None and 2 * posed >= count, posed)) > rank:
            best, chosen, rank = model, settings, own
        if rank >= (True, _ENOUGH * count):
            break
    if best is not None and (wrong := _implausible_focal_length(best, guessed)) is not None:
        assume(
            f"COLMAP finds {wrong}, which the photographs hardly determine: depths and angles may be wrong; "
            "photographs that keep their Exif, or from farther apart, are surer"
        )
    if best is None or chosen.focal is None:
        return best
    best = _refine_focal_lengths(pycolmap, best)
    lengths = ", ".join(f"{camera.mean_focal_length():.0f}" for camera in list(best.cameras.values())[:3])
    assume(
        f"the photographs' directions hardly differ: poses are {chosen.words}, refined to {lengths} px; depths are "
        "less sure than of photographs from farther apart"
    )
    return best


def _map(pycolmap: ModuleType, database: Path, photographs: Path, settings: MappingSettings, progress: Progress) -> Any:
    """Return the largest reconstruction by these settings; None where there is none."""
    options = pycolmap.IncrementalPipelineOptions()
    if settings.focal is not None:
        options.mapper.init_min_tri_angle = settings.first_deg
        options.mapper.filter_min_tri_angle = options.triangulation.min_angle = settings.other_deg
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    models = database.with_name("models")
    models.mkdir(exist_ok=True)
    begun, posed = _posed_counters(progress)
    found = pycolmap.incremental_mapping(
        str(database),
        str(photographs),
        str(models),
        options=options,
        initial_image_pair_callback=begun,
        next_image_callback=posed,
    )
    return max(found.values(), key=lambda model: model.num_reg_images(), default=None)


def _cameras_without_focal(pycolmap: ModuleType, database: Path) -> list[int]:
    """Return the cameras whose focal length is COLMAP's guess, since Exif has none."""
    with pycolmap.Database.open(str(database)) as opened:
        return [camera.camera_id for camera in opened.read_all_cameras() if not camera.has_prior_focal_length]


def _implausible_focal_length(model: Any, guessed: Sequence[int]) -> str | None:
    """Describe a focal length, of the cameras `guessed`, that is hardly the camera's; None where all are plausible."""
    directions = np.array([image.viewing_direction() for image in model.images.values() if image.has_pose])
    least = float((directions @ directions.T).min(initial=1.0)) if len(directions) else 1.0
    low, high = _SHORTEST, _LONGEST
    if least > np.cos(np.radians(_NARROW_DEG)):
        low, high = _GUESS / _LARGEST_CHANGE, _GUESS * _LARGEST_CHANGE
    for number, camera in model.cameras.items():
        length, side = camera.mean_focal_length(), max(camera.width, camera.height)
        if number in guessed and not low <= length / side <= high:
            return f"a focal length of {length:.0f} px, {length / side:.2g} x the longer side"
    return None


def _set_focal_lengths(pycolmap: ModuleType, database: Path, cameras: Sequence[int], focal: float) -> None:
    """Set the focal lengths of these cameras, in units of the longer side, as known, and verify the matches again."""
    with pycolmap.Database.open(str(database)) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in cameras:
                camera.focal_length = focal * max(camera.width, camera.height)
                camera.has_prior_focal_length = True
                opened.update_camera(camera)
        opened.clear_two_view_geometries()
    pycolmap.geometric_verification(str(database))


def _refine_focal_lengths(pycolmap: ModuleType, model: Any) -> Any:
    """Refine the focal lengths of a reconstruction; keep it as it was where the photographs do not determine them."""
    refined = copy.deepcopy(model)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = options.print_summary = False
    pycolmap.bundle_adjustment(refined, options)
    pairs = (
        (model.cameras[key].mean_focal_length(), camera.mean_focal_length()) for key, camera in refined.cameras.items()
    )
    sane = all(before / _LARGEST_CHANGE < after < before * _LARGEST_CHANGE for before, after in pairs)
    return refined if sane else model


def _posed_counters(progress: Progress) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return callbacks for the initial pair of a model, and for each photograph that is posed after it."""
    count = 0

    def begun() -> None:
        nonlocal count
        count = 2

    def posed() -> None:
        nonlocal count
        count += 1
        progress(f"posed {count} photographs")

    return begun, posed
