"""The fits of `bench fit`, one after the other: a row for each at every mark, kept in a file as soon as it is known."""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks import fit_report
from benchmarks.fit_arms import ARMS
from benchmarks.fit_photographs import Photographs, hold_out
from benchmarks.fit_scores import Lpips, scores
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.timing import machine
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.captures.capture import Capture, read_capture
from lightfield_gs.io.text_files import read_object, write_json

MARKS = (1000, 2000, 4000, 7000, 15_000, 30_000)  # steps after which a fit is scored, and after the last
WARM_UP_STEPS = 20  # of a fit that is thrown away: kernels load, libraries start
_MOST_BYTES = 1 << 28  # of a file of rows


@dataclass(frozen=True)
class Source:
    """A capture to fit to.

    Attributes:
        name: of the capture in rows.
        folder: of the capture.
        images: the folder of the photographs below; None: the capture's own.
        every: one of so many photographs is held out.
        from_first: whether that is the first one, and not the middle one.
    """

    name: str
    folder: Path
    images: str | None = None
    every: int = 8
    from_first: bool = False

    def read(self, longest_px: int | None) -> tuple[Capture, list[int]]:
        """Return the capture, and the numbers of its held-out photographs. Raises InputError."""
        capture = read_capture(self.folder, images=self.images, longest_px=longest_px)
        if self.from_first:
            return capture, list(range(0, len(capture.names), self.every))
        return capture, hold_out(capture, self.every)


def marks(steps: int) -> list[int]:
    """The steps after which a fit of so many is scored."""
    return sorted({*(mark for mark in MARKS if mark < steps), steps})


