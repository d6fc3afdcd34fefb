"""PlayCanvas' streamed SOG: a lod-meta.json with a tree of places, and SOG files of Gaussians in several levels.

Each leaf of the tree says for each level in which file its Gaussians are, from where on and how many. Level 0 is the
finest, and is what is read, with the environment around it, which has no levels.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.checks import shown, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.json_file import read_object
from lightfield_gs.io.scenes import render_mode, sog
from lightfield_gs.io.scenes.render_mode import stated_antialiased
from lightfield_gs.io.scenes.stored_scene import StoredScene, same_degree

LOD_META = "lod-meta.json"
_MOST_BYTES = 256 << 20
_MOST = (1 << 31) - 1  # Gaussians of a file


def is_streamed(path: Path) -> bool:
    """Whether a path is a lod-meta.json, or the folder of one."""
    return path.name.lower() == LOD_META or (path / LOD_META).is_file()


def read(path: Path, skip_invalid: bool) -> StoredScene:
    """See stored.py. path: the folder, or its lod-meta.json. Raises InputError."""
    file = path / LOD_META if path.is_dir() else path
    with named(file):
        meta = read_object(file, _MOST_BYTES)
        whole_number("version", meta.get("version", 1), 1, 1)
        names, parts = meta.get("filenames"), dict[int, list[tuple[int, int]]]()
        if not isinstance(names, list) or not isinstance(meta.get("tree"), dict):
            raise InputError("expected a list filenames and an object tree; this is no streamed SOG")
        levels = _collect(meta["tree"], len(names), parts)
        places = {_beside(file, names[index]): ranges for index, ranges in sorted(parts.items())}
    scenes = [_rows(place, sog.read(place, False), ranges) for place, ranges in places.items()]
    if meta.get("environment") is not None:
        scenes.append(sog.read(_beside(file, meta["environment"]), skip_invalid))
    notes = [f"level 0, the finest of {levels}, is read of a streamed SOG"] if levels > 1 else []
    notes += dict.fromkeys(words for scene in scenes for words in scene.notes)
    are_antialiased = all(stated_antialiased(scene.comments) for scene in scenes)
    return StoredScene(
        same_degree([scene.fields for scene in scenes]),
        comments=(render_mode.ANTIALIASED,) if are_antialiased else (),
        notes=notes,
        kind=f"streamed SOG, level 0 of {levels}, {len(scenes)} files",
    )


def _collect(tree: Any, files: int, parts: dict[int, list[tuple[int, int]]]) -> int:
    """Adds the finest part of each leaf, by its file, as its first Gaussian and their number; returns how many levels
    there are. Raises InputError."""
    nodes, levels = [tree], 1
    while nodes:
        node = nodes.pop()
        children, lods = (node.get("children") or [], node.get("lods") or {}) if isinstance(node, dict) else (0, 0)
        if not isinstance(children, list) or not isinstance(lods, dict) or not all(map(str.isdecimal, lods)):
            raise InputError(f"tree: expected nodes with children or lods, got {shown(node)}")
        nodes += reversed(children)
        if not lods:
            continue
        levels = max(levels, 1 + max(map(int, lods)))
        finest = lods[min(lods, key=int)]
        if not isinstance(finest, dict):
            raise InputError(f"tree: expected file, offset and count of a level, got {shown(finest)}")
        most = {"file": files - 1, "offset": _MOST, "count": _MOST}
        file, offset, count = (whole_number(f"tree: {name}", finest.get(name), 0, most[name]) for name in most)
        if count:
            parts.setdefault(file, []).append((offset, count))
    if not parts:
        raise InputError("tree: expected leaves with lods, got none")
    return levels


def _beside(file: Path, name: Any) -> Path:
    """A file of the scene, which is nowhere but in its folder. Raises InputError."""
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or ".." in parts or "\\" in name or PurePosixPath(name).is_absolute():
        raise InputError(f"expected the name of a file in its folder, got {shown(name)}")
    return checked_path(file.parent.joinpath(*parts))


def _rows(path: Path, scene: StoredScene, ranges: list[tuple[int, int]]) -> StoredScene:
    """The scene with these ranges of its Gaussians alone. Raises InputError where it has fewer."""
    count = len(scene.fields["means"])
    if max(start + size for start, size in ranges) > count:
        raise InputError(f"{path}: {LOD_META} expects more Gaussians than the {count} that it has; a wrong file")
    if ranges != [(0, count)]:
        rows = np.concatenate([np.arange(start, start + size) for start, size in ranges])
        scene.fields = {name: array[rows] for name, array in scene.fields.items()}
    return scene
