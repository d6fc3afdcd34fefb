"""Photos and scenes in folders: those that a page may open, each by itself."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.errors import reading
from lightfield_gs.io.depth_names import depth_maps_beside, is_sidecar_name
from lightfield_gs.io.scenes.files import SUFFIXES, is_scene_path
from lightfield_gs.video.sequence import PICTURES, natural_order

_MAPS = (*PICTURES, ".npy", ".npz")
# What a page takes along with photos and scenes: depth maps, and the framing beside a scene
OPENED_SUFFIXES = (*_MAPS, *SUFFIXES, ".yaml")


def photos_and_scenes(folder: Path) -> list[Path]:
    """Return the photos and scenes of a folder, by their names, without depth maps, masks and hidden files.

    Raises InputError where the folder cannot be read.
    """
    with reading(folder):
        files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    maps = {name for names in _maps_beside(files).values() for name in names}
    found = [path for path in files if path.name not in maps and _is_openable(path)]
    return sorted(found, key=natural_order)


def depth_map_beside(photo: Path) -> Path | None:
    """Return the depth map that lies beside a photo by its name, frame_depth.png beside frame.jpg; None without one."""
    with reading(photo):
        beside = _maps_beside(list(photo.parent.iterdir())).get(photo.name)
    return photo.with_name(beside[0]) if beside else None


def _maps_beside(files: list[Path]) -> dict[str, list[str]]:
    return depth_maps_beside(path.name for path in files if path.suffix.lower() in _MAPS)


def _is_openable(path: Path) -> bool:
    if is_scene_path(path):
        return True
    return path.suffix.lower() in PICTURES and path.is_file() and not is_sidecar_name(path.name)
