"""Scenes in a row: a folder of numbered files of Gaussians, of which a thread reads the next ones ahead."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from lightfield_gs.base.checks import counted
from lightfield_gs.io.atomic import checked_path, sha256
from lightfield_gs.io.file_kinds import SCENE_SUFFIXES, select_scenes
from lightfield_gs.io.scenes.files import SceneFile, is_scene_path
from lightfield_gs.io.scenes.scene_arrays import concatenate_fields
from lightfield_gs.scene.gaussians import Gaussians, from_arrays
from lightfield_gs.video.sequence import PICTURES, files_in

_NUMBERED = re.compile(r"(.*?)(\d+)(\D*)", re.DOTALL)
_AHEAD = 2  # scenes that are read before they are asked for
_SAMPLED = 8  # scenes by which a sequence is framed


@dataclass(frozen=True)
class SceneSequence:
    """Files of Gaussians in a row.

    Attributes:
        path: the folder.
        files: in the order of their numbers, two or more.
        gaps: how many numbers between the first and the last have no file.
    """

    path: Path
    files: tuple[Path, ...]
    gaps: int

    def describe(self) -> str:
        """Describe the sequence for the user."""
        words = f"scenes: {len(self.files)} in a row, {self.files[0].name} to {self.files[-1].name}, framed together"
        return words + (f"; {counted(self.gaps, 'number')} between them without a file" if self.gaps else "")

    def digest(self) -> str:
        """Return the SHA-256 over the contents of the files."""
        return sha256(*self.files)


def find_scene_sequence(path: str | Path) -> SceneSequence | None:
    """Return the scenes of a folder whose names differ in one number alone; None for other paths.

    A folder with pictures, or with other scenes beside them, is no sequence; one with a single scene neither.
    """
    path = checked_path(path)
    if not path.is_dir() or is_scene_path(path):
        return None
    files = files_in(path, SCENE_SUFFIXES)
    files = [file for file in files if select_scenes([file.name])]
    parts = [_NUMBERED.fullmatch(file.name[: -len(file.suffix)]) for file in files]
    if len(files) < 2 or len({(part[1], part[3]) if part else None for part in parts}) != 1 or None in parts:
        return None
    if len({file.suffix.lower() for file in files}) != 1 or files_in(path, PICTURES):
        return None
    numbers = [int(part[2]) for part in parts if part]
    return SceneSequence(path, tuple(files), numbers[-1] - numbers[0] + 1 - len(files))


class SceneReader(AbstractContextManager):
    """Reads the scenes of a sequence, and holds some of them.

    All have the origin of the first, so that one rig fits all.

    Attributes:
        sequence: the files.
        first: what the first file holds.
        notes: of each scene that was read, by its number.

    Args:
        sequence: the files.
        read: reads a file.
        most_bytes: of the scenes that are held; those that are read ahead are held in any case.
    """

    def __init__(self, sequence: SceneSequence, read: Callable[[Path], SceneFile], most_bytes: int = 0):
        self.sequence, self._read = sequence, read
        self.first = read(sequence.files[0])
        self.notes = {0: self.first.notes}
        each = sum(field.nbytes for field in self.first.gaussians.fields().values())
        self._most = max(1 + _AHEAD, min(len(sequence.files), most_bytes // max(each, 1)))
        self._pool, self._lock = ThreadPoolExecutor(1, "scenes"), threading.Lock()
        self._held: OrderedDict[int, Future[Gaussians]] = OrderedDict()

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def at(self, number: int, following: Iterable[int] = ()) -> Gaussians:
        """Return a scene on the CPU, and have the following ones read ahead. Raises InputError."""
        with self._lock:
            found = self._request(number)
            for other in list(following)[:_AHEAD]:
                self._request(other)
            while len(self._held) > self._most:
                self._held.popitem(last=False)[1].cancel()
        return found.result()

    def _request(self, number: int) -> Future[Gaussians]:
        if number not in self._held:
            self._held[number] = self._pool.submit(self._load, number)
        self._held.move_to_end(number)
        return self._held[number]

    def _load(self, number: int) -> Gaussians:
        file = self.first if number == 0 else self._read(self.sequence.files[number])
        self.notes[number] = file.notes
        scene, origin = file.gaussians, self.first.gaussians.origin
        shift = np.subtract(scene.origin, origin)
        means = scene.means
        if shift.any():
            means = (means.double() + torch.from_numpy(shift)).to(means.dtype)
        return replace(scene, means=means, origin=origin)

    def sample(self) -> Gaussians:
        """Return scenes from the whole sequence as one: of each its share, so that what rests is there once.

        Raises:
            InputError: one of them cannot be read.
        """
        count = len(self.sequence.files)
        numbers = sorted({round(part * (count - 1)) for part in np.linspace(0, 1, min(count, _SAMPLED))})
        parts = []
        for place, number in enumerate(numbers):
            fields = self.at(number, numbers[place + 1 :]).fields()
            parts.append({name: field[place :: len(numbers)].numpy() for name, field in fields.items()})
        filled = [part for part in parts if len(part["means"])]
        return from_arrays(concatenate_fields(filled), self.first.gaussians.origin)

    def differences(self) -> list[str]:
        """Return a line on scenes whose files have other notes than the first, with an example."""
        usual = set(self.notes[0])
        other = [(number, note) for number, notes in sorted(self.notes.items()) for note in notes if note not in usual]
        if not other:
            return []
        number, note = other[0]
        scenes = counted(len({number for number, _ in other}), "scene", of=len(self.sequence.files), does="have notes")
        return [f"{scenes} that the first has not, as {self.sequence.files[number].name}: {note}"]
