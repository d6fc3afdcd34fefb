"""Measure run time against error: the named qualities, every knob of Quality by itself, and pruned scenes.

All settings run by turns, the exact one first in every round, so that other load on the machine affects them alike.
Times are the shortest of the rounds. Errors compare the 8-bit image with the float64 oracle.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightfield_gs.base.options import QUALITY_NAMES
from lightfield_gs.bench import options
from lightfield_gs.bench.photo import EXAMPLE, network
from lightfield_gs.bench.report import aligned, check_plot, in_ms, new_figure, or_dash
from lightfield_gs.bench.scenes import benchmark_rig, cone_degrees, load_scene, oracle_samples
from lightfield_gs.bench.timing import timed_in_turn
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, frame_photo
from lightfield_gs.photo.load import load_photo
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.simplification.pruning import prune

SCENES, CONES = ("sheet:128", "sheet:512", "cloud:262144"), (5.0, 40.0)
KNOBS = ("opacity_cut", "transmittance_stop", "colour_error", "lattice_error", "contribution_cut", "evaluation_error")
# Settings without a name, for they pay in few scenes
STOPS, CONTRIBUTIONS, CUTS = (1e-2, 5e-2), (1e-2, 5e-2), (1 / 40, 1 / 32, 1 / 24, 1 / 16, 1 / 12)
LATTICE, PRUNED = 0.1, (3e-4, 1e-3, 3e-3)


@dataclass(frozen=True)
class Subject:
    """A scene to draw: its name, Gaussians, panel and rig."""

    name: str
    gaussians: Gaussians
    panel: Panel
    rig: Rig


class Setting(NamedTuple):
    """A quality, and how much of the scene's light was pruned before (see prune)."""

    quality: Quality
    pruned: float = 0.0


def settings() -> dict[str, Setting]:
    """Return the settings by name, "exact" first.

    Then come the other names, each knob alone at its values in the names, names without one knob, and pruned scenes.
    Pruned scenes are drawn exactly, by a name and approximately.
    """
    found = {name: Setting(quality) for name, quality in _qualities().items()}
    drawn = {
        "": EXACT,
        "fast, ": Quality.of("fast"),
        **{f"{_knobs(approximate)}, ": approximate for approximate in map(_approximate, CUTS)},
    }
    for cut in PRUNED:
        found |= {f"{name}pruned {_value(cut)}": Setting(quality, cut) for name, quality in drawn.items()}
    return found


def _approximate(opacity_cut: float) -> Quality:
    return Quality(opacity_cut=opacity_cut, evaluation_error=Quality.of("fast").evaluation_error)


def _knobs(approximate: Quality) -> str:
    return f"opacity_cut {_value(approximate.opacity_cut)}, evaluation_error {_value(approximate.evaluation_error)}"


def _qualities() -> dict[str, Quality]:
    found: dict[str, Quality] = {name: Quality.of(name) for name in QUALITY_NAMES}
    for knob, values in (("transmittance_stop", STOPS), ("contribution_cut", CONTRIBUTIONS)):
        found |= {f"{knob} {_value(value)}": Quality(**{knob: value}) for value in values}
    for approximate in map(
        _approximate, CUTS
    ):  # what of Gaussians does not overlap much bears more than the names take
        found[_knobs(approximate)] = approximate
        found[f"{_knobs(approximate)}, lattice_error {_value(LATTICE)}"] = replace(approximate, lattice_error=LATTICE)
    for knob in KNOBS:
        for name in QUALITY_NAMES:
            quality = found[name]
            value, without = getattr(quality, knob), getattr(EXACT, knob)
            if value == without:
                continue
            found.setdefault(f"{knob} {_value(value)}", replace(EXACT, **{knob: value}))
            if knob in ("opacity_cut", "lattice_error"):
                found[f"{name}, no {knob}"] = replace(quality, **{knob: without})
    return found


def _value(value: float) -> str:
    return f"1/{1 / value:.0f}" if 1 / value < 256 else f"{value:g}"


