"""Poses of photographs, and points, where nothing is known of them: structure from motion by COLMAP, on the CPU.

Source: Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, through its package pycolmap, an optional
dependency.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.atomic import scratch_folder
from lightfield_gs.io.captures.photo_files import PhotoFiles, outside
from lightfield_gs.io.captures.sfm_cameras import cameras_of, readable
from lightfield_gs.io.captures.sfm_tries import TRIES, Progress, best_model

_LEAST_PHOTOGRAPHS = 3
_MOST_FOR_ALL_PAIRS = 200  # beyond, photographs are matched with those that follow them: all pairs would take hours


def structure_from_motion(
    photographs: str | Path, output: str | Path, progress: Progress = lambda words: None, masks: Path | None = None
) -> Path:
    """Poses the photographs in and below a folder, and writes the model to output/sparse/0, whole or not at all.

    Returns that folder, for read_capture(output, images=photographs). progress: is told in words what is being done.
    Photographs of one size and lens, by their Exif, are taken as one camera (COLMAP's SIMPLE_RADIAL). Masks among them
    are not posed, nor are pictures in the folder `masks`. read_capture says which photographs did not pose. Raises
    InputError where pycolmap is missing, there are too few photographs, or they do not pose.
    """
    pycolmap = _pycolmap()
    files = PhotoFiles(_existing(photographs))
    names = outside(masks, files.folder, files.photographs)
    if len(names) < _LEAST_PHOTOGRAPHS:
        raise InputError(f"{photographs}: expected {_LEAST_PHOTOGRAPHS} photographs or more, got {len(names)}")
    if others := len(files.paths) - len(names):
        assume(f"{photographs}: {others} of {len(files.paths)} pictures are masks by their names or folder: not posed")
    target = checked_path(output) / "sparse" / "0"
    if target.exists():
        raise InputError(f"{target}: there is a model already: read it without --sfm, or remove it")
    target.parent.parent.mkdir(parents=True, exist_ok=True)
    with scratch_folder(target.parent.parent / "sfm") as work:
        best = _posed(pycolmap, files, names, work, progress)
        model = work / "best"
        model.mkdir()
        best.write(str(model))
        target.parent.mkdir(exist_ok=True)
        model.rename(target)
    progress(f"posed {best.num_reg_images()} of {len(names)} photographs, {len(best.points3D)} points")
    return target


def _posed(pycolmap: ModuleType, files: PhotoFiles, names: Sequence[str], work: Path, progress: Progress) -> Any:
    """The largest of pycolmap's reconstructions; raises InputError where there is none."""
    paths, database = {name: files.paths[name] for name in names}, work / "database.db"
    cameras = cameras_of(paths)
    photographs = readable(paths, files.folder, work)
    pycolmap.set_random_seed(0)
    progress(f"features of {len(names)} photographs")
    device = pycolmap.Device.cpu
    try:
        for group in cameras:
            pycolmap.extract_features(
                str(database), str(photographs), group, camera_mode=pycolmap.CameraMode.SINGLE, device=device
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
        raise InputError(f"{files.folder}: COLMAP failed: {' '.join(str(error).split())[:300]}") from error
    if best is None:
        raise InputError(
            f"{files.folder}: the {len(names)} photographs did not pose in {len(TRIES)} tries: expected sharp ones of "
            "a scene that stands still, each overlapping the next by two thirds, from many places"
        )
    return best


def _pycolmap() -> ModuleType:
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            f"--sfm poses photographs by pycolmap, which cannot be imported ({error}): pip install lightfield-gs[sfm]"
        ) from None
    pycolmap.logging.minloglevel = 2  # errors: what else it tells is for its own developers
    return pycolmap


def _existing(folder: str | Path) -> Path:
    folder = checked_path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder of photographs, there is none")
    return folder
