"""Decoded views of a folder of objects, kept on disk as raw bytes and mapped into memory.

A training step needs dozens of views, and each takes milliseconds to decode, so every set is decoded once. The cache
holds only the rectangle round the object, which halves the space: outside it a premultiplied image is zero. It also
holds the square to which a photo of the view would be cropped.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path, make_folder
from lightfield_gs.models.crop import MARGIN, object_square
from training.data.background import Choice
from training.data.images import find_cutout, read_view
from training.data.objects import find_objects, object_folder, read_object

_VERSION = 4
_CHUNK = 8  # objects that a process takes at a time


@dataclass(frozen=True)
class CachedObject:
    """One object of V views, all of one size; lengths in pixels.

    Attributes:
        cutout: How the object's pixels were found, in words.
        rectangles: [V,5], (offset, left, top, width, height) of the stored part of each view; the offset counts pixels
            from the start of the set.
        squares: [V,3], (left, top, side) of object_square.
        camera_to_world: [V,4,4] float64.
        intrinsics: [V,4] float64, (fx, fy, cx, cy).
    """

    name: str
    cutout: str
    rectangles: np.ndarray
    squares: np.ndarray
    camera_to_world: np.ndarray
    intrinsics: np.ndarray
    width_px: int
    height_px: int


@dataclass(frozen=True)
class CachedSet:
    """All objects of one folder, root.

    Attributes:
        pixels: [P] int32, the stored parts of all views by rows; the four bytes of a pixel are its premultiplied R, G,
            B and alpha.
    """

    root: Path
    objects: list[CachedObject]
    pixels: np.ndarray

    def __str__(self) -> str:
        """Describe the set: the number of objects, and how they were cut out."""
        ways = Counter(views.cutout for views in self.objects)
        return f"{self.root}: " + ", ".join(f"{count} objects {way}" for way, count in ways.most_common())


def _files(base: Path) -> tuple[Path, Path]:
    """The pixels and the index of a cached set."""
    # Not with_suffix, which cuts a set's name at a dot of its own.
    return base.with_name(f"{base.name}.bytes"), base.with_name(f"{base.name}.json")


def fingerprint(objects: list[Path], background: Choice = "auto") -> str:
    """Return 16 hexadecimal digits that change when any file of the objects is added, removed, moved, resized or
    rewritten.

    Args:
        objects: As find_objects names them.
        background: As find_cutout takes it.
    """
    digest = hashlib.sha256(f"{_VERSION};{MARGIN};{background}".encode())
    for name in objects:
        digest.update(f"{name};".encode())
        for path in sorted(object_folder(name).rglob("*")):
            if path.is_file():
                state = path.stat()
                digest.update(f"{path}:{state.st_size}:{state.st_mtime_ns};".encode())
    return digest.hexdigest()[:16]


def _decode_object(name: Path, background: Choice) -> tuple[dict, list[np.ndarray]]:
    """Decode one object: its entry for the index (offsets from its own start) and the bytes of each view."""
    views = read_object(name)
    cutout = find_cutout(views, background)
    blocks, rectangles, squares, offset = [], [], [], 0
    for index in range(len(views.image_paths)):
        frame = read_view(views, index, cutout)
        squares.append(square_of_view(views.image_paths[index], frame[..., 3]))
        rows, columns = np.flatnonzero(frame[..., 3].any(1)), np.flatnonzero(frame[..., 3].any(0))
        top, left, height, width = rows[0], columns[0], np.ptp(rows) + 1, np.ptp(columns) + 1
        blocks.append(frame[top : top + height, left : left + width].reshape(-1))
        rectangles.append([offset, int(left), int(top), int(width), int(height)])
        offset += blocks[-1].size // 4
    return {
        "name": str(name),
        "cutout": str(cutout),
        "rectangles": rectangles,
        "squares": squares,
        "camera_to_world": views.camera_to_world.tolist(),
        "intrinsics": views.intrinsics.tolist(),
        "width_px": views.width_px,
        "height_px": views.height_px,
    }, blocks


def square_of_view(path: Path, alpha: np.ndarray) -> list[int]:
    """Return left, top and side in pixels of the square round the object of a view, alpha uint8 [H,W].

    Args:
        path: Path of the view's image, for the message.

    Raises:
        InputError: nothing is opaque enough.
    """
    try:
        square = object_square(torch.from_numpy(alpha) / 255)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return [square.left, square.top, square.side]


def _build(names: list[Path], base: Path, workers: int | None, background: Choice) -> None:
    """Decode all objects into <base>.bytes and <base>.json; each appears complete or not at all."""
    entries, offset = [], 0
    workers = min(workers or os.cpu_count() or 1, math.ceil(len(names) / _CHUNK))
    make_folder(base.parent)
    pixels_path, index_path = _files(base)
    with (
        atomic_path(pixels_path) as pixels,
        atomic_path(index_path) as index,
        open(pixels, "wb") as file,
        # A forked process may not use the threads that torch has started in this one.
        ProcessPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool,
    ):
        decoded = pool.map(partial(_decode_object, background=background), names, chunksize=_CHUNK)
        for entry, blocks in tqdm(decoded, total=len(names), desc=f"decoding {base.name}", unit="object"):
            entry["rectangles"] = [[offset + row[0], *row[1:]] for row in entry["rectangles"]]
            entries.append(entry)
            for block in blocks:
                offset += file.write(block.tobytes()) // 4
        index.write_text(json.dumps(entries))


def load_set(root: Path, cache_dir: Path, workers: int | None = None, background: Choice = "auto") -> CachedSet:
    """Open a folder of objects, decoding it into cache_dir if necessary.

    Of a folder with splits it opens the split "train".

    Args:
        workers: Number of processes that decode; None: one per core.
        background: As find_cutout takes it.

    Raises:
        InputError: an object cannot be used; the message names the first. `python -m training.data.validate` lists all.
    """
    root = Path(root).resolve()
    names = find_objects(root, "train")
    base = Path(cache_dir) / f"{root.name}-{fingerprint(names, background)}"
    pixels, index = _files(base)
    if not (pixels.exists() and index.exists()):
        _build(names, base, workers, background)
    entries = json.loads(index.read_text())
    objects = [
        CachedObject(
            entry["name"],
            entry["cutout"],
            np.array(entry["rectangles"], np.int64),
            np.array(entry["squares"]),
            np.array(entry["camera_to_world"]),
            np.array(entry["intrinsics"]),
            entry["width_px"],
            entry["height_px"],
        )
        for entry in entries
    ]
    return CachedSet(root, objects, np.memmap(pixels, np.int32, "c"))
