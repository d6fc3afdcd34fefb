"""The photographs of a fit in the host's memory or in files, where they are too many for its device.

Threads read the photographs of the next steps while the steps before them run. On a GPU a stream of their own copies
them at the same time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from copy import copy
from math import prod
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError, reading

AHEAD = 8  # photographs that are read ahead, at least one step
_READERS = 4  # threads: a disk is at its fastest with several requests
_WHITE = 255  # of rows that are in no file


class RowFile:
    """Rows of bytes in a file, C of one shape: photographs, or their masks. A row that was never set is white.

    The file is open only while a row is read or written, so that it can be removed at any time.
    """

    device = torch.device("cpu")

    def __init__(self, path: Path, shape: Sequence[int]):
        self.path, self.shape = path, tuple(shape)
        self._places: list[int | None] = [None] * self.shape[0]  # of the rows, in the order in which they were set
        self._filled = 0
        with _writing(path):
            path.write_bytes(b"")

    @property
    def row_bytes(self) -> int:
        return prod(self.shape[1:])

    def __setitem__(self, row: int, values: Tensor) -> None:
        """Write a row, once; raise InputError where the disk is full."""
        with _writing(self.path), self.path.open("ab") as file:
            file.write(values.contiguous().numpy().data.cast("B"))
        self._places[row] = self._filled
        self._filled += 1

    def __getitem__(self, row: int) -> Tensor:
        """Return a row, uint8; raise InputError where it cannot be read."""
        return self.index_select(0, torch.tensor([row]))[0]

    def index_select(self, dim: int, rows: Tensor, *, out: Tensor | None = None) -> Tensor:
        """Return rows, as Tensor.index_select does for a `dim` of 0. Raises InputError."""
        assert dim == 0
        out = torch.empty((len(rows), *self.shape[1:]), dtype=torch.uint8) if out is None else out
        for target, row in zip(out, rows.tolist(), strict=True):
            place = self._places[row]
            if place is None:
                target.fill_(_WHITE)
            else:
                self._read(place, target)
        return out

    def _read(self, place: int, target: Tensor) -> None:
        with reading(self.path), self.path.open("rb") as file:
            file.seek(place * self.row_bytes)
            if file.readinto(target.numpy().data.cast("B")) != self.row_bytes:
                raise InputError(f"{self.path} was cut off during the fit: start it again")

    def select(self, rows: Sequence[int]) -> RowFile:
        """Return some of the rows, of the same file."""
        some = copy(self)
        some.shape, some._places = (len(rows), *self.shape[1:]), [self._places[row] for row in rows]
        return some


StoredRows = Tensor | RowFile  # [C, ...] uint8


def white_rows(shape: Sequence[int], where: torch.device | str | Path, name: str) -> StoredRows:
    """Return C white rows to be set.

    Args:
        shape: [C, ...].
        where: a device, or the folder of the file.
        name: of the file.
    """
    if isinstance(where, Path):
        return RowFile(where / f"{name}.uint8", shape)
    return torch.full(tuple(shape), _WHITE, dtype=torch.uint8, device=where)


def select_rows(stored: StoredRows, rows: Sequence[int]) -> StoredRows:
    """Return some of the rows, where all of them are."""
    return stored.select(rows) if isinstance(stored, RowFile) else stored[list(rows)]


class ReadAhead:
    """Reads rows for steps to come, by threads.

    Args:
        stored: rows by name, in files or in the host's memory.
        pinned: whether the rows are read to memory that a GPU can copy from at any time.
    """

    def __init__(self, stored: Mapping[str, StoredRows], pinned: bool):
        self._stored, self._pinned = stored, pinned
        self._pool = ThreadPoolExecutor(_READERS, "photographs")
        self._reading: dict[tuple[int, ...], Future[dict[str, Tensor]]] = {}

    def take(self, steps: Tensor) -> dict[str, Tensor]:
        """Return the rows steps[0], and have the next of `steps` [S,V] read ahead. Raises InputError."""
        ahead = 1 + max(1, AHEAD // steps.shape[1])
        wanted = [tuple(rows) for rows in steps[:ahead].tolist()]
        first = self._reading.pop(wanted[0], None) or self._submit(wanted[0])
        self._reading = {rows: self._reading.get(rows) or self._submit(rows) for rows in wanted[1:]}
        return first.result()

    def _submit(self, rows: tuple[int, ...]) -> Future[dict[str, Tensor]]:
        # Allocated here: a thread that calls CUDA would break a capture of a graph
        buffers = {
            name: torch.empty((len(rows), *stored.shape[1:]), dtype=torch.uint8, pin_memory=self._pinned)
            for name, stored in self._stored.items()
        }
        return self._pool.submit(self._read, torch.tensor(rows), buffers)

    def _read(self, rows: Tensor, buffers: dict[str, Tensor]) -> dict[str, Tensor]:
        for name, out in buffers.items():
            stored = self._stored[name]
            if isinstance(stored, RowFile):
                stored.index_select(0, rows, out=out)
            else:
                torch.index_select(stored, 0, rows, out=out)
        return buffers


class _Slot(NamedTuple):
    """A copy of the rows of one step on a GPU, and the event after which it has been read."""

    rows: dict[str, Tensor]
    is_read: torch.cuda.Event


class DeviceRows:
    """The rows of the present step on a GPU, always at the same addresses, for a CUDA graph.

    A stream of their own copies the rows of the next step while the GPU works on the present one. The host waits until
    the step before that has begun, so that few steps are on their way.

    Attributes:
        rows: of the present step, by name.

    Args:
        like: rows on the host, for names and shapes.
        device: the GPU.
    """

    def __init__(self, like: Mapping[str, Tensor], device: torch.device):
        def empty() -> dict[str, Tensor]:
            return {name: torch.empty_like(rows, device=device) for name, rows in like.items()}

        self.rows = empty()
        self._slots = [_Slot(empty(), torch.cuda.Event()) for _ in range(2)]
        self._stream, self._turn = torch.cuda.Stream(device), 0
        self._stream.wait_stream(torch.cuda.current_stream(device))  # whose memory may have been another tensor's

    def copy(self, found: Mapping[str, Tensor]) -> None:
        """Copy rows from pinned memory; work that is queued on the current stream from now on finds them."""
        slot = self._slots[self._turn % len(self._slots)]
        self._turn += 1
        slot.is_read.synchronize()
        current = torch.cuda.current_stream(self._stream.device)
        with torch.cuda.stream(self._stream):
            for name, rows in found.items():
                slot.rows[name].copy_(rows, non_blocking=True)
        current.wait_stream(self._stream)
        for name, rows in self.rows.items():
            rows.copy_(slot.rows[name])
        slot.is_read.record(current)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise InputError for errors of a file that is written inside the block."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
