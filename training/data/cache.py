"""Decoded views of a folder of objects, kept on disk as raw bytes and mapped into memory.

Decoding a view takes milliseconds, a training step needs dozens: so every set is decoded once. Only the rectangle that
holds the object is stored (outside it a premultiplied image is zero), which halves the space at no loss.
"""
from __future__ import annotations

import hashlib
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from lightfield_gs.io.atomic import atomic_path
from training.data.images import read_view
from training.data.objects import find_objects, folder_of, read_object

_VERSION = 2


@dataclass(frozen=True)
class CachedObject:
    """One object: name, V views as (offset, left, top, width, height) rows of [V,5], camera_to_world [V,4,4] and
    intrinsics [V,4] (fx, fy, cx, cy) float64, size of the images; lengths in pixels."""
    name: str
    rectangles: np.ndarray
    camera_to_world: np.ndarray
    intrinsics: np.ndarray
    width_px: int
    height_px: int


class CachedSet:
    """All objects of one folder. Views come as premultiplied uint8 [H,W,4] without decoding."""

    def __init__(self, name: str, objects: list[CachedObject], pixels: np.ndarray) -> None:
        self.name, self.objects, self._pixels = name, objects, pixels

    def view(self, index: int, view: int) -> np.ndarray:
        """View number `view` of object number `index`, uint8 [H,W,4], premultiplied."""
        views = self.objects[index]
        offset, left, top, width, height = views.rectangles[view].tolist()
        frame = np.zeros((views.height_px, views.width_px, 4), np.uint8)
        block = self._pixels[offset:offset + 4 * width * height]
        frame[top:top + height, left:left + width] = block.reshape(height, width, 4)
        return frame


def _fingerprint(objects: list[Path]) -> str:
    """Changes when any file of the set is added, removed, resized or rewritten."""
    digest = hashlib.sha256(str(_VERSION).encode())
    for name in objects:
        digest.update(f"{name};".encode())
        for path in sorted(folder_of(name).rglob("*")):
            if path.is_file():
                state = path.stat()
                digest.update(f"{path}:{state.st_size}:{state.st_mtime_ns};".encode())
    return digest.hexdigest()[:16]


def _decode_object(name: Path) -> tuple[dict, list[np.ndarray]]:
    """Decode one object: its entry for the index (offsets from its own start) and the bytes of each view."""
    views = read_object(name)
    blocks, rectangles, offset = [], [], 0
    for index in range(len(views.image_paths)):
        frame = read_view(views, index)
        rows, columns = np.flatnonzero(frame[..., 3].any(1)), np.flatnonzero(frame[..., 3].any(0))
        top, left, height, width = rows[0], columns[0], np.ptp(rows) + 1, np.ptp(columns) + 1
        blocks.append(frame[top:top + height, left:left + width].reshape(-1))
        rectangles.append([offset, int(left), int(top), int(width), int(height)])
        offset += blocks[-1].size
    return {"name": str(name), "rectangles": rectangles, "camera_to_world": views.camera_to_world.tolist(),
            "intrinsics": views.intrinsics.tolist(), "width_px": views.width_px, "height_px": views.height_px}, blocks


def _build(names: list[Path], base: Path, workers: int) -> None:
    """Decode all objects into <base>.bytes and <base>.json; each appears complete or not at all."""
    entries, offset = [], 0
    base.parent.mkdir(parents=True, exist_ok=True)
    with (atomic_path(base.with_suffix(".bytes")) as pixels, atomic_path(base.with_suffix(".json")) as index,
          open(pixels, "wb") as file, ProcessPoolExecutor(workers) as pool):
        decoded = pool.map(_decode_object, names, chunksize=8)
        for entry, blocks in tqdm(decoded, total=len(names), desc=f"decoding {base.name}", unit="object"):
            entry["rectangles"] = [[offset + row[0], *row[1:]] for row in entry["rectangles"]]
            entries.append(entry)
            for block in blocks:
                offset += file.write(block.tobytes())
        index.write_text(json.dumps(entries))


def load_set(root: Path, cache_dir: Path, workers: int = 2) -> CachedSet:
    """Open a folder of objects (their split "train" where they have any), decoding it into cache_dir when that has not
    been done.

    Raises InputError for the first object that cannot be used (`python -m training.data.validate` lists them all).
    """
    names = find_objects(Path(root).resolve(), "train")
    base = Path(cache_dir) / f"{Path(root).name}-{_fingerprint(names)}"
    if not (base.with_suffix(".json").exists() and base.with_suffix(".bytes").exists()):
        _build(names, base, workers)
    entries = json.loads(base.with_suffix(".json").read_text())
    objects = [CachedObject(entry["name"], np.array(entry["rectangles"], np.int64), np.array(entry["camera_to_world"]),
                            np.array(entry["intrinsics"]), entry["width_px"], entry["height_px"]) for entry in entries]
    return CachedSet(Path(root).name, objects, np.memmap(base.with_suffix(".bytes"), np.uint8, "r"))
