"""Measure the time that each skip saves: a light-field image with and without the skip, by turns, and its counts.

A skip without a switch is compared with an image that cannot use it and is otherwise as similar as possible. The row's
note names the difference. If there is no such image, the row has no time, and says why.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.arrays import background_tensor
from lightfield_gs.bench import options
from lightfield_gs.bench.pareto import Subject, drawing, scene_subjects
from lightfield_gs.bench.report import aligned, in_ms, or_dash
from lightfield_gs.bench.scenes import with_harmonics
from lightfield_gs.bench.timing import timed_in_turn
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.panels.rig import Rig, lenticular_camera
from lightfield_gs.rasterizer.direct import COLOUR_ORDER, DirectRender
from lightfield_gs.rasterizer.frame_cuda import DirectFrames
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.scene.gaussians import Gaussians, from_tensors
from lightfield_gs.simplification.pruning import prune

SCENES = ("cloud:65536",)
OPACITY_CUT, LATTICE_ERROR = Quality.of("fast").opacity_cut, Quality.of("high").lattice_error
TRANSMITTANCE_STOP, CONTRIBUTION_CUT = 5e-2, 2e-2
PRUNED = 3e-4  # the contribution_cut of `prune`
_HARMONICS = 3  # degree of the harmonics that a scene without any is given
Draw = Callable[[], Tensor]


@dataclass(frozen=True)
class Skip:
    """A skip: its amount, how to draw with and without it, and a description of the image without it."""

    name: str
    counted: str
    with_it: Draw | None = None
    without: Draw | None = None
    note: str = ""


@torch.no_grad()
def rows(subject: Subject, repeats: int | None, threads: int | None) -> list[dict[str, Any]]:
    """Return a row for each skip: ms_with and ms_without, the shortest of the runs, or None. Raises InputError."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)  # an Encoder takes torch's
    try:
        return _rows(subject, repeats)
    finally:
        torch.set_num_threads(before)


def _rows(subject: Subject, repeats: int | None) -> list[dict[str, Any]]:
    what = {
        "scene": subject.name,
        "gaussians": subject.gaussians.count,
        "panel": subject.panel.name,
        "cone_deg": subject.rig.cone_deg,
        "device": subject.gaussians.means.device.type,
    }
    found = []
    for skip in skips(subject):
        row = {
            **what,
            "skip": skip.name,
            "counted": skip.counted,
            "note": skip.note,
            "ms_with": None,
            "ms_without": None,
        }
        if skip.with_it is not None and skip.without is not None:
            calls = [skip.with_it, skip.without, skip.without, skip.with_it]  # each comes first once
            for call in calls:
                call()  # fills buffers, captures and caches between frames
            first, second, third, fourth = zip(*timed_in_turn(calls, subject.gaussians.means.is_cuda, repeats)[1])
            row |= {"ms_with": min(*first, *fourth), "ms_without": min(*second, *third)}
        found.append(row)
    return found


def skips(subject: Subject) -> Iterator[Skip]:
    """Return every skip for a scene."""
    exact, counted = drawing(subject), _counted(subject)
    yield _culling(subject, counted["skipped"])
    yield Skip(
        "rows and spans outside footprints",
        f"all but {counted['pairs']} intersections of tile and Gaussian",
        note="not separable: lists of what touches a tile are how an image is drawn",
    )
    yield _empty_tiles(subject, counted["skipped"])
    yield _colour_orders(subject)
    for name, quality, note in (
        ("opacity cut", Quality(opacity_cut=OPACITY_CUT), "without: the least cut there is, 1/255"),
        (
            "early stop",
            Quality(transmittance_stop=TRANSMITTANCE_STOP),
            f"at {TRANSMITTANCE_STOP:g} of the light; without: the least stop there is, 1e-4",
        ),
        ("lattice", Quality(lattice_error=LATTICE_ERROR), f"of error {LATTICE_ERROR:g}"),
        ("pruning in a frame", Quality(contribution_cut=CONTRIBUTION_CUT), f"by less than {CONTRIBUTION_CUT:g}"),
    ):
        what = _what_it_skips(name, counted, _counted(subject, quality))
        yield Skip(name, what, drawing(subject, quality), exact, note)
    fewer = replace(subject, gaussians=prune(subject.gaussians, subject.panel, subject.rig, PRUNED))
    yield Skip(
        "pruning of the scene",
        f"{subject.gaussians.count - fewer.gaussians.count} Gaussians",
        drawing(fewer),
        exact,
        f"once, by `prune`, {PRUNED:g} of the light",
    )
    yield from _reuse(subject)


