"""Scores of a network on objects it has not seen: from one view of each, how well are the others predicted?

Protocol: the source is view 0, cropped to the object from the stored image; the other views are rendered into their
full frames at size_px on white, clamped to 0..1, and compared with the stored images averaged down to that size. PSNR
and SSIM are means over images. Beside them stands "copy": the source image itself offered as every other view.
"""
from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from lightfield_gs.errors import InputError
from lightfield_gs.models import SplatterNet
from lightfield_gs.models.crop import crop_resize, object_square
from training.data.images import read_view
from training.data.objects import find_objects, read_object
from training.data.plan import relative_cameras
from training.data.views import ObjectViews
from training.metrics import psnr_db, ssim
from training.rendering import render_views

SIZE_PX = 128
BIN_DEG = 5
_METRICS = ("psnr_db", "ssim", "copy_psnr_db", "copy_ssim")


@dataclass
class Comparison:
    """One object with V novel views: their azimuths from the source in degrees [V], truth and rendered [V,3,H,W], and
    the source image [3,H,W], all on white, 0..1."""
    name: str
    azimuths_deg: np.ndarray
    truth: Tensor
    rendered: Tensor
    source: Tensor


def azimuths_from_source(camera_to_world: np.ndarray, source: int = 0) -> np.ndarray:
    """Azimuth [V] of each view about the vertical axis, relative to the source, in degrees within -180..180.

    The vertical axis is the one at right angles to the x axes of all cameras, since upright cameras keep theirs level.
    Raises InputError when there is none (cameras that roll): such views have no azimuth.
    """
    _, spread, axes = np.linalg.svd(camera_to_world[:, :3, 0])
    if spread[-1] > 0.02 * spread[0]:
        raise InputError("the cameras roll: expected upright cameras (level x axes) to measure azimuths")
    up = axes[-1] * np.sign(-axes[-1] @ camera_to_world[source, :3, 1])
    forward = camera_to_world[:, :3, 2] - np.outer(camera_to_world[:, :3, 2] @ up, up)
    right = np.cross(forward[source], up)
    ahead = forward[source] / np.linalg.norm(forward[source])
    return np.degrees(np.arctan2(forward @ right / np.linalg.norm(right), forward @ ahead))


def _frames(views: ObjectViews) -> Tensor:
    """All views of an object as premultiplied RGBA, uint8 [V,4,H,W]."""
    frames = np.stack([read_view(views, index) for index in range(len(views.image_paths))])
    return torch.from_numpy(frames).permute(0, 3, 1, 2)


def _on_white(frames: Tensor, height: int, width: int) -> Tensor:
    """Premultiplied RGBA [V,4,H,W] averaged down to height x width on white: [V,3,height,width]."""
    small = F.interpolate(frames, size=(height, width), mode="area")
    return small[:, :3] + 1 - small[:, 3:]


@torch.no_grad()
def compare_object(net: SplatterNet, path: Path, size_px: int = SIZE_PX, source: int = 0,
                   device: torch.device | str = "cpu", decoded: dict[Path, Tensor] | None = None) -> Comparison:
    """Predict an object from one view and render the others.

    path: as find_objects names it. size_px: length of the longer side of the frames. device: where the network is; the
    tensors returned are there. decoded: see score_folder.
    """
    views, decoded = read_object(path), {} if decoded is None else decoded
    if path not in decoded:
        decoded[path] = _frames(views).to(device)
    frames = decoded[path] / 255
    scale = size_px / max(views.width_px, views.height_px)
    width, height = round(views.width_px * scale), round(views.height_px * scale)
    square = object_square(frames[source, 3])
    fx, fy, cx, cy = views.intrinsics[source].tolist()
    net_size = net.config.image_size_px
    source_intrinsics = torch.tensor([square.intrinsics((fx, fy), (cx, cy), net_size)], device=device)
    gaussians = net(crop_resize(frames[source], square, net_size)[None], source_intrinsics)
    others = [index for index in range(len(frames)) if index != source]
    cameras = relative_cameras(views.camera_to_world[others], views.camera_to_world[source])
    cameras = torch.from_numpy(cameras).float().to(device)
    intrinsics = torch.from_numpy(views.intrinsics[others] * scale).float().to(device)
    white = torch.ones(1, len(others), 3, device=device)
    images, _ = render_views(gaussians, cameras[None], intrinsics[None], width, height, white)
    truth = _on_white(frames, height, width)
    azimuths = azimuths_from_source(views.camera_to_world, source)[others]
    return Comparison(views.name, azimuths, truth[others], images[0].clamp(0, 1), truth[source])


def _scores(comparison: Comparison) -> Iterator[tuple[int, dict[str, float]]]:
    """Angle bin and metrics of each novel view."""
    copies = comparison.source.expand_as(comparison.truth)
    rendered, truth = comparison.rendered, comparison.truth
    columns = {"psnr_db": psnr_db(rendered, truth), "ssim": ssim(rendered, truth),
               "copy_psnr_db": psnr_db(copies, truth), "copy_ssim": ssim(copies, truth)}
    columns = {name: values.tolist() for name, values in columns.items()}
    for index, azimuth in enumerate(comparison.azimuths_deg):
        yield round(abs(azimuth) / BIN_DEG) * BIN_DEG, {name: values[index] for name, values in columns.items()}


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.mean([row[name] for row in rows])) for name in _METRICS}


def score_folder(net: SplatterNet, data: Path, *, limit: int | None = None, save_renders: Path | None = None,
                 split: str = "val", device: torch.device | str = "cpu",
                 decoded: dict[Path, Tensor] | None = None) -> dict[str, Any]:
    """Score a network on every object (the first `limit`) at or below a folder, on this split where it comes in splits.

    Returns psnr_db, ssim, copy_psnr_db, copy_ssim over all novel views, objects, views, and bins: the same four and the
    number of views for each angle_deg (azimuth to either side, rounded to 5 degrees). save_renders: folder for one
    picture per object. device: where the network is. decoded: keeps the images from call to call, for those who
    score the same objects again. Raises InputError for data that cannot be used.
    """
    bins: dict[int, list[dict[str, float]]] = defaultdict(list)
    objects = find_objects(data, split)[:limit]
    for path in tqdm(objects, desc=f"scoring {data}", unit="object", leave=False):
        comparison = compare_object(net, path, device=device, decoded=decoded)
        for angle, row in _scores(comparison):
            bins[angle].append(row)
        if save_renders is not None:
            save_comparison(comparison, save_renders / f"{comparison.name}.png")
    everything = [row for rows in bins.values() for row in rows]
    return _means(everything) | {
        "objects": len(objects), "views": len(everything),
        "bins": [{"angle_deg": angle, "views": len(bins[angle])} | _means(bins[angle]) for angle in sorted(bins)]}


def save_comparison(comparison: Comparison, path: Path, columns: int = 9) -> None:
    """Write a picture: truth above render, views by azimuth; the source image first. At most `columns` views."""
    from lightfield_gs.io.images import write_image
    order = np.argsort(comparison.azimuths_deg, kind="stable")
    picked = order[np.linspace(0, len(order) - 1, min(columns, len(order))).round().astype(int)]
    rows = [torch.cat([comparison.source, *images[picked]], 2) for images in (comparison.truth, comparison.rendered)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, (torch.cat(rows, dim=1).permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy())
