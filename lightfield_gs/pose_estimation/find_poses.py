"""From photographs or a film to a capture: pictures are chosen, and their poses found."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from lightfield_gs.base.assumptions import Fallback, assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.captures.masks import FOLDER
from lightfield_gs.io.captures.photo_files import PhotoFiles
from lightfield_gs.pose_estimation.gather import IMAGES, Gathered, gather_photographs
from lightfield_gs.pose_estimation.learned import open_pose_model, pose_by_network
from lightfield_gs.pose_estimation.options import PoseOptions
from lightfield_gs.pose_estimation.people import write_people_masks
from lightfield_gs.pose_estimation.sfm import NotPosed, pycolmap_library, structure_from_motion

_ENOUGH = 0.5  # fraction of the photographs that COLMAP must pose where a network may pose them instead


def find_poses(
    source: str | Path,
    output: str | Path,
    options: PoseOptions = PoseOptions(),
    progress: Callable[[str], None] = lambda words: None,
    masks: Path | None = None,
) -> Path:
    """Find the poses of photographs or of the frames of films, and write the model to output/sparse/0.

    Args:
        source: a folder of photographs, films or both; or a film.
        output: the folder of the new capture.
        options: which pictures are posed, and by what.
        progress: called with messages about the current stage.
        masks: a folder of masks, which are not posed.

    Returns:
        The folder of the photographs: read_capture(output, images=folder) reads the capture.

    Raises:
        InputError: a package is missing, or the pictures are too few or do not pose.
    """
    output = checked_path(output)
    pycolmap_library()
    network = None if options.pose_model is None else open_pose_model(options.pose_model, options.device)
    with _removed_on_failure(output / IMAGES), _removed_on_failure(output / FOLDER):
        gathered = gather_photographs(source, output, options, progress, masks)
        people = output / FOLDER if options.mask_people and _mask_people(gathered, output / FOLDER, progress) else None
        least = 0.0 if network is None else _ENOUGH
        given = gathered.folder, output, progress, masks, gathered.names, options.device, people, least
        try:
            structure_from_motion(*given)
        except NotPosed as error:
            if network is None or options.pose_model is None:
                raise
            assume(f"{error}; {options.pose_model} poses them instead", Fallback)
            pose_by_network(network, options.pose_model, PhotoFiles(gathered.folder), gathered.names, output, progress)
    return gathered.folder


def _mask_people(gathered: Gathered, folder: Path, progress: Callable[[str], None]) -> bool:
    """Write masks of people; return whether there are any. Raises InputError where there are other masks."""
    files = PhotoFiles(gathered.folder)
    if len(files.photographs) < len(files.paths):
        raise InputError(
            f"{gathered.folder}: mask_people=True makes masks, and there are others: take one of both away"
        )
    return write_people_masks({name: files.paths[name] for name in gathered.names}, folder, progress)


def folder_of_photographs(source: Path, output: Path) -> Path:
    """Return the folder of the photographs of a capture that find_poses has made."""
    return images if (images := output / IMAGES).is_dir() else source


@contextlib.contextmanager
def _removed_on_failure(folder: Path) -> Iterator[None]:
    """Remove a folder if it is made in the context, and the context fails."""
    was_there = folder.exists()
    try:
        yield
    except BaseException:
        if not was_there:
            shutil.rmtree(folder, ignore_errors=True)
        raise
