"""From photographs or a film to a capture: pictures are chosen, and their poses found."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from lightfield_gs.base.options import Device
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.pose_estimation.gather import IMAGES, GatherOptions, gather_photographs
from lightfield_gs.pose_estimation.sfm import pycolmap_library, structure_from_motion


def find_poses(
    source: str | Path,
    output: str | Path,
    options: GatherOptions = GatherOptions(),
    progress: Callable[[str], None] = lambda words: None,
    masks: Path | None = None,
    device: Device = "auto",
) -> Path:
    """Find the poses of photographs or of the frames of films, and write the model to output/sparse/0.

    Args:
        source: a folder of photographs, films or both; or a film.
        output: the folder of the new capture.
        options: which pictures are posed.
        progress: called with messages about the current stage.
        masks: a folder of masks, which are not posed.
        device: see structure_from_motion.

    Returns:
        The folder of the photographs: read_capture(output, images=folder) reads the capture.

    Raises:
        InputError: a package is missing, or the pictures are too few or do not pose.
    """
    output = checked_path(output)
    pycolmap_library()
    with _removed_on_failure(output / IMAGES):
        gathered = gather_photographs(source, output, options, progress, masks)
        structure_from_motion(gathered.folder, output, progress, masks, gathered.names, device)
    return gathered.folder


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
