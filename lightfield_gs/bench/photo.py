"""Measure the time from a photo's decoded bytes in memory to the panel's 8-bit image in memory.

The total is the time of PhotoEncoder, whose stages on CUDA wait only for the rig. The stages are timed in runs of their
own, in which they wait for each other. The total does not include the decoding of the file.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.app.photo import network_detail
from lightfield_gs.base.options import Detail
from lightfield_gs.bench import options
from lightfield_gs.bench.report import aligned, in_ms
from lightfield_gs.bench.timing import timed
from lightfield_gs.commands.options.scene import add_detail
from lightfield_gs.models import ModelConfig, SplatterNet
from lightfield_gs.models.splatter_net import PRETRAINED
from lightfield_gs.panels.panel import Panel
from lightfield_gs.photo.encoder import PhotoEncoder
from lightfield_gs.photo.load import load_photo
from lightfield_gs.scene.gaussians import Gaussians

EXAMPLE = Path(__file__).parent.parent / "data" / "cat.png"
STAGES = ("crop", "network", "framing", "encode")


def network(name: str | None) -> SplatterNet:
    """Return the network of a checkpoint, or an untrained network by a configuration.

    A checkpoint is a .safetensors; None: the package's own.

    An untrained one takes as long and shows the photo as a flat card. Raises InputError.
    """
    if name is None or Path(name).suffix == ".safetensors":
        return SplatterNet.from_pretrained(name)
    torch.manual_seed(0)
    return SplatterNet(ModelConfig.from_yaml(name)).eval()


def row(
    path: str | Path,
    model: str | None,
    panel: Panel,
    device: str,
    repeats: int | None,
    threads: int | None,
    detail: tuple[Detail | None, int],
) -> dict[str, Any]:
    """Return a photo's medians in ms of decode, the stages and the total, and ms_min and ms_max of the total.

    Args:
        detail: Detail and budget of PhotoEncoder.

    Raises:
        InputError: the photo cannot be encoded.
    """
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads or before)
        decoded, decode_ms = timed(partial(load_photo, path), False, repeats)
        rgba = np.round(255 * decoded).astype(np.uint8)
        encoder = PhotoEncoder(network(model).to(device), panel, detail=detail[0], budget=detail[1])
        encoder(rgba)  # loads and captures
        image, total_ms = timed(partial(encoder, rgba), device == "cuda", repeats, ahead=False)
        stages = _stages(encoder, rgba, len(total_ms))
        return {
            "photo": Path(path).name,
            "height_px": rgba.shape[0],
            "width_px": rgba.shape[1],
            "model": model or PRETRAINED.name,
            "detail": detail[0],
            "gaussians": cast(Gaussians, encoder.gaussians).count,  # of the photo just drawn
            "panel": panel.name,
            "device": device,
            "threads": torch.get_num_threads(),
            "decode_ms": statistics.median(decode_ms),
            "stages_ms": stages,
            "ms_median": statistics.median(total_ms),
            "ms_min": min(total_ms),
            "ms_max": max(total_ms),
            "runs": len(total_ms),
        }
    finally:
        torch.set_num_threads(before)


def _stages(encoder: PhotoEncoder, rgba: np.ndarray, runs: int) -> dict[str, float]:
    """Return the medians of the stages."""
    found: list[dict[str, float]] = []
    for _ in range(runs):
        stats: dict[str, Any] = {}
        encoder(rgba, stats)
        found.append(stats["stages_ms"])
    return {stage: statistics.median(times[stage] for times in found) for stage in STAGES}


def rows(
    photos: list[str],
    model: str | None,
    panel: Panel,
    device: str,
    repeats: int | None,
    threads: list[int | None],
    detail: tuple[Detail | None, int],
) -> list[dict[str, Any]]:
    """Return a row for each photo and number of threads. Raises InputError."""
    return [row(path, model, panel, device, repeats, count, detail) for path in photos for count in threads]


def table(found: list[dict[str, Any]]) -> str:
    """Return the rows as text, one a line."""
    head = (
        "photo",
        "size",
        "model",
        "detail",
        "Gaussians",
        "device",
        "threads",
        "decode",
        *STAGES,
        "total ms",
        "min",
        "max",
    )
    lines = [
        (
            r["photo"],
            f"{r['width_px']} x {r['height_px']}",
            r["model"],
            str(r["detail"] or "none"),
            str(r["gaussians"]),
            r["device"],
            str(r["threads"]),
            in_ms(r["decode_ms"]),
            *(in_ms(r["stages_ms"][stage]) for stage in STAGES),
            in_ms(r["ms_median"]),
            in_ms(r["ms_min"]),
            in_ms(r["ms_max"]),
        )
        for r in found
    ]
    return "\n".join(aligned([head, *lines]))


@dataclass(frozen=True, kw_only=True)
class Options(options.PanelOptions):
    """The options of the benchmark.

    Attributes:
        photo: files with commas. None: the example of the package.
        model: checkpoint or configuration of a network. None: the checkpoint of the package.
        network: options of the network.
    """

    photo: str | None = None
    model: str | None = None
    network: PhotoOptions = PhotoOptions()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    options.add_photo(parser, EXAMPLE)
    parser.add_argument(
        "--model",
        help="a checkpoint (.safetensors), or the configuration of an untrained network, a name or .yaml "
        "(default: the checkpoint in the package)",
    )
    add_detail(parser.add_argument)
    options.add_panel(parser)
    options.add_repeats(parser)
    options.add_machine(parser, several_threads=True)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the rows of every photo and number of threads, and their text."""
    photos = [str(EXAMPLE)] if given.photo is None else given.photo.split(",")
    options.check_photos(photos)
    threads, detail = options.thread_counts(given.threads), network_detail(given.network)
    found = rows(photos, given.model, given.load_panel(), given.device, given.repeats, threads, detail)
    return {"rows": found}, table(found)