def rows(
    photographs: Photographs, arm: str, settings: FitSettings, lpips: Lpips | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of one fit. Times are of its steps alone, from device to device. Raises InputError."""
    device = photographs.train.device
    begin = partial(ARMS[arm], photographs, settings)
    if device.type == "cuda":
        begin().advance(min(WARM_UP_STEPS, settings.steps))
    _clear(device)
    held = torch.cuda.memory_allocated() if device.type == "cuda" else 0
    fit, seconds, done, peak = begin(), 0.0, 0, 0
    for mark in marks(settings.steps):
        taken, most = _timed(partial(fit.advance, mark), device)
        seconds, peak = seconds + taken, max(peak, most - held)
        yield {
            "capture": photographs.name,
            "arm": arm,
            "seed": settings.seed,
            "steps": settings.steps,
            "step": mark,
            **scores(fit, photographs, lpips),
            "gaussians": fit.gaussians().count,
            "seconds": seconds,
            "ms_step": 1e3 * seconds / mark,
            "ms_step_lately": 1e3 * taken / (mark - done),
            "peak_bytes": peak if device.type == "cuda" else None,
        }
        done = mark
    del fit
    _clear(device)


def _clear(device: torch.device) -> None:
    """Free the memory of earlier fits."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.empty_cache()


def _timed(call: Callable[[], None], device: torch.device) -> tuple[float, int]:
    """Seconds that a call takes until the device is done, and the most memory of it that is held meanwhile."""
    if device.type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    began = time.perf_counter()
    call()
    if device.type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - began, torch.cuda.max_memory_allocated() if device.type == "cuda" else 0


class Runs:
    """Fits of arms and seeds to captures, and their results.

    Attributes:
        result: protocol, machine, captures (a description of each), rows and summary.
    """

    def __init__(self, protocol: dict[str, Any], device: str, path: Path | None, resume: bool) -> None:
        """Begin, or go on where the rows of a file end.

        Args:
            protocol: all that rows of one file have in common.
            device: of the fits.
            path: file for the result after every row; None: none.
            resume: keep the fits in `path` that are finished.

        Raises:
            InputError: the rows in `path` are of another protocol or machine.
        """
        self._device, self._path = device, path
        self.result: dict[str, Any] = {"protocol": protocol, "machine": machine(device), "captures": [], "rows": []}
        if resume and path is not None and path.exists():
            self._resume(path)

    def _resume(self, path: Path) -> None:
        stored = read_object(path, _MOST_BYTES)
        part = "gpu" if self._device == "cuda" else "processor"
        for what, was, now in (
            ("protocol", stored.get("protocol"), json.loads(json.dumps(self.result["protocol"]))),
            ("machine", stored.get("machine", {}).get(part), self.result["machine"][part]),
        ):
            if was != now:
                raise InputError(
                    f"{path}: expected rows of this {what}, got others ({_difference(was, now)}); give another json=, "
                    "or leave resume= out to write the file anew"
                )
        ends = {_fit(row) for row in stored["rows"] if row["step"] == row["steps"]}
        self.result["captures"] = stored["captures"]
        self.result["rows"] = [row for row in stored["rows"] if _fit(row) in ends]
        options.progress(f"{path}: {counted(len(ends), 'fit')} finished earlier, not run again")

    def run(self, source: Source, longest_px: int | None, fits: Sequence[tuple[str, FitSettings]], lpips: Lpips | None):
        """Run the fits to a capture that are not finished yet.

        Args:
            source: the capture.
            longest_px: photographs are reduced to it; None: not.
            fits: arm and settings of each.
            lpips: see scores.

        Raises:
            InputError: the capture cannot be read, or has changed since its first fits.
        """
        done = {_fit(row) for row in self.result["rows"]}
        wanted = [(arm, settings) for arm, settings in fits if (source.name, arm, settings.seed) not in done]
        if not wanted:
            return
        capture, held_out = source.read(longest_px)
        options.progress(f"{source.folder}: reading {len(capture.names)} photographs")
        cone_deg = self.result["protocol"]["cone_deg"]
        differ = False if source.from_first else None  # published scores have colours as they are
        photographs = Photographs.load(capture, held_out, self._device, cone_deg, source.name, differ)
        self._describe(describe(photographs, source.folder))
        for arm, settings in wanted:
            for row in rows(photographs, arm, settings, lpips):
                options.progress(fit_report.line(row))
                self.result["rows"].append(row)
                self.result["summary"] = fit_report.summary(self.result["rows"])
                if self._path is not None:
                    write_json(self.result, self._path)

    def _describe(self, description: dict[str, Any]) -> None:
        """Keep the description of a capture; refuse one that differs from that of rows from earlier."""
        for known in self.result["captures"]:
            if known["capture"] == description["capture"]:
                if known != description:
                    raise InputError(
                        f"{description['folder']}: expected the capture of the earlier rows, got another "
                        f"({_difference(known, description)}); give another json="
                    )
                return
        self.result["captures"].append(description)


def _fit(row: dict[str, Any]) -> tuple[str, str, int]:
    """Return capture, arm and seed, which name a fit."""
    return row["capture"], row["arm"], row["seed"]


def _difference(was: Any, now: Any) -> str:
    if not isinstance(was, dict) or not isinstance(now, dict):
        return f"{was}, now {now}"
    changed = [key for key in sorted({*was, *now}) if was.get(key) != now.get(key)]
    return ", ".join(f"{key}: {was.get(key)}, now {now.get(key)}" for key in changed)


def describe(photographs: Photographs, folder: Path) -> dict[str, Any]:
    """Return the description of a capture."""
    train, test, cone = photographs.train, photographs.test, photographs.cone
    return {
        "capture": photographs.name,
        "folder": str(folder),
        "photographs": train.count,
        "held_out": test.names,
        "centre": None if cone is None else cone.name,
        "in_cone": [name for name, is_inside in zip(test.names, photographs.inside) if is_inside],
        "width_px": train.width_px,
        "height_px": train.height_px,
        "exposures_differ": photographs.exposures_differ,
        "masked": train.weights is not None or test.weights is not None,
        "points": len(photographs.points),
    }


def each_fit(arms: Sequence[str], seeds: int, settings: FitSettings) -> list[tuple[str, FitSettings]]:
    """Return arm and settings of every fit to a capture, seed by seed."""
    return [(arm, replace(settings, seed=seed)) for seed in range(seeds) for arm in arms]
