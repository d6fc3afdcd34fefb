"""The manifest of a batch: one line for each item that ended, and from it the items that are still to be done."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from stat import S_ISDIR
from typing import Any

from lightfield_gs.base import system
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.batch.items import Item
from lightfield_gs.io.atomic import make_folder, sha256
from lightfield_gs.io.text_files import parse_json

WHOLE = (1, 1)  # the shard that is the whole batch
Record = dict[str, Any]
_WHOLE_NAME, _SHARD_NAMES = "batch.jsonl", "batch-*-of-*.jsonl"
_PATIENCE_S = 2.0  # for the processes of a batch that was killed, which end after it
_MOST_TRIES = 2  # runs that an item may take with it


def stamp(path: str | Path) -> list[int]:
    """Return the size of a file in bytes and its time of change in ns.

    Of a folder, return the sum, the latest time, and the number of files. A file with the same stamp counts as
    unchanged.

    Raises:
        InputError: there is no such file.
    """
    with reading(path):
        own = os.stat(path)
        if not S_ISDIR(own.st_mode):
            return [own.st_size, own.st_mtime_ns]
        found = [file.stat() for file in _files(path)]
    return [sum(file.st_size for file in found), max((file.st_mtime_ns for file in found), default=0), len(found)]


def facts(path: str | Path) -> dict[str, Any]:
    """Return the stamp and the SHA-256 of a file; the hash of a folder covers the names and contents of its files."""
    found = stamp(path)  # before the file is read: a change meanwhile shows the next time
    return {"stamp": found, "sha256": _digest(os.path.abspath(path), tuple(found))}


@lru_cache(maxsize=64)  # a rig or a checkpoint is an input of every item
def _digest(path: str, version: tuple[int, ...]) -> str:
    with reading(path):
        if not os.path.isdir(path):
            return sha256(path)
        lines = [f"{sha256(file)} {file.relative_to(path).as_posix()}\n" for file in _files(path)]
    return hashlib.sha256("".join(lines).encode("utf-8", "surrogateescape")).hexdigest()


def _files(folder: str | Path) -> list[Path]:
    return sorted(file for file in Path(folder).rglob("*") if file.is_file())


class Manifest:
    """The manifests of a folder, JSON lines, for use in a `with`.

    `append` writes to the shard's manifest, `last` reads all manifests.

    A line with "item" says how an item ended; the last line of an item counts. Other lines tell the options of a run,
    or its end. One system call appends a line, so a killed process leaves whole lines; `last` skips a line that a power
    failure cut. Locks keep two runs of the same items from working at the same time: a shard keeps the one of its own
    manifest, a whole batch those of all manifests, and both take the one of batch.jsonl first.

    Attributes:
        path: the manifest of the shard: batch.jsonl, or batch-I-of-N.jsonl.
        damaged: number of lines that could not be read.
        is_unfinished: whether the last run of any manifest did not reach its end.
    """

    def __init__(self, folder: str | Path, shard: tuple[int, int] = WHOLE) -> None:
        self.folder = make_folder(folder)
        self.path = self.folder / (_WHOLE_NAME if shard == WHOLE else "batch-{}-of-{}.jsonl".format(*shard))
        self.damaged = 0
        self.is_unfinished = False
        self._lines: dict[str, tuple[str, Path, int, int]] = {}  # time, file, first byte and length of last lines

    def __enter__(self) -> Manifest:
        with ExitStack() as opened:
            try:
                deadline = time.monotonic() + _PATIENCE_S
                while not self._lock(opened, time.monotonic() >= deadline):
                    time.sleep(0.05)
                for path in sorted({self.path, *self.folder.glob("batch*.jsonl")}):
                    self._read(path)
            except OSError as error:
                raise InputError(f"cannot write {self.path}: {error.strerror or error}") from error
            self._opened = opened.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    def last(self, name: str) -> Record | None:
        """Return the last line of an item; None if there is none."""
        if name not in self._lines:
            return None
        _, path, start, length = self._lines[name]
        with path.open("rb") as file:
            file.seek(start)
            return parse_json(file.read(length).decode())

    def append(self, record: Record) -> None:
        """Write a line. Raises InputError if the disk is full."""
        line = (json.dumps(record) + "\n").encode()
        try:
            written = os.write(self._file, line)
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror or error}") from error
        if written != len(line):
            raise InputError(f"cannot write {self.path}: the disk is full")

    def _lock(self, opened: ExitStack, is_last: bool) -> bool:
        """Open and lock the manifests of all runs that would do the same items; closing them unlocks them.

        Returns:
            Whether no other run has one of them; at the last try that is an error.
        """
        is_whole = self.path.name == _WHOLE_NAME
        with ExitStack() as kept, ExitStack() as passing:  # the latter: that no whole batch begins meanwhile
            try:
                whole = self._open(kept if is_whole else passing, self.folder / _WHOLE_NAME)
                others = sorted(self.folder.glob(_SHARD_NAMES)) if is_whole else [self.path]
                self._file = [whole, *(self._open(kept, path) for path in others)][0 if is_whole else 1]
            except BlockingIOError:
                if is_last:
                    busy = f"another batch is at work in {self.folder}: wait for it, or give another folder"
                    raise InputError(busy) from None
                return False
            opened.push(kept.pop_all())
        return True

    def _open(self, opened: ExitStack, path: Path) -> int:
        """Open a manifest and lock it; raise BlockingIOError where another run has it."""
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | system.BYTES, 0o666)
        opened.callback(os.close, file)
        is_ours = system.lock(file)
        if is_ours is None:
            raise InputError(f"{self.folder}: expected a disk whose files can be locked; give a folder on another")
        if not is_ours:
            raise BlockingIOError
        return file

    def _read(self, path: Path) -> None:
        is_unfinished, start, line = False, 0, b"\n"
        with path.open("rb") as file:
            for line in file:
                try:
                    record = parse_json(line.decode())
                except ValueError:
                    record = None
                if _is_item(record):
                    name, at = record["item"], str(record.get("at", ""))
                    if name not in self._lines or self._lines[name][0] <= at or self._lines[name][1] == path:
                        self._lines[name] = at, path, start, len(line)
                elif isinstance(record, dict) and "run" in record and "item" not in record:
                    is_unfinished = "ended" not in record
                else:
                    self.damaged += 1
                start += len(line)
        self.is_unfinished |= is_unfinished
        if not line.endswith(b"\n") and path == self.path:
            os.write(self._file, b"\n")


def _is_item(record: Any) -> bool:
    """Return whether a line has the fields that the next run needs."""
    if not isinstance(record, dict) or not all(isinstance(record.get(key), str) for key in ("item", "status", "job")):
        return False
    parts = [record.get(key) for key in ("inputs", "outputs")] if record["status"] == "done" else []
    return all(isinstance(part, dict) and all(map(_is_facts, part.values())) for part in parts)


def _is_facts(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("stamp"), list) and isinstance(value.get("sha256"), str)


@dataclass(frozen=True)
class Known:
    """The manifest's knowledge of an unfinished item.

    Attributes:
        inputs, outputs: the facts of its files, if the outputs are there and only the inputs may have changed.
        is_other: whether the outputs belong to other options or inputs.
    """

    inputs: Record = field(default_factory=dict)
    outputs: Record = field(default_factory=dict)
    is_other: bool = False


@dataclass
class Plan:
    """The work of a run.

    Attributes:
        todo: unfinished items in order, with the manifest's knowledge; the first `suspects` items ended a run before.
        failed: items that ended too many runs.
        failures: reasons of the items that failed at the time `since` or later, and are not tried again.
        jobs: hash of the options of each item.
        tries: number of runs that ended while an item was on its way, for the items with such runs.
        kept: number of items that are done.
    """

    todo: list[tuple[Item, Known | None]] = field(default_factory=list)
    failed: list[Item] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    jobs: dict[str, str] = field(default_factory=dict)
    tries: dict[str, int] = field(default_factory=dict)
    suspects: int = 0
    kept: int = 0


def make_plan(
    items: Iterable[Item],
    manifest: Manifest,
    options: dict[str, Any],
    *,
    overwrite: bool = False,
    check: bool = False,
    since: str = "9",
) -> Plan:
    """Choose the items to do.

    Args:
        items: all items.
        manifest: of their folder.
        options: JSON values of options: by "all" for all items, by a command's name for the items of this command.
        overwrite: whether to repeat all items that ended before the time `since`.
        check: whether to read all files of items that are done; otherwise sizes and times of change decide.
        since: the beginning of this batch, a time as the manifest writes it; by default in the far future.
    """
    plan, suspects = Plan(), []
    for item in items:
        job = plan.jobs[item.name] = _job(item, options)
        last = manifest.last(item.name)
        is_new = last is not None and str(last.get("at", "")) >= since
        if last is not None and is_new and last["status"] == "failed":
            plan.failures.append(f"{item.input}: {last.get('reason')}")
            continue
        if last is None or overwrite and not is_new:
            known = Known(is_other=True) if overwrite else None
        elif last["status"] != "done" or last["job"] != job:
            known = Known(is_other=last["job"] != job)
        elif not all(_is_there(manifest.folder / name, held, False, check) for name, held in last["outputs"].items()):
            known = Known()
        elif check or not all(_is_there(path, held) for path, held in last["inputs"].items()):
            known = Known(last["inputs"], last["outputs"])
        else:
            plan.kept += 1
            continue
        if last is None or last["status"] != "begun":
            plan.todo.append((item, known))
        elif plan.tries.setdefault(item.name, int(last.get("tries", 1))) >= _MOST_TRIES:
            plan.failed.append(item)
        else:
            suspects.append((item, known))
    plan.suspects = len(suspects)
    plan.todo = suspects + plan.todo
    return plan


def _job(item: Item, options: dict[str, Any]) -> str:
    """Return the SHA-256 of all that decides the output beside the inputs."""
    name = Path(item.input).name  # the folder does not matter
    words = [name, item.command, item.words, item.fit_words, options["all"], options.get(item.command)]
    return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()


def _is_there(path: str | Path, held: Record, has_time: bool = True, check: bool = False) -> bool:
    """Return whether a file is there with the size, the time (`has_time`) and the contents (`check`) of its record."""
    try:
        found, before = stamp(path), held["stamp"]
        if not has_time:
            found, before = (part[:1] + part[2:] for part in (found, before))
        return found == before and (not check or facts(path)["sha256"] == held["sha256"])
    except InputError:
        return False
