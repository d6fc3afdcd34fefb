"""Which items are to be done, by what the manifest says of them and what lies in the folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.hashes import facts, stamp
from lightfield_gs.batch.item import Item
from lightfield_gs.batch.manifest import Manifest, Record


@dataclass(frozen=True)
class Known:
    """What the manifest says of an item that is to be done again.

    inputs, outputs: as records have them, where the outputs are there, and only what the inputs hold is to be seen.
    is_other: whether what is there is of other options or inputs.
    """

    inputs: Record = field(default_factory=dict)
    outputs: Record = field(default_factory=dict)
    is_other: bool = False


@dataclass
class Plan:
    """todo: items in order, with what is known of them; jobs: the hash of what each is made by; kept: how many were
    done before and are left alone."""

    todo: list[tuple[Item, Known | None]] = field(default_factory=list)
    jobs: dict[str, str] = field(default_factory=dict)
    kept: int = 0


def make_plan(
    items: Iterable[Item], manifest: Manifest, options: dict[str, Any], *, overwrite: bool = False, check: bool = False
) -> Plan:
    """What is to be done of these items.

    options: JSON values, those of all items by "all", and those of one command by its name. overwrite: nothing is left
    alone. check: what was done is left alone only if all of it is read and found to be what it was; otherwise sizes and
    times of change decide.
    """
    plan = Plan()
    for item in items:
        job = plan.jobs[item.name] = _job(item, options)
        last = manifest.last(item.name)
        if last is None or overwrite:
            plan.todo.append((item, None if last is None and not overwrite else Known(is_other=True)))
        elif last["status"] != "done" or last["job"] != job or not _are_there(last["outputs"], manifest.folder, check):
            plan.todo.append((item, Known(is_other=last["job"] != job)))
        elif check or not _seem_unchanged(last["inputs"]):
            plan.todo.append((item, Known(last["inputs"], last["outputs"])))
        else:
            plan.kept += 1
    return plan


def _job(item: Item, options: dict[str, Any]) -> str:
    """SHA-256 of what decides, beside the inputs, what comes out."""
    name = Path(item.input).name  # which images tell; where it is does not matter
    words = [name, item.command, item.words, item.fit_words, options["all"], options.get(item.command)]
    return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()


def _are_there(outputs: Record, folder: Path, check: bool) -> bool:
    """Whether files are there with the sizes that they had; check: and hold what they held."""
    try:
        for name, held in outputs.items():
            sizes = [part for number, part in enumerate(stamp(folder / name)) if number != 1]  # not the time
            if sizes != [part for number, part in enumerate(held["stamp"]) if number != 1]:
                return False
            if check and facts(folder / name)["sha256"] != held["sha256"]:
                return False
    except InputError:
        return False
    return True


def _seem_unchanged(inputs: Record) -> bool:
    try:
        return all(stamp(path) == held["stamp"] for path, held in inputs.items())
    except InputError:
        return False