def subjects(
    scenes: Sequence[str], photos: Sequence[str], panel: Panel, cones: Sequence[Any], device: str
) -> list[Callable[[], Subject]]:
    """Return functions that make the subjects: every scene of load_scene and every photo, in every cone."""
    return [
        *(partial(_of_scene, scene, panel, cone, device) for scene in scenes for cone in cones),
        *(partial(_of_photo, path, panel, cone, device) for path in photos for cone in cones),
    ]


def _of_scene(scene: str, panel: Panel, cone: Any, device: str) -> Subject:
    gaussians = load_scene(scene).to(device)
    return Subject(Path(scene).name, gaussians, panel, benchmark_rig(scene, gaussians, panel, cone))


def scene_subjects(
    scenes: Sequence[str],
    sh_degrees: Sequence[int | None],
    panel: Panel,
    cones: Sequence[str | float | None],
    device: str,
) -> Iterator[Subject]:
    """Yield every scene with every degree of harmonics, in every cone; a scene is loaded once for all its cones."""
    for scene in scenes:
        for degree in sh_degrees:
            gaussians = load_scene(scene, degree).to(device)
            for cone in cones:
                yield Subject(Path(scene).name, gaussians, panel, benchmark_rig(scene, gaussians, panel, cone))


def _of_photo(path: str, panel: Panel, cone: Any, device: str) -> Subject:
    """Return the Gaussians of the package's network for a photo."""
    gaussians = network(None).predict(load_photo(path))
    rig = frame_photo(gaussians, panel)
    rig = replace(rig, cone_deg=cone_degrees(cone, panel, rig.focal_px[0]))
    return Subject(Path(path).name, gaussians.to(device), panel, rig)


@torch.no_grad()
def rows(
    subject: Subject, chosen: dict[str, Setting], repeats: int | None, threads: int | None
) -> list[dict[str, Any]]:
    """Return a row for each setting, the exact setting first. Raises InputError."""
    oracle = oracle_samples(subject.gaussians, subject.panel, subject.rig)
    what = {
        "scene": subject.name,
        "panel": subject.panel.name,
        "cone_deg": subject.rig.cone_deg,
        "device": subject.gaussians.means.device.type,
    }
    found, calls, scenes, out = [], [], {0.0: subject}, None
    for name, (quality, cut) in chosen.items():
        if cut not in scenes:
            scenes[cut] = replace(subject, gaussians=prune(subject.gaussians, subject.panel, subject.rig, cut))
        drawn = scenes[cut]
        stats: dict[str, Any] = {}
        out = encode(drawn.gaussians, drawn.panel, drawn.rig, quality=quality, threads=threads, stats=stats, out=out)
        found.append(
            {
                **what,
                "setting": name,
                "gaussians": drawn.gaussians.count,
                "named": name in QUALITY_NAMES,
                **oracle.errors(out),
                "pairs": stats["pairs"],
                "evaluations_per_subpixel": stats["evaluations_per_subpixel"],
                "skipped": stats["skipped"],
            }
        )
        calls.append(drawing(drawn, quality, threads, out))
    _, times = timed_in_turn(calls, subject.gaussians.means.is_cuda, repeats)
    for row, taken in zip(found, zip(*times)):
        row |= {"ms": min(taken), "runs": len(taken)}
    for row in found:
        row["times_as_fast"] = found[0]["ms"] / row["ms"]
        row["front"] = on_front(row, found)
    return found


def drawing(
    subject: Subject, quality: Quality = EXACT, threads: int | None = None, out: Tensor | None = None
) -> Callable[[], Tensor]:
    """Return a function that draws a subject: on CUDA an Encoder's replayed frame, on the CPU over `out`."""
    if subject.gaussians.means.is_cuda:
        return partial(Encoder(subject.panel, subject.rig, quality=quality), subject.gaussians)
    return partial(encode, subject.gaussians, subject.panel, subject.rig, quality=quality, threads=threads, out=out)


def on_front(row: dict[str, Any], found: list[dict[str, Any]]) -> bool:
    """Return whether no other row is at least as fast and as accurate, and better in one respect."""
    mine = row["ms"], -row["psnr_db"]
    others = ((other["ms"], -other["psnr_db"]) for other in found)
    return not any(ms <= mine[0] and loss <= mine[1] and (ms, loss) != mine for ms, loss in others)


