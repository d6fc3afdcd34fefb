"""Write frames as PNG files into a folder while others are drawn; frames that exist are not drawn again."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Compression
from lightfield_gs.io.atomic import check_folder, make_folder, remove_dead, remove_file
from lightfield_gs.io.images import write_image
from lightfield_gs.io.png import CompressedImage, fetch_image
from lightfield_gs.io.text_files import read_object, write_json

MANIFEST = "frames.json"
MANIFEST_BYTES = 16 << 20
_MOST_WRITERS = 16


def frame_name(number: int) -> str:
    """Return the file name of a frame, numbered from 0."""
    return f"frame-{number:06d}.png"


def job_hash(job: dict[str, Any]) -> str:
    """Return the SHA-256 of all inputs and settings of a video, JSON values."""
    return hashlib.sha256(json.dumps(job, sort_keys=True).encode()).hexdigest()


class FrameFolder:
    """A folder of frames; use it in a `with`, which waits for files that are still being written.

    frames.json holds the number of frames, frames a second, and the hash of the job that they belong to. Existing
    frames of the same job are kept; they are whole, since a file appears complete or not at all. A folder with frames
    of another job is refused unless `overwrite` is set.

    Args:
        folder: the folder.
        count: number of frames.
        job: inputs and settings of the frames, JSON values.
        fps: frames a second.
        metadata: returns the metadata of a frame's file by its number.
        compression: of the PNG files.
        writers: threads, since compressing takes longer than drawing; None: one a core, at most 16. At most twice as
            many frames wait.
        overwrite: whether to remove frames that exist.

    Attributes:
        missing: numbers of the frames to draw.

    Raises:
        InputError: also in `put`, where an earlier frame could not be written.
    """

    def __init__(
        self,
        folder: str | Path,
        count: int,
        job: dict[str, Any],
        *,
        fps: float,
        metadata: Callable[[int], dict[str, str]] | None = None,
        compression: Compression = "fast",
        writers: int | None = None,
        overwrite: bool = False,
    ):
        self.path = check_folder(folder)
        writers = min(os.cpu_count() or 1, _MOST_WRITERS) if writers is None else writers
        self._metadata, self._compression, self._writers = metadata, compression, writers
        self._manifest: dict[str, Any] = {"job": job_hash(job), "frames": count, "fps": fps, "made": job}
        self._overwrite = overwrite
        self.missing = self._missing(count)

    def __enter__(self) -> FrameFolder:
        make_folder(self.path)
        for path in [*self.path.glob(".frame-*.png"), *self.path.glob(f".{Path(MANIFEST).stem}.*.json")]:
            remove_dead(path)
        for path in self.path.glob("frame-*.png") if self._overwrite else ():
            remove_file(path)
        write_json(self._manifest, self.path / MANIFEST)
        self._room = threading.BoundedSemaphore(2 * self._writers)
        self._pool = ThreadPoolExecutor(self._writers, thread_name_prefix="frames")
        self._failed: BaseException | None = None
        return self

    def fetch(self, image: Tensor) -> np.ndarray | CompressedImage:
        """Return a frame, uint8 [H, W, 3], in the form that `put` takes; frames on a GPU are compressed there."""
        return fetch_image(image, self.path / frame_name(0), self._compression)

    def put(self, number: int, image: np.ndarray | CompressedImage) -> None:
        """Queue a frame, uint8 [H, W, 3], which must not change any more; block while too many are waiting."""
        self._room.acquire()
        if self._failed is not None:
            self._room.release()
            raise self._failed
        self._pool.submit(self._write, number, image).add_done_callback(self._done)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._pool.shutdown(wait=True)
        if kind is None and self._failed is not None:
            raise self._failed

    def _write(self, number: int, image: np.ndarray | CompressedImage) -> None:
        metadata = None if self._metadata is None else self._metadata(number)
        write_image(self.path / frame_name(number), image, metadata, self._compression)

    def _done(self, future: Future[None]) -> None:
        self._failed = self._failed or future.exception()
        self._room.release()

    def _missing(self, count: int) -> list[int]:
        """Return the numbers of missing frames. Raises InputError where the folder belongs to another job."""
        manifest = self.path / MANIFEST
        there = {path.name for path in self.path.glob("frame-*.png")}
        if self._overwrite:
            return list(range(count))
        if manifest.is_file():
            other = read_object(manifest, MANIFEST_BYTES)
            if other.get("job") != self._manifest["job"]:
                raise InputError(
                    f"{self.path} holds frames of another job: {_difference(other.get('made'), self._manifest['made'])}"
                    " differ; give another folder, or overwrite=True to remove them"
                )
        elif there:
            raise InputError(
                f"{self.path} holds {len(there)} frames without a {MANIFEST} that says whose they are; give another "
                "folder, or overwrite=True to remove them"
            )
        return [number for number in range(count) if frame_name(number) not in there]


def _difference(other: Any, made: dict[str, Any]) -> str:
    """List the keys in which two jobs differ."""
    if not isinstance(other, dict):
        return "their descriptions"
    return ", ".join(sorted(key for key in {*other, *made} if other.get(key) != made.get(key)))[:200]
