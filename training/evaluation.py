"""Scores of a network on objects it has not seen: from one view of each, how well are the others predicted?

Protocol: the source is view 0 unless said otherwise, cropped to the object from the stored image; all views are
rendered into their full frames at size_px on white, clamped to 0..1, and compared with the stored images averaged down
to that size. PSNR and SSIM are means over images; those of the source view itself stand apart. Beside them stand two
floors, what needs no network: "copy", the source image itself offered as every other view, and "card", the source image
as a flat card at OBJECT_DISTANCE, the depth of the object's middle.

The rasterizer widens all Gaussians by 0.3 px^2 of variance (Kerbl et al. 2023), which objects of 50 px feel and those
on a panel do not. Supersampling draws n times as finely and averages, as the stored images are averaged, and so
leaves 0.3 / n^2.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.captures.views import ObjectViews
from lightfield_gs.io.images import write_image
from lightfield_gs.models import SplatterNet
from lightfield_gs.models.crop import crop_resize, object_square
from lightfield_gs.reference.metrics import psnr_db, ssim
from training.data.background import Choice
from training.data.distance import OBJECT_DISTANCE, distance_doubt
from training.data.images import find_cutout, read_view
from training.data.objects import find_objects, folder_of, read_object
from training.data.plan import relative_cameras
from training.ranges import MOST
from training.rendering import render_card, render_views

SIZE_PX = 128
BIN_DEG = 5
Source = int | Literal["middle"]
_METRICS = ("psnr_db", "ssim", "copy_psnr_db", "copy_ssim", "card_psnr_db", "card_ssim")


@dataclass
class Comparison:
    """One object with V views, the source being one of them.

    source: its number. doubt: set where the cameras stand elsewhere than the network expects. azimuths_deg: [V], from
    the source. truth, rendered, card: [V,3,H,W] on white, 0..1.
    """

    name: str
    source: int
    doubt: str | None
    azimuths_deg: np.ndarray
    truth: Tensor
    rendered: Tensor
    card: Tensor


def azimuths_from_source(camera_to_world: np.ndarray, source: int = 0) -> np.ndarray:
    """Azimuth [V] of each view about the vertical axis, relative to the source, in degrees within -180..180.

    The vertical axis is the one at right angles to the x axes of all cameras, since upright cameras keep theirs level.
    Where these are parallel, cameras stand above each other, and the source's own vertical will do.
    Raises InputError when there is none (cameras that roll): such views have no azimuth.
    """
    source_up = -camera_to_world[source, :3, 1]
    _, spread, axes = np.linalg.svd(camera_to_world[:, :3, 0])
    spread = np.append(spread, (0.0, 0.0))  # two cameras span a plane at most
    if spread[2] > 0.02 * spread[0]:
        raise InputError("the cameras roll: expected upright cameras (level x axes) to measure azimuths")
    up = axes[2] * np.sign(axes[2] @ source_up) if spread[1] > 1e-3 * spread[0] else source_up
    level = camera_to_world[:, :3, 2] - np.outer(camera_to_world[:, :3, 2] @ up, up)
    return np.degrees(np.arctan2(level @ np.cross(level[source], up), level @ level[source]))


def source_view(path: Path, camera_to_world: np.ndarray, source: Source) -> int:
    """The number of the source view among those of an object [V,4,4]: itself, or, in the "middle", the one whose
    direction is nearest to the mean of all.

    Raises InputError where there is no such view, beginning with the object's path.
    """
    if source == "middle":
        directions = camera_to_world[:, :3, 2]
        return int((directions @ directions.mean(0)).round(9).argmax())
    if not 0 <= source < len(camera_to_world):
        raise InputError(f"{path}: expected a source view of 0..{len(camera_to_world) - 1}, got {source}")
    return source


def _frames(views: ObjectViews, background: Choice) -> Tensor:
    """All views of an object as premultiplied RGBA, uint8 [V,4,H,W]."""
    cutout = find_cutout(views, background)
    frames = np.stack([read_view(views, index, cutout) for index in range(len(views.image_paths))])
    return torch.from_numpy(frames).permute(0, 3, 1, 2)


def _on_white(frames: Tensor) -> Tensor:
    """Premultiplied RGBA [V,4,H,W] on white: [V,3,H,W]."""
    return frames[:, :3] + 1 - frames[:, 3:]


@torch.no_grad()
def compare_object(
    net: SplatterNet,
    path: Path,
    size_px: int = SIZE_PX,
    source: Source = 0,
    device: torch.device | str = "cpu",
    decoded: dict[Path, Tensor] | None = None,
    supersampling: int = 1,
    background: Choice = "auto",
) -> Comparison:
    """Predict an object from one view and render it from all.

    path: as find_objects names it. size_px: length of the longer side of the frames. source: see source_view. device:
    where the network is; the tensors returned are there. decoded, supersampling, background: see score_folder. Raises
    InputError for an object that cannot be read, has one view only, no such source, or cameras that roll.
    """
    views, decoded = read_object(path), {} if decoded is None else decoded
    if len(views.image_paths) < 2:
        raise InputError(f"{path}: expected at least two views, one to predict the others from, got one")
    source = source_view(path, views.camera_to_world, source)
    with named(path):
        azimuths = azimuths_from_source(views.camera_to_world, source)
    if path not in decoded:
        decoded[path] = _frames(views, background).to(device)
    frames = decoded[path] / 255
    scale = size_px / max(views.width_px, views.height_px)
    width, height = round(views.width_px * scale), round(views.height_px * scale)
    square = object_square(frames[source, 3])
    fx, fy, cx, cy = views.intrinsics[source].tolist()
    net_size = net.config.image_size_px
    source_intrinsics = torch.tensor([square.intrinsics((fx, fy), (cx, cy), net_size)], device=device)
    gaussians = net(crop_resize(frames[source], square, net_size)[None], source_intrinsics)
    cameras = relative_cameras(views.camera_to_world, views.camera_to_world[source])
    cameras = torch.from_numpy(cameras).float().to(device)
    intrinsics = torch.from_numpy(views.intrinsics * scale).float().to(device)
    white = torch.ones(1, len(frames), 3, device=device)
    images, _ = render_views(
        gaussians, cameras[None], supersampling * intrinsics[None], supersampling * width, supersampling * height, white
    )
    images = F.interpolate(images[0].clamp(0, 1), size=(height, width), mode="area")
    truth = F.interpolate(frames, size=(height, width), mode="area")
    card = render_card(truth[source], intrinsics[source], OBJECT_DISTANCE, cameras, intrinsics)
    return Comparison(
        views.name, source, distance_doubt(views.camera_to_world), azimuths, _on_white(truth), images, _on_white(card)
    )


def _scores(comparison: Comparison) -> Iterator[tuple[int | None, dict[str, float]]]:
    """Angle bin, None for the source itself, and metrics of each view."""
    truth = comparison.truth
    copies = truth[comparison.source].expand_as(truth)
    columns = [
        score(images, truth).tolist()
        for images in (comparison.rendered, copies, comparison.card)
        for score in (psnr_db, ssim)
    ]
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
) -> dict[str, Any]:
    """Score a network on the objects at or below a folder, of this split where they come in splits.

    Returns objects, and psnr_db, ssim, copy_psnr_db, copy_ssim, card_psnr_db, card_ssim and views (their number) over
    all novel views; bins: the same for each angle_deg (azimuth to either side, rounded to 5 degrees) of novel views;
    source: the same for the source views; object_psnr_db: of each object by its path, over its novel views. skipped:
    why, for the path of each object that could not be scored; these count in nothing else. doubts: for the paths of
    scored objects whose cameras stand elsewhere than the network expects.
    limit: score so many of them only, spread evenly over the folder; None: all.
    save_renders: folder for one picture per object, in folders as the objects are. device: where the network is.
    decoded: keeps the images from call to call, for those who score the same objects again. supersampling: samples of a
    rendered pixel along each axis. source: see source_view. background: see find_cutout.
    Raises InputError where no object can be scored, and for a limit below 1.
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
            folder = save_renders / folder_of(path).relative_to(data).parent
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
    """The rows of a table of what score_folder returned: the source views, each angle, all novel views."""
    angles = [(f"{row['angle_deg']} deg", row) for row in report["bins"]]
    return [("source", report["source"]), *angles, ("all", report)]


def save_comparison(comparison: Comparison, path: Path, columns: int = 9) -> None:
    """Write a picture: truth above render, views by azimuth; the source image first. At most `columns` views."""
    order = np.argsort(comparison.azimuths_deg, kind="stable")
    order = order[order != comparison.source]
    picked = order[np.linspace(0, len(order) - 1, min(columns, len(order))).round().astype(int)]
    source = comparison.truth[comparison.source]
    rows = [torch.cat([source, *images[picked]], 2) for images in (comparison.truth, comparison.rendered)]
    make_folder(path.parent)
    write_image(path, (torch.cat(rows, dim=1).permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy())