def _what_it_skips(name: str, exact: dict[str, Any], stats: dict[str, Any]) -> str:
    """Describe the skipped work, by the statistics of an exact image and of an image with the skip."""
    skipped = stats["skipped"]
    if name == "opacity cut":
        return f"{exact['pairs'] - stats['pairs']} intersections of tile and Gaussian"
    if name == "early stop":
        return f"{or_dash(skipped.get('samples_stopped'), 'd')} sub-pixels"
    if name == "lattice":
        tiles = skipped.get("tiles", {"lattice": 0, "drawn": 0})
        return f"{tiles['lattice']} of {tiles['lattice'] + tiles['drawn']} tiles with Gaussians"
    return f"{skipped['gaussians']['pruned']} Gaussians"


def table(found: list[dict[str, Any]]) -> str:
    """Return the rows as text, one a line, with a note on the method below."""
    head = ("scene", "cone", "skip", "skipped", "ms with", "ms without", "saved")
    lines = []
    for row in found:
        with_it, without = row["ms_with"], row["ms_without"]
        times = ("-", "-", "-") if with_it is None else (in_ms(with_it), in_ms(without), f"{1 - with_it / without:.0%}")
        lines.append((row["scene"], f"{row['cone_deg']:.3g}", row["skip"], row["counted"], *times))
    return "\n".join([*aligned([head, *lines]), *dict.fromkeys(f"{row['skip']}: {row['note']}" for row in found)])


def _counted(subject: Subject, quality: Quality = EXACT) -> dict[str, Any]:
    stats: dict[str, Any] = {}
    encode(subject.gaussians, subject.panel, subject.rig, quality=quality, stats=stats)
    return stats


def _culling(subject: Subject, skipped: dict[str, Any]) -> Skip:
    """Compare the scene plus as many Gaussians behind the cameras with the scene alone."""
    scene = subject.gaussians
    *axis, shift = (float(value) for value in subject.rig.world_to_camera[2])
    forward = scene.means.new_tensor(axis)
    depths = scene.means @ forward + shift
    behind = replace(scene, means=scene.means - (depths + depths.abs() + 1)[:, None] * forward)
    both = from_tensors(torch.cat(pair) for pair in zip(scene.fields().values(), behind.fields().values()))
    return Skip(
        "culling",
        ", ".join(f"{n} {why}" for why, n in skipped["gaussians"].items()),
        drawing(replace(subject, gaussians=both)),
        drawing(subject),
        "not separable: nothing unculled would touch a tile either; here what as many Gaussians again, all "
        "behind the cameras, still cost",
    )


def _empty_tiles(subject: Subject, skipped: dict[str, Any]) -> Skip:
    """Make every tile one to draw, by a very faint Gaussian behind all others and over the whole panel."""
    scene, rig = subject.gaussians, subject.rig
    rotation, shift = (
        torch.as_tensor(part, dtype=scene.dtype, device=scene.device)
        for part in (rig.world_to_camera[:3, :3], rig.world_to_camera[:3, 3])
    )
    depth = 2 * float((scene.means @ rotation[2] + shift[2]).clamp_min(rig.zero_depth).max())
    mean = (torch.tensor([0, 0, depth], dtype=scene.dtype, device=scene.device) - shift) @ rotation
    veil = (
        mean[None],
        scene.means.new_tensor([[1.0, 0, 0, 0]]),
        scene.means.new_full((1, 3), 10 * depth),
        scene.means.new_full((1,), 1.1 / 255),
        torch.zeros_like(scene.sh[:1]),
    )
    veiled = from_tensors(torch.cat(pair) for pair in zip(scene.fields().values(), veil))
    empty = skipped.get("tiles", {}).get("empty")
    return Skip(
        "empty tiles",
        f"{or_dash(empty, 'd')} tiles",
        drawing(subject),
        drawing(replace(subject, gaussians=veiled)),
        "without: a veil of alpha 0.004 behind all, one Gaussian, is in every tile",
    )


