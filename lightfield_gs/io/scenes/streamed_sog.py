"""PlayCanvas' streamed SOG, version 1: a lod-meta.json with a spatial tree, and SOG folders of Gaussians in levels.

Each leaf of the tree is a chunk of the scene. It lists for each level a file, an offset and a count; level 0 is the
finest. A level that a leaf lacks is its next coarser one. The environment has no levels and is always shown. Paths are
relative to the folder. Specification: developer.playcanvas.com, "The Streamed SOG Format".

This package adds keys, which other readers skip. "comments" are lines as in the header of a .ply. A leaf has
"pixelSizes" and "pixelErrors", by which it is known how well a level shows from where; see
simplification/levels.py. "errors", the squared errors of the levels by the squares of the finest, is
splat-transform's.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.checks import counted, is_row, shown, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.system import free_host_memory
from lightfield_gs.io.atomic import atomic_folder, check_new_folder, checked_path
from lightfield_gs.io.scenes import sog, sog_writing
from lightfield_gs.io.scenes.comments import ANTIALIASED, is_antialiased
from lightfield_gs.io.scenes.scene_arrays import Fields, SceneArrays, concatenate_fields
from lightfield_gs.io.scenes.sog_files import META
from lightfield_gs.io.text_files import read_object

LOD_META = "lod-meta.json"
GAUSSIAN_BYTES = 1024  # of memory to read and draw a Gaussian, about
_FILE = 1 << 16  # most Gaussians in a written file: the palette of harmonics has no more entries
_LOD_META_BYTES = 256 << 20
_MOST_COUNT = (1 << 31) - 1
_LEVEL = re.compile(r"\d{1,4}")
_Part = tuple[int, int, int]  # file, offset and count


@dataclass
class Leaf:
    """A chunk of a scene in levels.

    Attributes:
        parts: file, offset and count by level.
        bound: [2,3], least and greatest coordinates of what is drawn, as far as the file tells.
        pixels: [S], sizes of a pixel, scene units, each by one factor larger than the one before; None where the file
            has no errors.
        errors: [L,S], of the levels 0..L-1 with such pixels: the squared error of the chunk's image against the finest
            level's, from the worst of six sides. Its unit is that of colours in 0..1, squared, times the area in scene
            units squared. The background is black in one half, and white in the other.
    """

    parts: dict[int, _Part]
    bound: np.ndarray | None = None
    pixels: np.ndarray | None = None
    errors: np.ndarray | None = None

    def at(self, level: int) -> _Part:
        """Return file, offset and count at a level, or at the next coarser or else the coarsest one it has."""
        return self.parts[min((own for own in self.parts if own >= level), default=max(self.parts))]


def is_streamed(path: Path) -> bool:
    """Tell whether a path is a lod-meta.json, or its folder."""
    return path.name.lower() == LOD_META or (path / LOD_META).is_file()


def index_path(path: Path) -> Path:
    """Return the lod-meta.json of a path that is_streamed."""
    return path / LOD_META if path.is_dir() else path


# Reading


class StreamedSog:
    """A streamed SOG whose index is read, and whose files are read as they are asked for.

    Attributes:
        path: of its lod-meta.json.
        leaves: the chunks.
        levels: the levels that a leaf has, ascending.
    """

    def __init__(self, path: Path) -> None:
        """Read the index; raise InputError."""
        self.path = index_path(path)
        with named(self.path):
            meta = read_object(self.path, _LOD_META_BYTES)
            whole_number("version", meta.get("version", 1), 1, 1)
            names = meta.get("filenames")
            if not isinstance(names, list) or not isinstance(meta.get("tree"), dict):
                raise InputError("expected a list filenames and an object tree; this is no streamed SOG")
            self.leaves = _collect_leaves(meta["tree"], len(names))
            self._names, self._environment = names, meta.get("environment")
            comments = meta.get("comments")
            self._comments = tuple(map(str, comments)) if isinstance(comments, list) else ()
        self.levels = sorted({level for leaf in self.leaves for level in leaf.parts})

    @property
    def has_errors(self) -> bool:
        """Whether it is known of every leaf how well its levels show."""
        return all(leaf.errors is not None and leaf.bound is not None for leaf in self.leaves)

    def count(self, level: int) -> int:
        """Return the number of Gaussians at a level, but for the environment."""
        return sum(leaf.at(level)[2] for leaf in self.leaves)

    def read_level(self, skip_invalid: bool, lod: int | None) -> SceneArrays:
        """Read one level; see files.read_arrays."""
        with named(self.path):
            level, words = self._choose_level(lod)
            if not self.count(level):
                raise InputError(f"level {level} has no Gaussians; choose another with lod=N")
        kind = f"streamed SOG, level {level} of 0..{self.levels[-1]}"
        scene = self.read([level] * len(self.leaves), skip_invalid, kind)
        words += "; its environment is read too" if self._environment is not None else ""
        scene.notes[:0] = [words] * any(len(leaf.parts) > 1 for leaf in self.leaves)
        return scene

    def read(self, levels: Sequence[int | None], skip_invalid: bool, kind: str = "streamed SOG") -> SceneArrays:
        """Read a level of each leaf, or none of it, and the environment; raise InputError."""
        ranges = dict[int, list[tuple[int, int]]]()
        for leaf, level in zip(self.leaves, levels):
            if level is not None and (part := leaf.at(level))[2]:
                ranges.setdefault(part[0], []).append(part[1:])
        with named(self.path):
            paths = {_beside(self.path, self._names[index]): ranges[index] for index in sorted(ranges)}
            if self._environment is not None:
                environment = _beside(self.path, self._environment)
        scenes = [_select_rows(part, sog.read(part, False), own) for part, own in paths.items()]
        if self._environment is not None:
            scenes.append(sog.read(environment, skip_invalid))
        comments = self._comments
        if not comments and all(is_antialiased(scene.comments) for scene in scenes):
            comments = (ANTIALIASED,)
        return SceneArrays(
            concatenate_fields([scene.fields for scene in scenes]),
            comments=comments,
            notes=list(dict.fromkeys(note for scene in scenes for note in scene.notes)),
            kind=f"{kind}, {counted(len(scenes), 'file')}",
        )

    def read_leaves(self, level: int) -> tuple[SceneArrays, np.ndarray]:
        """Read a level of all leaves without the environment; return it, and the leaf of each Gaussian, int64 [N]."""
        order = sorted(range(len(self.leaves)), key=lambda index: self.leaves[index].at(level)[0])
        environment, self._environment = self._environment, None
        try:
            scene = self.read([level] * len(self.leaves), False)
        finally:
            self._environment = environment
        return scene, np.repeat(order, [self.leaves[index].at(level)[2] for index in order])

    def _choose_level(self, lod: int | None) -> tuple[int, str]:
        """Return the level to read, and a line on it: the one given, or the finest that fits half the free memory."""
        levels, free = self.levels, free_host_memory()
        if lod is not None:
            level, reason = whole_number("lod", lod, 0, levels[-1]), "as chosen"
        else:
            fitting = [one for one in levels if free is None or GAUSSIAN_BYTES * self.count(one) <= free / 2]
            level, reason = fitting[0] if fitting else levels[-1], "the finest; another: lod=N"
            if level != levels[0]:
                assert free is not None
                finest = f"level {levels[0]} has {self.count(levels[0])} for {free / 2**30:.3g} GiB of free memory"
                reason = f"the finest that fits: {finest}; another: lod=N"
        return level, (
            f"level {level} of 0..{levels[-1]} is read of a streamed SOG, {self.count(level)} Gaussians ({reason})"
        )


def read(path: Path, skip_invalid: bool, lod: int | None = None) -> SceneArrays:
    """Read one level of a streamed SOG, by its folder or its lod-meta.json; see files.read_arrays."""
    return StreamedSog(path).read_level(skip_invalid, lod)


def _collect_leaves(tree: Any, files: int) -> list[Leaf]:
    """Collect the leaves of a tree; raise InputError for a malformed tree; files: their number."""
    nodes, leaves = [tree], list[Leaf]()
    while nodes:
        node = nodes.pop()
        children, lods = (node.get("children") or [], node.get("lods") or {}) if isinstance(node, dict) else (0, 0)
        if not isinstance(children, list) or not isinstance(lods, dict) or not all(map(_LEVEL.fullmatch, lods)):
            raise InputError(f"tree: expected nodes with children or lods, got {shown(node)}")
        nodes += reversed(children)
        parts = {}
        for key, part in lods.items():
            if not isinstance(part, dict):
                raise InputError(f"tree: expected file, offset and count of a level, got {shown(part)}")
            most = {"file": files - 1, "offset": _MOST_COUNT, "count": _MOST_COUNT}
            file, offset, count = (whole_number(f"tree: {name}", part.get(name), 0, most[name]) for name in most)
            parts[int(key)] = (file, offset, count)
        if parts:
            leaves.append(Leaf(parts, _bound(node.get("bound")), *_errors(node, max(parts) + 1)))
    if not any(count for leaf in leaves for _, _, count in leaf.parts.values()):
        raise InputError("tree: expected leaves with lods, got none")
    return leaves


def _bound(stored: Any) -> np.ndarray | None:
    ends = [stored.get(end) for end in ("min", "max")] if isinstance(stored, dict) else []
    return np.array(ends, np.float64) if len(ends) == 2 and all(_are_numbers(end, 3) for end in ends) else None


def _errors(node: dict[str, Any], levels: int) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the sizes of pixels and the errors of a leaf; None where they are missing or malformed."""
    sizes, rows = node.get("pixelSizes"), node.get("pixelErrors")
    if not isinstance(sizes, list) or len(sizes) < 2 or not isinstance(rows, list) or len(rows) != levels:
        return None, None
    if not all(_are_numbers(row, len(sizes)) for row in (sizes, *rows)) or not 0 < sizes[0] < sizes[1]:
        return None, None
    return np.array(sizes, np.float64), np.array(rows, np.float64)


