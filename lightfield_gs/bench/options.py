"""The options that several benchmarks take, and their help."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from lightfield_gs.base.cli_messages import as_options
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.bench.names import (
    BENCH_METHODS,
    LIGHT_FIELD_METHODS,
    LIGHT_FIELD_SCENES,
    NAMED_CONES,
    ORACLE_SAMPLES,
)
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.parser import byte_size

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """The options of all benchmarks.

    Attributes:
        device: device of the benchmark.
        threads: number of threads, of some benchmarks several with commas. None: all cores.
        repeats: runs of each call. None: see `timed`.
        json: file for the rows.
    """

    device: Literal["cpu", "cuda"] = "cpu"
    threads: str | None = None
    repeats: int | None = None
    json: Path | None = None

    @property
    def thread_count(self) -> int | None:
        """The number of threads, of a benchmark that takes one. Raises InputError for several."""
        counts = thread_counts(self.threads)
        if len(counts) > 1:
            raise InputError(f"threads=: expected one number, got {self.threads}")
        return counts[0]


@dataclass(frozen=True, kw_only=True)
class PanelOptions(BenchmarkOptions):
    """The options of benchmarks that draw for a panel.

    Attributes:
        panel: name of the panel or its file.
        device_serial: the display, where the file has several.
    """

    panel: str = DEFAULT_PANEL
    device_serial: str | None = None

    def load_panel(self) -> Panel:
        """Read the panel. Raises InputError."""
        from lightfield_gs.panels.panel import Panel

        return Panel.load(self.panel, serial=self.device_serial)


@dataclass(frozen=True, kw_only=True)
class SceneOptions(PanelOptions):
    """The options of benchmarks that draw scenes; each is a text with commas.

    Attributes:
        scene: names or files of scenes.
        cone: viewing cones. None: the panel's.
        sh_degree: degrees of synthetic scenes.
    """

    scene: str | None = None
    cone: str | None = None
    sh_degree: str | None = None


def add_machine(parser: argparse.ArgumentParser, several_threads: bool = False) -> None:
    """Add the options of the machine and of the file of rows."""
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", short="cpu or cuda", help="default: %(default)s"
    )
    more = "; several with commas" if several_threads else ""
    parser.add_argument("--threads", help=f"threads (default: all cores){more}")
    parser.add_argument(
        "--json",
        type=Path,
        short="also write the figures to this file",
        help="file for the rows and a description of the machine",
    )


def add_repeats(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--repeats",
        type=int,
        help="number of runs of each row, fewer beyond a minute (default: 5, or 20 for less than 50 ms on CUDA)",
    )


def add_panel(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--panel",
        default=DEFAULT_PANEL,
        short="the panel, by its name or file",
        help="name, YAML or visual.json (default: %(default)s); bench-8k-96v and bench-4k-71v are the panels of "
        "published figures",
    )
    add_device_serial(parser.add_argument)


def add_scene(parser: argparse.ArgumentParser, usual: Sequence[str]) -> None:
    parser.add_argument(
        "--scene",
        short="sheet:S, cloud:N or a .ply, several with commas",
        help=f"sheet:S, cloud:N or a .ply; several with commas (default: {', '.join(usual)})",
    )


def check_scenes(scenes: Sequence[str], sh_degrees: Sequence[int | None] = (None,)) -> None:
    """Raise InputError before the first measurement, so that no measurements are lost."""
    from lightfield_gs.bench.scenes import check_scene

    for scene in scenes:
        for degree in sh_degrees:
            check_scene(scene, degree)


def add_cone(parser: argparse.ArgumentParser, usual: str = "the panel's") -> None:
    parser.add_argument(
        "--cone",
        help="viewing cone in degrees, or narrow (40 px of disparity over all views) or wide "
        f"(53 degrees); several with commas (default: {usual})",
    )


def cones(text: str | None) -> list[str | float | None]:
    """Return the cones as `cone_degrees` takes them; [None] without the option."""
    if text is None:
        return [None]
    return [part if part in NAMED_CONES else _cone(part) for part in text.split(",")]


def _cone(text: str) -> float:
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if not 0 < degrees < 180:
        raise InputError(f"cone=: expected degrees between 0 and 180, or {' or '.join(NAMED_CONES)}, got {text!r}")
    return degrees


def add_sh_degree(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sh-degree", help="degree 0..3 of synthetic scenes, several with commas (default: 0)")


def sh_degrees(text: str | None) -> list[int | None]:
    """Return the degrees of "0,3"; [None] without the option."""
    if text is None:
        return [None]
    if not all(part in ("0", "1", "2", "3") for part in text.split(",")):
        raise InputError(f"sh_degree=: expected degrees 0..3 with commas between, got {text!r}")
    return [int(part) for part in text.split(",")]


def add_photo(parser: argparse.ArgumentParser, usual: Path) -> None:
    parser.add_argument("--photo", help=f"files, several with commas (default: the photo in the package, {usual.name})")


def check_photos(photos: Sequence[str]) -> None:
    """Raise InputError before the first measurement, so that no measurements are lost."""
    from lightfield_gs.photo.load import load_photo

    for path in photos:
        with named("photo="):
            load_photo(path)


def add_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--plot", type=Path, help="a picture of the rows, .png, .svg, .pdf or .webp")


def thread_counts(text: str | None) -> list[int | None]:
    """Return the numbers of "1,2"; [None] without the option."""
    if text is None:
        return [None]
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        counts = []
    if not counts or min(counts) < 1:
        raise InputError(f"threads=: expected positive numbers with commas between, got {text!r}")
    return [*counts]


def progress(line: str) -> None:
    """Print the progress of the benchmark."""
    print(f"bench: {as_options(line)}", file=sys.stderr, flush=True)


def add_light_field(
    parser: argparse.ArgumentParser,
    scenes: Sequence[str] = LIGHT_FIELD_SCENES,
    methods: Sequence[str] = LIGHT_FIELD_METHODS,
) -> None:
    """Add the options of a light-field image; scenes, methods: the defaults."""
    add_scene(parser, scenes)
    add_panel(parser)
    add_cone(parser)
    add_sh_degree(parser)
    parser.add_argument(
        "--methods",
        help=f"with commas, of {', '.join(BENCH_METHODS)} (the last one on CUDA, when "
        f"gsplat is installed; default: {','.join(methods)})",
    )
    parser.add_argument(
        "--memory-budget",
        type=byte_size,
        metavar="SIZE",
        help="work memory of the method sorted, for example 256MB, as in `encode`",
    )
    parser.add_argument(
        "--oracle-samples",
        type=int,
        metavar="N",
        help=f"number of random sub-pixels that the oracle checks (default: {ORACLE_SAMPLES}). Near 80 dB one in "
        "1,500 is off by 1/255, so the default has an uncertainty of 1 dB",
    )
    add_repeats(parser)
    add_machine(parser)