def _colour_orders(subject: Subject) -> Skip:
    """Compare polynomials of each Gaussian's own order with exact colours for all."""
    scene, note = subject.gaussians, "without: the colours of all Gaussians are exact"
    if scene.sh_degree == 0:
        scene = with_harmonics(scene.to("cpu"), _HARMONICS).to(scene.device)
        note += f"; the scene has no harmonics, these are random ones of degree {_HARMONICS}"
    subject = replace(subject, gaussians=scene)
    orders = _counted(subject)["skipped"].get("colour_orders")
    counted = "-" if orders is None else ", ".join(f"{order}: {n}" for order, n in enumerate(orders) if n)
    return Skip(
        "harmonics cut per Gaussian",
        counted,
        _colours(subject, EXACT),
        _colours(subject, Quality(colour_error=0.0)),
        note,
    )


def _colours(subject: Subject, quality: Quality) -> Draw:
    """Draw with polynomials up to one order, and exactly where their error exceeds the quality's limit."""
    background = background_tensor((1.0, 1.0, 1.0), subject.gaussians.means)
    job = DirectRender(subject.gaussians.fields().values(), background, lenticular_camera(subject.panel, subject.rig))
    if subject.gaussians.means.is_cuda:
        frames = DirectFrames(job, quality)
        frames.orders, frames.colour_order = (COLOUR_ORDER,), COLOUR_ORDER
        return partial(frames.draw, job, True)
    return partial(job.draw, True, quality)


@dataclass
class _Film:
    """Return a separate scene, in which something changes before every frame."""

    scene: Gaussians
    rig: Rig
    change: str
    draw: Callable[[Gaussians, Rig], Tensor]
    frame: int = 0

    def __call__(self) -> Tensor:
        self.frame += 1
        to_and_fro, rig = 2 * (self.frame % 2) - 1, self.rig
        if self.change == "other colours":
            self.scene.sh.neg_()
        elif self.change == "zero plane moved":
            rig = replace(rig, zero_depth=(1 + 0.005 * to_and_fro) * rig.zero_depth)
        elif self.change == "all new":
            self.scene.means.add_(1e-3 * rig.zero_depth * to_and_fro)
        return self.draw(self.scene, rig)


def _reuse(subject: Subject) -> Iterator[Skip]:
    """Compare an Encoder's frames with separate images."""
    note = "by an Encoder; without: `encode`"
    for change in ("nothing new", "other colours", "zero plane moved", "all new"):
        encoder = Encoder(subject.panel, subject.rig, versioned=True)

        def repeat(scene: Gaussians, rig: Rig, encoder: Encoder = encoder) -> Tensor:
            encoder.rig = rig
            return encoder(scene)

        def draw_anew(scene: Gaussians, rig: Rig) -> Tensor:
            return encode(scene, subject.panel, rig)

        film, anew = (
            _Film(from_tensors(t.clone() for t in subject.gaussians.fields().values()), subject.rig, change, draw)
            for draw in (repeat, draw_anew)
        )
        for _ in range(3):
            film()
        before = dict(encoder.stats["reused"])
        film()
        spared = [stage for stage, n in encoder.stats["reused"].items() if n > before[stage]]
        yield Skip(f"reuse, {change}", ", ".join(spared) or "no stage", film, anew, note)


Options = options.SceneOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    options.add_scene(parser, SCENES)
    options.add_panel(parser)
    options.add_cone(parser)
    options.add_sh_degree(parser)
    options.add_repeats(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the rows of every skip, for every scene and cone, and their text."""
    scenes, panel = SCENES if given.scene is None else given.scene.split(","), given.load_panel()
    cones, count = options.cones(given.cone), given.thread_count
    degrees, found = options.sh_degrees(given.sh_degree), []
    options.check_scenes(scenes, degrees)
    for subject in scene_subjects(scenes, degrees, panel, cones, given.device):
        options.progress(f"{subject.name}, {subject.rig.cone_deg:g} degrees: with and without every skip by turns")
        found += rows(subject, given.repeats, count)
    return {"rows": found}, table(found)
