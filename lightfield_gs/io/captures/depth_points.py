"""Points of a capture by the depth maps that phones measure: where a fit begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.photograph import PosedPhotograph
from lightfield_gs.io.captures.point_files import no_points
from lightfield_gs.io.images import as_floats, read_image

_MOST_MAPS, _POINTS = 60, 1500  # of a capture, and of a map
_CONFIDENT = 0.99  # of the highest confidence; apps store low, medium and high


@dataclass(frozen=True)
class DepthFile:
    """A depth map of a photograph, of any size: distances along the camera's axis.

    Attributes:
        path: an image.
        unit: of its numbers, in units of the poses.
        confidence: an image, white where the depth is sure; None: all counts.
    """

    path: Path
    unit: float
    confidence: Path | None = None


def depth_points(
    photographs: Sequence[PosedPhotograph], files: Mapping[str, DepthFile]
) -> tuple[np.ndarray, np.ndarray]:
    """Return points [P,3] float64 and colours [P,3] uint8 that depth maps show, with a note; none without maps.

    Args:
        photographs: the posed photographs. Distorted ones give no points.
        files: depth maps by the photographs' names.
    """
    mapped = [photograph for photograph in photographs if photograph.name in files and photograph.distortion is None]
    chosen = mapped[:: max(1, -(-len(mapped) // _MOST_MAPS))]
    random, found = np.random.default_rng(0), []
    for photograph in chosen:
        try:
            found.append(_points_of(photograph, files[photograph.name], random))
        except InputError as error:
            assume(f"a depth map is not used: {error}")
    if not found or not sum(len(points) for points, _ in found):
        return no_points()
    points, colours = (np.concatenate(parts) for parts in zip(*found))
    assume(f"the fit begins at {len(points)} points by {len(found)} of {len(mapped)} depth maps of the photographs")
    return points, colours


def _points_of(
    photograph: PosedPhotograph, file: DepthFile, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return random points of one depth map, and their colours. Raises InputError."""
    depth = read_image(file.path, as_stored=True, turn=False)[..., 0].astype(np.float64) * file.unit
    height, width = depth.shape
    good = np.isfinite(depth) & (depth > 0)
    if file.confidence is not None:
        sure = as_floats(read_image(file.confidence, as_stored=True, turn=False))[..., 0]
        if sure.shape == depth.shape:
            good &= sure >= _CONFIDENT
    rows, columns = np.nonzero(good)
    picked = random.permutation(len(rows))[:_POINTS]
    rows, columns = rows[picked], columns[picked]
    x, y = (columns + 0.5) / width, (rows + 0.5) / height  # 0..1 of the picture
    places = np.stack([x * photograph.camera_px[0], y * photograph.camera_px[1]], 1)
    points = unproject(places, depth[rows, columns], photograph.intrinsics, photograph.world_to_camera)
    pixels = as_floats(read_image(photograph.path, as_stored=True, turn=False))
    colours = pixels[(y * pixels.shape[0]).astype(int), (x * pixels.shape[1]).astype(int), :3]
    colours = np.broadcast_to(colours[:, :1], (len(colours), 3)) if colours.shape[1] < 3 else colours
    return points, np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)


def unproject(
    places_px: np.ndarray, depths: np.ndarray, intrinsics: np.ndarray, world_to_camera: np.ndarray
) -> np.ndarray:
    """Return the points [P,3] that a pinhole shows at places of its image.

    Args:
        places_px: [P,2], x and y in pixels, from the outer corner of the first.
        depths: [P], distances along the camera's axis.
        intrinsics: [4], (fx, fy, cx, cy) in pixels.
        world_to_camera: [4,4], OpenCV axes.
    """
    slopes = (places_px - intrinsics[2:]) / intrinsics[:2]
    seen = depths[:, None] * np.column_stack([slopes, np.ones(len(slopes))])
    return (seen - world_to_camera[:3, 3]) @ world_to_camera[:3, :3]
