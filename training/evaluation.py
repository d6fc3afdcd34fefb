"""Scores of a network on unseen objects: how well does it predict the other views of each from one?

Protocol: the source is view 0 by default, cropped to the object from the stored image. All views are rendered into
their full frames at size_px on white, and clamped to 0..1. Each is compared with the stored image, averaged down to
that size. PSNR, SSIM and the PSNR of gradients are means over images; the latter tells soft pictures from sharp ones.
The source view has scores of its own. Holes and ghosts are fractions of the object's pixels where the prediction is
translucent and where it is beside the object (training/coverage.py). Two floors need no network:

- copy: the source image itself, in place of every other view;
- card: the source image as a flat card at OBJECT_DISTANCE, the depth of the object's middle.

The rasterizer widens all Gaussians by 0.3 px^2 of variance (Kerbl et al. 2023). This matters for objects of 50 px, and
not for those on a panel. Supersampling draws n times as finely and averages, as the stored images are averaged, and so
leaves 0.3 / n^2.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.models import SplatterNet
from lightfield_gs.reference.metrics import gradient_psnr_db, psnr_db, ssim
from training.comparison import SIZE_PX, Comparison, Source, compare_object, save_comparison
from training.coverage import holes_and_ghosts
from training.data.background import Choice
from training.data.objects import find_objects, object_folder
from training.ranges import MOST

BIN_DEG = 5
_SCORES = {"psnr_db": psnr_db, "ssim": ssim, "gradient_psnr_db": gradient_psnr_db}
_METRICS = (*(f"{shown}{name}" for shown in ("", "copy_", "card_") for name in _SCORES), "holes", "ghosts")


def _scores(comparison: Comparison) -> Iterator[tuple[int | None, dict[str, float]]]:
    """Angle bin, None for the source itself, and metrics of each view."""
    truth = comparison.truth
    copies = truth[comparison.source].expand_as(truth)
    columns = [
        score(images, truth).tolist()
        for images in (comparison.rendered, copies, comparison.card)
        for score in _SCORES.values()
    ]
    columns += [part.tolist() for part in holes_and_ghosts(comparison.rendered_alpha, comparison.truth_alpha)]
    for index, (azimuth, *values) in enumerate(zip(comparison.azimuths_deg, *columns)):
        angle = None if index == comparison.source else round(abs(azimuth) / BIN_DEG) * BIN_DEG
        yield angle, dict(zip(_METRICS, values))


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    """The number of views and the mean of each metric."""
    return {"views": len(rows)} | {name: float(np.mean([row[name] for row in rows])) for name in _METRICS}


def score_folder(
    net: SplatterNet,
    data: Path,
    *,
    limit: int | None = None,
    save_renders: Path | None = None,
    split: str = "val",
    device: torch.device | str = "cpu",
    decoded: dict[Path, Tensor] | None = None,
    supersampling: int = 1,
    source: Source = 0,
    background: Choice = "auto",
    size_px: int = SIZE_PX,
    detail: int | None = None,
) -> dict[str, Any]:
    """Score a network on the objects at or below a folder.

    Args:
        limit: number of objects to score, spread evenly over the folder; None: all.
        save_renders: folder for one picture per object, in folders as the objects are.
        device: where the network is.
        decoded: keeps the images from call to call, for further scores of the same objects.
        supersampling: samples of a rendered pixel along each axis.
        source: see source_view.
        background: see find_cutout.
        size_px: length of the longer side of the frames that are compared.
        detail: how many times finer than the network's pictures the sheet of the source is (1, 2, 4); None: no sheet.

    Returns:
        Means over all novel views: psnr_db, ssim, gradient_psnr_db; copy_psnr_db, card_psnr_db and so on are the same
        of the floors. "objects" and "views" are their numbers. "bins": the same for each angle_deg, the
        azimuth to either side rounded to 5 degrees. "source": the same for the source views. "object_psnr_db": of each
        object by its path. "skipped": the reason for each object that could not be scored. "doubts": for scored objects
        whose cameras stand elsewhere than the network expects.

    Raises:
        InputError: no object can be scored, or the limit is below 1.
    """
    bins: dict[int | None, list[dict[str, float]]] = defaultdict(list)
    of_objects: dict[str, float] = {}
    skipped: dict[str, str] = {}
    doubts: dict[str, str] = {}
    objects = find_objects(data, split)
    if limit is not None:
        count = min(whole_number("limit", limit, 1, MOST), len(objects))
        objects = [objects[number * len(objects) // count] for number in range(count)]
    for path in tqdm(objects, desc=f"scoring {data}", unit="object", leave=False):
        try:
            comparison = compare_object(
                net,
                path,
                source=source,
                device=device,
                decoded=decoded,
                supersampling=supersampling,
                background=background,
                size_px=size_px,
                detail=detail,
            )
        except InputError as error:
            skipped[str(path.relative_to(data))] = str(error)
            continue
        if comparison.doubt:
            doubts[str(path.relative_to(data))] = comparison.doubt
        scores = list(_scores(comparison))
        for angle, row in scores:
            bins[angle].append(row)
        novel = _means([row for angle, row in scores if angle is not None])
        of_objects[str(path.relative_to(data))] = novel["psnr_db"]
        if save_renders is not None:
            folder = save_renders / object_folder(path).relative_to(data).parent
            save_comparison(comparison, folder / f"{comparison.name}.png")
    if not of_objects:
        raise InputError(
            f"{data}: none of {len(objects)} objects can be scored; the first: {next(iter(skipped.values()))}"
        )
    of_sources = bins.pop(None)
    return (
        {"objects": len(of_objects)}
        | _means([row for rows in bins.values() for row in rows])
        | {
            "source": _means(of_sources),
            "bins": [{"angle_deg": angle} | _means(bins[angle]) for angle in sorted(bins)],
            "object_psnr_db": of_objects,
            "skipped": skipped,
            "doubts": doubts,
        }
    )


def labelled(report: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Return the rows of a table of score_folder's result: the source views, each angle, all novel views."""
    angles = [(f"{row['angle_deg']} deg", row) for row in report["bins"]]
    return [("source", report["source"]), *angles, ("all", report)]
