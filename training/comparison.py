"""Compare the prediction of an object from one view with the object, in all its views.

The protocol is described in training/evaluation.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs import Gaussians
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.captures.objects import ObjectImages
from lightfield_gs.io.images import write_image
from lightfield_gs.models import SplatterNet
from lightfield_gs.models.crop import crop_resize, object_square
from lightfield_gs.models.detail import DetailLevel
from training.data.background import Choice
from training.data.distance import OBJECT_DISTANCE, distance_doubt
from training.data.images import find_cutout, read_view
from training.data.objects import read_object
from training.data.plan import relative_cameras
from training.rendering import render_card, render_views

SIZE_PX = 128  # of the scores that the model card has
Source = int | Literal["middle"]


@dataclass
class Comparison:
    """One object with V views, the source being one of them.

    Attributes:
        source: Number of the source.
        doubt: Set where the cameras stand elsewhere than the network expects.
        azimuths_deg: [V], from the source.
        truth, rendered, card: [V,3,H,W] on white, 0..1.
        truth_alpha, rendered_alpha: [V,H,W], 0..1.
    """

    name: str
    source: int
    doubt: str | None
    azimuths_deg: np.ndarray
    truth: Tensor
    rendered: Tensor
    card: Tensor
    truth_alpha: Tensor
    rendered_alpha: Tensor


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
    """Return the number of the source view of an object with camera-to-world matrices [V,4,4].

    Args:
        source: the number, or "middle" for the view whose direction is nearest to the mean of all.

    Raises:
        InputError: there is no such view. The message begins with the object's path.
    """
    if source == "middle":
        directions = camera_to_world[:, :3, 2]
        return int((directions @ directions.mean(0)).round(9).argmax())
    if not 0 <= source < len(camera_to_world):
        raise InputError(f"{path}: expected a source view of 0..{len(camera_to_world) - 1}, got {source}")
    return source


def _frames(views: ObjectImages, background: Choice) -> Tensor:
    """All views of an object as premultiplied RGBA, uint8 [V,4,H,W]."""
    cutout = find_cutout(views, background)
    frames = np.stack([read_view(views, index, cutout) for index in range(len(views.image_paths))])
    return torch.from_numpy(frames).permute(0, 3, 1, 2)


def _on_white(frames: Tensor) -> Tensor:
    """Premultiplied RGBA [V,4,H,W] on white: [V,3,H,W]."""
    return frames[:, :3] + 1 - frames[:, 3:]


def _predicted(
    net: SplatterNet, frame: Tensor, intrinsics: list[float], detail: int | None, magnified: float
) -> Gaussians:
    """Predict the Gaussians of the object in a frame [4,H,W], premultiplied, in its camera's axes; with a leading 1.

    The network sees the object as in a photo: the square round it from the stored frame, resized to the network's own
    size.

    Args:
        intrinsics: (fx, fy, cx, cy) of the frame in pixels.
        detail: how many times finer the sheet of the frame is (see models/detail.py); None: no sheet.
        magnified: width of one of the frame's pixels where the Gaussians are drawn.
    """
    square, size = object_square(frame[3]), net.config.image_size_px
    fx, fy, cx, cy = intrinsics
    seen_by = torch.tensor([square.intrinsics((fx, fy), (cx, cy), size)], device=frame.device)
    cropped = crop_resize(frame, square, size)[None]
    if detail is None:
        return net(cropped, seen_by)
    fine = crop_resize(frame, square, detail * size)[None]
    level = DetailLevel(detail, magnified * square.side / (detail * size))
    return net(cropped, seen_by, fine, level)


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
    detail: int | None = None,
) -> Comparison:
    """Predict an object from one view and render it from all.

    Args:
        path: Name of the object as in find_objects.
        size_px: Length of the longer side of the frames.
        source: see source_view.
        device: where the network is; the tensors returned are there.
        decoded, supersampling, background, detail: see score_folder.

    Raises:
        InputError: the object cannot be read, has one view only, no such source, or cameras that roll. Or size_px is
            beyond SIZE_PX, and the object is stored smaller.
    """
    views, decoded = read_object(path), {} if decoded is None else decoded
    if len(views.image_paths) < 2:
        raise InputError(f"{path}: expected at least two views, one to predict the others from, got one")
    stored = max(views.width_px, views.height_px)
    if SIZE_PX < size_px > stored:
        raise InputError(
            f"{path}: expected pictures of at least {size_px} px on the longer side, got {stored}: magnified ones say "
            f"nothing of sharpness; take a --size of {max(stored, SIZE_PX)} or less"
        )
    source = source_view(path, views.camera_to_world, source)
    with named(path):
        azimuths = azimuths_from_source(views.camera_to_world, source)
    if path not in decoded:
        decoded[path] = _frames(views, background).to(device)
    frames = decoded[path] / 255
    scale = size_px / stored
    width, height = round(views.width_px * scale), round(views.height_px * scale)
    gaussians = _predicted(net, frames[source], views.intrinsics[source].tolist(), detail, supersampling * scale)
    cameras = relative_cameras(views.camera_to_world, views.camera_to_world[source])
    cameras = torch.from_numpy(cameras).float().to(device)
    intrinsics = torch.from_numpy(views.intrinsics * scale).float().to(device)
    white = torch.ones(1, len(frames), 3, device=device)
    images, alphas = render_views(
        gaussians, cameras[None], supersampling * intrinsics[None], supersampling * width, supersampling * height, white
    )
    images = F.interpolate(images[0].clamp(0, 1), size=(height, width), mode="area")
    alphas = F.interpolate(alphas[0][:, None], size=(height, width), mode="area")[:, 0]
    truth = F.interpolate(frames, size=(height, width), mode="area")
    card = render_card(truth[source], intrinsics[source], OBJECT_DISTANCE, cameras, intrinsics)
    return Comparison(
        views.name,
        source,
        distance_doubt(views.camera_to_world),
        azimuths,
        _on_white(truth),
        images,
        _on_white(card),
        truth[:, 3],
        alphas,
    )


def save_comparison(comparison: Comparison, path: Path, columns: int = 9) -> None:
    """Write a picture: truth above render, views by azimuth; the source image first. At most `columns` views."""
    order = np.argsort(comparison.azimuths_deg, kind="stable")
    order = order[order != comparison.source]
    picked = order[np.linspace(0, len(order) - 1, min(columns, len(order))).round().astype(int)]
    source = comparison.truth[comparison.source]
    rows = [torch.cat([source, *images[picked]], 2) for images in (comparison.truth, comparison.rendered)]
    make_folder(path.parent)
    write_image(path, (torch.cat(rows, dim=1).permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy())