def table(found: list[dict[str, Any]]) -> str:
    """Return the rows as text, one a line; rows of the Pareto front have a star."""
    head = ("scene", "cone", "setting", "", "ms", "times as fast", "PSNR dB", "max /255", "pairs", "eval/sub-px")
    lines = [
        (
            row["scene"],
            f"{row['cone_deg']:g}",
            row["setting"],
            "*" if row["front"] else "",
            in_ms(row["ms"]),
            f"{row['times_as_fast']:.2f}",
            f"{row['psnr_db']:.1f}",
            str(row["max_error_255"]),
            str(row["pairs"]),
            or_dash(row["evaluations_per_subpixel"], ".1f"),
        )
        for row in found
    ]
    return "\n".join(aligned([head, *lines]))


COLUMNS = 4


def plot(found: list[dict[str, Any]], path: Path) -> None:
    """Write the plot. Raises InputError."""
    cases: dict[tuple[str, float, str], list[dict[str, Any]]] = {}
    for row in found:
        cases.setdefault((row["scene"], row["cone_deg"], row["device"]), []).append(row)
    columns = min(COLUMNS, len(cases))
    down = math.ceil(len(cases) / columns)
    figure = new_figure(figsize=(3.4 * columns, 3 * down), layout="constrained")
    axes = list(figure.subplots(down, columns, squeeze=False).flat)
    for axis, ((scene, cone, device), rows) in zip(axes, cases.items()):
        _draw(axis, rows)
        axis.set_title(f"{scene}, {cone:.3g} degrees, {device}", fontsize=9)
    for axis in axes[len(cases) :]:
        axis.set_visible(False)
    figure.supxlabel("ms", fontsize=9)
    figure.supylabel("PSNR, dB", fontsize=9)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def _draw(axis: Any, rows: list[dict[str, Any]]) -> None:
    """Draw the settings as dots, with their names, and the front as a line."""
    front = sorted((row for row in rows if row["front"]), key=lambda row: row["ms"])
    axis.step(
        [row["ms"] for row in front],
        [row["psnr_db"] for row in front],
        where="post",
        color="0.6",
        linewidth=1,
        zorder=1,
    )
    for named, colour in ((False, "tab:grey"), (True, "tab:red")):
        some = [row for row in rows if row["named"] == named]
        axis.scatter([row["ms"] for row in some], [row["psnr_db"] for row in some], s=12, color=colour, zorder=2)
        for row in some if named else ():
            axis.annotate(
                row["setting"], (row["ms"], row["psnr_db"]), xytext=(4, 3), textcoords="offset points", fontsize=8
            )
    axis.set_xlim(left=0)
    axis.margins(0.12)
    axis.grid(True, linewidth=0.3)
    axis.tick_params(labelsize=8)


@dataclass(frozen=True, kw_only=True)
class Options(options.SceneOptions):
    """The options of the benchmark.

    Attributes:
        photo: files with commas. None: the example of the package, unless there are scenes.
        plot: file for the picture of the rows.
    """

    photo: str | None = None
    plot: Path | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    options.add_scene(parser, SCENES)
    options.add_photo(parser, EXAMPLE)
    options.add_panel(parser)
    options.add_cone(parser, "5,40")
    options.add_plot(parser)
    options.add_repeats(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the rows of every scene, photo, cone and setting, and their text; draw the plot."""
    if given.plot is not None:
        check_plot(given.plot)
    photos = [] if given.scene and not given.photo else (given.photo or str(EXAMPLE)).split(",")
    options.check_photos(photos)
    scenes = SCENES if not given.scene and not given.photo else given.scene.split(",") if given.scene else ()
    options.check_scenes(scenes)
    found: list[dict[str, Any]] = []
    count = given.thread_count
    cones = CONES if given.cone is None else options.cones(given.cone)
    for subject in subjects(scenes, photos, given.load_panel(), cones, given.device):
        made = subject()
        options.progress(f"{made.name}, {made.rig.cone_deg:g} degrees: oracle, then all settings by turns")
        found += rows(made, settings(), given.repeats, count)
    if given.plot is not None:
        plot(found, given.plot)
    return {"rows": found}, table(found)
