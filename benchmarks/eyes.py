"""Compare the views of eyes across the cone, with and without the view filter, with exact cameras."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.names import LIGHT_FIELD_SCENES as SCENES
from lightfield_gs.bench.pareto import Subject, scene_subjects
from lightfield_gs.bench.report import aligned
from lightfield_gs.encoding.encode import encode
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import missing_geometry
from lightfield_gs.reference.eyes import EyeReference, eyes_across

EYES = 25


def filter_widths(panel: Panel) -> list[float]:
    """In views: off, half a view, one view, and, where it is more, the width that one sub-pixel sees through a lens."""
    subpixel = panel.views / panel.line_number
    return [0.0, 0.5, 1.0, *([round(subpixel, 2)] if subpixel > 1.05 else [])]


def check_panel(panel: Panel) -> None:
    """Raises InputError for a panel before which no eye can be placed."""
    if missing := missing_geometry(panel):
        raise InputError(f"panel {panel.name} lacks {' and '.join(missing)}, without which no eye can be placed")


@torch.no_grad()
def rows(subject: Subject, widths: Sequence[float] | None = None, count: int | None = None) -> Iterator[dict[str, Any]]:
    """A row for each width of the view filter: mean, worst and best PSNR, and SSIM, over `count` eyes (None: EYES).
    Raises InputError."""
    panel, count = subject.panel, EYES if count is None else count
    reference = EyeReference(subject.gaussians, panel, subject.rig, eyes_across(panel, count))
    for width in filter_widths(panel) if widths is None else widths:
        image = encode(subject.gaussians, panel, subject.rig, output="float32", view_filter=width)
        scores = list(reference.scores(image.clamp(0, 1).cpu().numpy()))
        psnr, ssim = (np.array([getattr(score, name) for score in scores]) for name in ("psnr_db", "ssim"))
        yield {
            "scene": subject.name,
            "gaussians": subject.gaussians.count,
            "panel": panel.name,
            "cone_deg": subject.rig.cone_deg,
            "eyes": count,
            "view_filter": width,
            "psnr_db": float(psnr.mean()),
            "psnr_db_worst": float(psnr.min()),
            "psnr_db_best": float(psnr.max()),
            "ssim": float(ssim.mean()),
            "ssim_worst": float(ssim.min()),
            "scores": [vars(score) for score in scores],
        }


def table(found: list[dict[str, Any]]) -> str:
    """The rows as text."""
    head = ("scene", "panel", "cone", "eyes", "filter, views", "PSNR dB", "worst", "best", "SSIM", "worst")
    lines = [
        (
            row["scene"],
            row["panel"],
            f"{row['cone_deg']:.3g}",
            str(row["eyes"]),
            f"{row['view_filter']:g}",
            f"{row['psnr_db']:.2f}",
            f"{row['psnr_db_worst']:.2f}",
            f"{row['psnr_db_best']:.2f}",
            f"{row['ssim']:.4f}",
            f"{row['ssim_worst']:.4f}",
        )
        for row in found
    ]
    return "\n".join(aligned([head, *lines]))


Options = options.SceneOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    options.add_scene(parser, SCENES)
    options.add_panel(parser)
    options.add_cone(parser)
    options.add_sh_degree(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Rows of every width of the view filter, for every scene and cone, and their text."""
    scenes, panel = SCENES if given.scene is None else given.scene.split(","), given.load_panel()
    check_panel(panel)
    cones, degrees = options.cones(given.cone), options.sh_degrees(given.sh_degree)
    found: list[dict[str, Any]] = []
    torch.set_num_threads(given.thread_count or torch.get_num_threads())
    options.check_scenes(scenes, degrees)
    for subject in scene_subjects(scenes, degrees, panel, cones, given.device):
        options.progress(f"{subject.name}, {subject.rig.cone_deg:g} degrees: {EYES} eyes")
        found += rows(subject)
    return {"rows": found}, table(found)