def _are_numbers(values: Any, count: int) -> bool:
    return is_row(values, count) and all(type(value) in (int, float) and abs(value) < 1e30 for value in values)


def _beside(file: Path, name: Any) -> Path:
    """Return the path of a file in the scene's folder; raise InputError for names of other places."""
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or ".." in parts or "\\" in name or PurePosixPath(name).is_absolute():
        raise InputError(f"expected the name of a file in its folder, got {shown(name)}")
    return checked_path(file.parent.joinpath(*parts))


def _select_rows(path: Path, scene: SceneArrays, ranges: list[tuple[int, int]]) -> SceneArrays:
    """Select ranges (offset, count) of a scene's Gaussians; raise InputError where it has fewer."""
    count = len(scene.fields["means"])
    if max(start + size for start, size in ranges) > count:
        raise InputError(f"{path}: {LOD_META} expects more Gaussians than the {count} that it has; a wrong file")
    if ranges != [(0, count)]:
        rows = np.concatenate([np.arange(start, start + size) for start, size in ranges])
        scene.fields = {name: array[rows] for name, array in scene.fields.items()}
    return scene


# Writing


@dataclass
class WrittenChunk:
    """A chunk to write.

    Attributes:
        levels: fields of its Gaussians by name, the finest level first.
        bound: [2,3].
        pixels, errors: as in Leaf.
        energies: [L], squared errors by the squares of the finest level's image.
    """

    levels: list[Fields]
    bound: np.ndarray
    pixels: np.ndarray
    errors: np.ndarray
    energies: np.ndarray


