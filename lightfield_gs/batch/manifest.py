"""What a batch did, line by line: a file that only grows, so that nothing that was done is ever lost or done again."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import lock, make_folder
from lightfield_gs.io.text_files import parse_json

MANIFEST = "batch.jsonl"
Record = dict[str, Any]


class Manifest:
    """The file batch.jsonl of a folder, one JSON object a line: use it in a `with`.

    A line with "item" tells how an item ended, the last one of each counts; one with "run" and no item what a run was
    asked for, or that it ended. A line is written by one call of the system, behind what is there: a process that is
    killed leaves whole lines, and what a machine that lost its power left of one is passed over. As long as the `with`
    lasts the file is locked: two batches in one folder would do everything twice. Raises InputError.
    """

    def __init__(self, folder: str | Path):
        self.folder = make_folder(folder)
        self.path = self.folder / MANIFEST
        self.damaged = 0  # lines
        self.is_unfinished = False  # whether the last run did not come to its end
        self._places: dict[str, tuple[int, int]] = {}  # of the last line of each item: its first byte, and how many

    def __enter__(self) -> Manifest:
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror or error}") from error
        try:
            _lock(self._file, self.folder)
            self._read()
        except BaseException:
            os.close(self._file)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        os.close(self._file)  # and the lock goes with it

    def last(self, name: str) -> Record | None:
        """The last line of an item; None where there is none."""
        if name not in self._places:
            return None
        start, length = self._places[name]
        return parse_json(os.pread(self._file, length, start).decode())

    def append(self, record: Record) -> None:
        """Writes a line. Raises InputError where it does not get there as a whole."""
        line = (json.dumps(record) + "\n").encode()
        try:
            written = os.write(self._file, line)
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror or error}") from error
        if written != len(line):
            raise InputError(f"cannot write {self.path}: the disk is full")

    def _read(self) -> None:
        line = b"\n"
        for start, line in self._lines():
            try:
                record = parse_json(line.decode())
            except ValueError:
                record = None
            if _tells_of_item(record):
                self._places[record["item"]] = start, len(line)
            elif isinstance(record, dict) and "run" in record and "item" not in record:
                self.is_unfinished = "ended" not in record
            else:
                self.damaged += 1
        if not line.endswith(b"\n"):
            os.write(self._file, b"\n")

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        """Each line with the place of its first byte."""
        place = 0
        with open(self._file, "rb", closefd=False) as file:
            for line in file:
                yield place, line
                place += len(line)


def _tells_of_item(record: Any) -> bool:
    """Whether a line has what the next run goes by."""
    if not isinstance(record, dict) or not all(isinstance(record.get(key), str) for key in ("item", "status", "job")):
        return False
    if record["status"] != "done":
        return True
    facts = [record.get(key) for key in ("inputs", "outputs")]
    held = [fact for part in facts if isinstance(part, dict) for fact in part.values()]
    return all(isinstance(part, dict) for part in facts) and all(
        isinstance(fact, dict) and isinstance(fact.get("stamp"), list) and isinstance(fact.get("sha256"), str)
        for fact in held
    )


def _lock(file: int, folder: Path) -> None:
    """Locks the manifest as long as it is open in this process, however that ends. Raises InputError where another
    process has it."""
    is_ours = lock(file)
    if is_ours is None:
        raise InputError("batch keeps a folder to itself by the locks of Linux and macOS, which are not here")
    if not is_ours:
        raise InputError(f"another batch is at work in {folder}: wait for it, or give another folder")
