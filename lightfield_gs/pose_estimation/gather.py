"""The photographs to pose: those of a folder, of bursts and of films, without blurred ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.atomic import atomic_folder, checked_path, make_folder
from lightfield_gs.io.captures.photo_files import PhotoFiles, first_names, is_hidden
from lightfield_gs.io.file_kinds import VIDEO_INPUTS
from lightfield_gs.io.images import as_floats, read_image
from lightfield_gs.pose_estimation.exif import time_taken
from lightfield_gs.pose_estimation.films import choose_pictures, write_film_frames
from lightfield_gs.pose_estimation.options import PoseOptions
from lightfield_gs.pose_estimation.sfm import link_file, photographs_to_pose
from lightfield_gs.pose_estimation.sharpness import find_blurred, relative_sharpness, small_grey, structure_tensor

IMAGES = "images"  # the folder of frames, in the folder of the new capture
_REACH = 10  # photographs to either side that sharpness is compared with
_BURST_S, _BURST = 0.5, 4  # seconds between the photographs of a burst, at most, and their least number
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Gathered:
    """Photographs to pose.

    Attributes:
        folder: which they are in or below.
        names: their paths in it.
    """

    folder: Path
    names: list[str]


def gather_photographs(
    source: str | Path,
    output: Path,
    options: PoseOptions = PoseOptions(),
    progress: Progress = lambda words: None,
    masks: Path | None = None,
) -> Gathered:
    """Gather the photographs to pose, with a note on those that are left out.

    Photographs stay where they are, unless there are films. Then their frames, and links to the photographs, are
    written to the folder `images` of the new capture.

    Args:
        source: a folder of photographs, films or both; or a film.
        output: the folder of the new capture.
        options: which are taken.
        progress: called with messages about the current stage.
        masks: a folder of masks, which are no photographs.

    Raises:
        InputError: there are no photographs, or a film cannot be read or shows no motion.
    """
    source = checked_path(source)
    found = _find_films(source)
    names = [] if source.is_file() else photographs_to_pose(files := PhotoFiles(source), masks)
    films = [film for film in found if not _is_live_photo(film, source, names)]
    if not films:
        return Gathered(source, _choose(files, names, options, progress))
    with atomic_folder(output / IMAGES) as folder:
        for film in films:
            inner = film.relative_to(source).with_suffix("") if len(films) + len(names) > 1 else Path()
            write_film_frames(film, make_folder(folder / inner), options.frames, options.keep_blurred, progress)
        for name in _choose(files, names, options, progress) if names else ():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            link_file(files.paths[name], folder / name)
    return Gathered(output / IMAGES, PhotoFiles(output / IMAGES).photographs)


def _find_films(source: Path) -> list[Path]:
    """Return the films in and below a folder, or the film that was given. Raises InputError for other files."""
    if source.is_file():
        if source.suffix.lower() not in VIDEO_INPUTS:
            raise InputError(f"{source}: expected a folder of photographs, or a film ({', '.join(VIDEO_INPUTS[:3])})")
        return [source]
    if not source.is_dir():
        raise InputError(f"{source}: expected a folder of photographs or a film, there is none")
    with reading(source):
        found = sorted(path for path in source.rglob("*") if path.suffix.lower() in VIDEO_INPUTS and path.is_file())
    return [path for path in found if not any(is_hidden(part) for part in path.relative_to(source).parts)]


def _is_live_photo(film: Path, source: Path, names: Sequence[str]) -> bool:
    """Return whether a film belongs to a photograph of its name, as phones store moving photos; note it."""
    inner = PurePosixPath(film.relative_to(source)).with_suffix("").as_posix() if source.is_dir() else ""
    owner = next((name for name in names if PurePosixPath(name).with_suffix("").as_posix() == inner), None)
    if owner is not None:
        assume(f"{film.name} is the moving part of the photograph {owner}, and not taken as a film")
    return owner is not None


def _choose(files: PhotoFiles, names: Sequence[str], options: PoseOptions, progress: Progress) -> list[str]:
    """Return the names of the photographs that are sharp, and of bursts those that a step of parallax divides."""
    bursts = _find_bursts(files, names)
    chosen = set(names)
    for burst in bursts:
        progress(f"looks for steps of parallax in a burst of {len(burst)} photographs")
        found = choose_pictures(_decode(files, burst), options.frames, options.keep_blurred)
        kept = [burst[index] for index in found.indices]
        assume(
            f"{len(kept)} of {len(burst)} photographs of the burst {burst[0]} to {burst[-1]} are taken, the sharpest "
            "of each step of parallax"
        )
        chosen -= set(burst) - set(kept)
    single = [name for name in names if not any(name in burst for burst in bursts)]
    if options.keep_blurred or len(single) < 2:
        return [name for name in names if name in chosen]
    progress(f"looks for blur in {len(single)} photographs")
    tensors = [structure_tensor(small_grey(picture)) for picture in _decode(files, single)]
    blurred = [single[index] for index in np.flatnonzero(find_blurred(relative_sharpness(tensors, _REACH)))]
    if blurred:
        words = counted(len(blurred), "photograph", len(names), "are blurred and left out")
        assume(f"{words}: {first_names(blurred)} (keep_blurred=True keeps them)")
    return [name for name in names if name in chosen - set(blurred)]


def _find_bursts(files: PhotoFiles, names: Sequence[str]) -> list[list[str]]:
    """Return the photographs of each burst in their order: they follow each other faster than a finger taps."""
    times = {name: time for name in names if (time := time_taken(files.paths[name])) is not None}
    bursts: list[list[str]] = []
    before = -np.inf
    for name in sorted(times, key=lambda name: (times[name], name)):
        if times[name] - before > _BURST_S:
            bursts.append([])
        bursts[-1].append(name)
        before = times[name]
    return [burst for burst in bursts if len(burst) >= _BURST]


def _decode(files: PhotoFiles, names: Sequence[str]) -> Iterator[np.ndarray]:
    """Yield photographs as stored, uint8 [H,W,3]. Raises InputError."""
    for name in names:
        pixels = read_image(files.paths[name], as_stored=True, turn=False)
        if pixels.dtype != np.uint8:
            pixels = np.rint(255 * np.clip(as_floats(pixels), 0, 1)).astype(np.uint8)
        yield np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] < 3 else pixels[..., :3]