@dataclass
class _Level:
    """The files of a level so far; the last one grows in memory until it is full."""

    level: int
    files: int = 0
    waiting: list[Fields] = field(default_factory=list)
    count: int = 0
    total: int = 0


def check_index_path(path: Path) -> Path:
    """Return the folder of a lod-meta.json that can be written; raise InputError where it holds files."""
    return check_new_folder(path.parent)


def write(
    path: Path,
    chunks: Iterable[WrittenChunk],
    tree: list,
    comments: Sequence[str] = (),
    progress: Callable[[int], None] = lambda chunks: None,
) -> list[int]:
    """Write a streamed SOG, the whole folder or nothing.

    Args:
        path: FOLDER/lod-meta.json; the folder is absent or empty.
        chunks: in the order of the leaves; each is written and forgotten.
        tree: nested lists; what is no list is a leaf.
        comments: lines as in the header of a .ply.
        progress: called with the number of chunks so far.

    Returns:
        The numbers of Gaussians by level.

    Raises:
        InputError: the folder is not empty, or it cannot be written.
    """
    antialiased = bool(is_antialiased(comments))
    names, nodes, levels = dict[str, int](), list[dict[str, Any]](), list[_Level]()
    with atomic_folder(check_index_path(path)) as folder:

        def close(level: _Level) -> None:
            if level.waiting:
                own = folder / f"{level.level}_{level.files}"
                own.mkdir()
                sog_writing.write_folder(own, concatenate_fields(level.waiting), antialiased)
                level.files, level.waiting, level.count = level.files + 1, [], 0

        def place(number: int, fields: Fields) -> dict[str, int]:
            if number == len(levels):
                levels.append(_Level(number))
            level, count = levels[number], len(fields["means"])
            if level.count + count > _FILE:
                close(level)
            name = f"{number}_{level.files}/{META}"
            offset = level.count
            level.waiting.append(fields)
            level.count, level.total = offset + count, level.total + count
            return {"file": names.setdefault(name, len(names)), "offset": offset, "count": count}

        for done, chunk in enumerate(chunks, 1):
            lods = {str(number): place(number, fields) for number, fields in enumerate(chunk.levels)}
            bound = {"min": _short(chunk.bound[0]), "max": _short(chunk.bound[1])}
            errors = {"errors": _short(chunk.energies), "pixelSizes": _short(chunk.pixels)}
            nodes.append({"bound": bound, "lods": lods, **errors, "pixelErrors": [_short(row) for row in chunk.errors]})
            progress(done)
        for level in levels:
            close(level)
        counts = [level.total for level in levels]
        meta = {
            "version": 1,
            "asset": {"generator": "lightfield-gs"},
            "count": sum(counts),
            "counts": counts,
            "lodLevels": len(levels),
            "lodErrors": True,
            "filenames": list(names),
            "comments": list(comments),
            "tree": _node(tree, iter(nodes)),
        }
        (folder / path.name).write_text(json.dumps(meta) + "\n", encoding="utf-8")
    return counts


def _short(values: np.ndarray) -> list[float]:
    """Return numbers with the digits of float32."""
    return [float(f"{value:.8g}") for value in values.tolist()]


def _node(tree: Any, leaves: Any) -> dict[str, Any]:
    if not isinstance(tree, list):
        return next(leaves)
    children = [_node(branch, leaves) for branch in tree]
    if len(children) == 1:
        return children[0]
    low = np.min([child["bound"]["min"] for child in children], 0)
    high = np.max([child["bound"]["max"] for child in children], 0)
    return {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": children}
