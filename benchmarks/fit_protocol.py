"""The protocol of `bench fit` in halves: captures by which defaults are chosen, and captures that are reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.fit_runs import Source
from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.bench import options
from lightfield_gs.io.text_files import read_mapping

HALVES = ("choose", "report")


@dataclass(frozen=True)
class Half:
    """One half of a protocol.

    Attributes:
        sources: its captures that were found.
        missing: names of those that were not.
        gaussians, seeds: of its fits.
    """

    sources: list[Source]
    missing: list[str]
    gaussians: int
    seeds: int


def read_half(path: Path, half: str, data: Sequence[Path], every: int) -> Half:
    """Read one half of a protocol, and find its captures.

    Args:
        path: YAML with choose and report, two lists of names of folders, and gaussians and seeds.
        half: one of HALVES.
        data: folders that hold captures; the first that has a capture gives it.
        every: one of so many photographs is held out.

    Raises:
        InputError: the file is no such protocol, a capture is in both halves, or none of the half is there.
    """
    read = read_mapping(path, (*HALVES, "gaussians", "seeds"), ())
    lists = {name: _names(path, name, read[name]) for name in HALVES}
    if both := sorted(set(lists["choose"]) & set(lists["report"])):
        raise InputError(
            f"{path}: expected each capture in one half, got {both[0]} in both: what chooses reports nothing"
        )
    with named(path):
        gaussians, seeds = (whole_number(name, read[name], 1, 100_000_000) for name in ("gaussians", "seeds"))
    found = {name: next((at / name for at in data if (at / name).is_dir()), None) for name in lists[half]}
    sources = [Source(name, folder, every=every) for name, folder in found.items() if folder is not None]
    missing = [name for name, folder in found.items() if folder is None]
    where = ", ".join(map(str, data))
    if not sources:
        raise InputError(f"data=: expected folders of {', '.join(missing)}, the half {half} of {path}, got {where}")
    if missing:
        options.progress(
            f"{half}: {len(sources)} of {len(found)} captures are in {where}; missing: {', '.join(missing)}"
        )
    return Half(sources, missing, gaussians, seeds)


def _names(path: Path, half: str, names: object) -> list[str]:
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise InputError(f"{path}: {half}: expected a list of names of captures, got {names!r}")
    return names
