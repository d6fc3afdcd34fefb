"""The float64 oracle: the colour of any chosen sample by brute force, in plain PyTorch.

No tiles, no fits, no fixed-point phases: it shares nothing with the native rasterizer, so that each can judge the
other. Autograd through it gives the true gradients. Lens phase: van Berkel, "Image preparation for 3D-LCD", 1999; the
rig's offsets: Shi et al., Photonics 2025, 12(3), 279. The arithmetic is in blend.py.

Speed: 20,000 random sub-pixels of 262,144 Gaussians take less than ten seconds on two cores, in some 500 MB. Gaussians
on a GPU are evaluated there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.reference.blend import Blend, Eye, Projection, Samples, Scene

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.cameras import Cameras
    from lightfield_gs.scene.gaussians import Gaussians

CLAMP_MARGIN = 0.15  # the Jacobian is clamped at this fraction of the image beyond each of its edges
SAMPLES_PER_CHUNK = 1024


def _chunks(projection: Projection, samples: Samples) -> Iterator[tuple[slice, Samples, Blend]]:
    """Blend samples (sorted by row) a chunk at a time."""
    for begin in range(0, len(samples.rows), SAMPLES_PER_CHUNK):
        span = slice(begin, min(begin + SAMPLES_PER_CHUNK, len(samples.rows)))
        chunk = samples.part(span.start, span.stop)
        yield span, chunk, projection.blend(chunk)


def _colours(
    projection: Projection, columns: Tensor, rows: Tensor, offsets: Tensor, channels: Tensor, background: Tensor
) -> tuple[Tensor, Tensor]:
    """Return colours [M] and margins [M] of samples in any order, each of one channel."""
    device = projection.scene.means.device
    columns, rows, offsets, channels, background = (
        t.to(device) for t in (columns, rows, offsets, channels, background)
    )
    order = torch.sort(rows, stable=True).indices
    samples, channels = Samples(columns[order], rows[order], offsets[order]), channels[order]
    colours, margins = [], []
    for span, chunk, blend in _chunks(projection, samples):
        channel = channels[span]
        lit = projection.colour(blend.gaussian, chunk.offsets[blend.sample], channel[blend.sample])
        colours.append(blend.sum(lit) + blend.transmittance * background[channel])
        margins.append(blend.margin)
    back = torch.argsort(order)
    return torch.cat(colours)[back], torch.cat(margins)[back]


def lens_views(
    panel: Panel,
    rows: Sequence[int] | np.ndarray,
    columns: Sequence[int] | np.ndarray,
    channels: Sequence[int] | np.ndarray,
    continuous: bool = False,
) -> np.ndarray:
    """Return the view x in [0,N) of sub-pixels, float64 [M]: exact in fractions; n + 1/2 unless continuous."""
    pitch, slant, phase = (Fraction(float(value)) for value in (panel.line_number, panel.slant_tan, panel.phase))
    # Lens coordinate (D_0 + 3 j + k + 3 i tan) / P_e over one denominator, then whole numbers of any length.
    steps = (phase / pitch, 1 / pitch, 3 * slant / pitch)
    places = [_subpixel_offsets(panel, cell, slant) for cell in panel.subpixel_cells or (None,)]
    unit = math.lcm(*(step.denominator for step in (*steps, *(at / pitch for cell in places for at in cell))))
    start, across, down = (int(step * unit) for step in steps)
    beyond = [[int(at / pitch * unit) for at in cell] for cell in places]
    found = np.empty(len(rows))
    for index, (row, column, channel) in enumerate(zip(rows, columns, channels)):
        within = beyond[_cell_number(panel, int(row), int(column))][int(channel)]
        x = (start + across * 3 * int(column) + within + down * int(row)) % unit * panel.views
        found[index] = x / unit if continuous else x // unit + 0.5
    return found


def _subpixel_offsets(panel: Panel, cell: Any, slant: Fraction) -> list[Fraction]:
    """Return the offsets of red, green and blue from the reference of their pixel, in sub-pixels along the row.

    A higher sub-pixel counts as farther left or right by the slant.
    """
    if cell is None:
        return [Fraction(k) for k in ((0, 1, 2) if panel.subpixel_order == "RGB" else (2, 1, 0))]
    return [3 * (Fraction(float(x)) - slant * Fraction(float(y))) for x, y in cell]


def _cell_number(panel: Panel, row: int, column: int) -> int:
    """Return the number of a pixel's cell (Looking Glass: CellPatternMode)."""
    y = row if panel.cell_rows == "top" else panel.height_px - 1 - row
    by_rule = {"unity": (column % 2, y % 2), "webxr": (y % 4, column % 2)}[panel.cell_rule]
    return (0, (column + y) % 2, by_rule[0], (y + column % 2 * 2) % 4, by_rule[1])[panel.cell_pattern]


def _rig_cone_rad(panel: Panel, rig: Rig) -> float:
    return float(np.radians(panel.cone_deg if rig.cone_deg is None else rig.cone_deg))


def lens_offsets(panel: Panel, rig: Rig, x: np.ndarray) -> np.ndarray:
    """Return the offsets of views x to the right of the centre camera, scene units."""
    width = 2 * rig.zero_depth * np.tan(_rig_cone_rad(panel, rig) / 2)
    return (-1 if panel.invert_views else 1) * width * (0.5 - np.asarray(x) / panel.views)


def rig_eye(panel: Panel, rig: Rig, view_filter: float = 0.0) -> Eye:
    """Return the centre camera of a rig; its Jacobian limits cover the frusta of all views, seen from the centre."""
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    limits = frustum_limits(fx, fy, cx, cy, panel.width_px, panel.height_px)
    widest = np.tan(_rig_cone_rad(panel, rig) / 2)  # largest |offset| / zero_depth
    limits += limits.new_tensor([-widest, widest, 0, 0])
    pose = torch.as_tensor(np.asarray(rig.world_to_camera), dtype=torch.float64)
    box = view_filter * 2 * rig.zero_depth * float(widest) / panel.views  # whose standard deviation is width / 12^(1/2)
    intrinsics, shift_px = limits.new_tensor([fx, fy, cx, cy]), fx / rig.zero_depth
    return Eye(pose, intrinsics, limits, shift_px=shift_px, aperture=box / math.sqrt(12))


def frustum_limits(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> Tensor:
    """Return (lo_x, hi_x, lo_y, hi_y) of X/Z and Y/Z: the frustum and 30 % of its half size on every side."""
    x, y = CLAMP_MARGIN * width, CLAMP_MARGIN * height
    limits = [(-cx - x) / fx, (width - cx + x) / fx, (-cy - y) / fy, (height - cy + y) / fy]
    return torch.tensor(limits, dtype=torch.float64)


def subpixel_colours(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    rows: np.ndarray,
    columns: np.ndarray,
    channels: np.ndarray,
    *,
    continuous: bool = False,
    background: Sequence[float] = (1, 1, 1),
    antialiased: bool = False,
    view_filter: float = 0.0,
    return_margin: bool = False,
) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
    """Return the true colours of chosen sub-pixels of a light-field image, float64 [M].

    Args:
        gaussians: One set.
        panel: The panel.
        rig: Its rig.
        rows: 0-based pixels [M].
        columns: 0-based pixels [M].
        channels: Image channels [M], 0 red to 2 blue.
        continuous: Whether views are fractional.
        background: Colour, 0..1.
        antialiased: See lightfield_gs.encode.
        view_filter: See lightfield_gs.encode.
        return_margin: Whether to return margins [M] as well. A margin is the relative distance, at most 0.1, of a
            sample's closest decision from its threshold (alpha = 1/255 or transmittance = 1e-4). Below some 1e-4 a
            float32 program may rightly decide otherwise.
    """
    offsets = lens_offsets(panel, rig, lens_views(panel, rows, columns, channels, continuous))
    projection = Projection(Scene.from_gaussians(gaussians), rig_eye(panel, rig, view_filter), antialiased)
    colours, margins = _colours(
        projection,
        _centres(columns),
        _centres(rows),
        torch.from_numpy(offsets),
        torch.as_tensor(channels, dtype=torch.int64),
        _float64(background),
    )
    return (colours.cpu().numpy(), margins.cpu().numpy()) if return_margin else colours.cpu().numpy()


def lens_torch(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    panel: Panel,
    rig: Rig,
    *,
    continuous: bool = False,
    antialiased: bool = False,
    view_filter: float = 0.0,
) -> Tensor:
    """Return the whole light-field image [H,W,3] of one small scene, differentiable in every tensor (float64)."""
    rows, columns, channels = (index.ravel() for index in np.indices((panel.height_px, panel.width_px, 3)))
    offsets = lens_offsets(panel, rig, lens_views(panel, rows, columns, channels, continuous))
    projection = Projection(
        Scene(means, quaternions, scales, opacities, sh), rig_eye(panel, rig, view_filter), antialiased
    )
    colours, _ = _colours(
        projection, _centres(columns), _centres(rows), torch.from_numpy(offsets), torch.from_numpy(channels), background
    )
    return colours.reshape(panel.height_px, panel.width_px, 3)


def pixel_colours(
    gaussians: Gaussians,
    cameras: Cameras,
    camera: int,
    rows: np.ndarray,
    columns: np.ndarray,
    channels: np.ndarray,
    *,
    background: Sequence[float] = (1, 1, 1),
    antialiased: bool = False,
    return_margin: bool = False,
) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
    """Return the true colours of chosen pixels and channels of one camera, float64 [M]; see subpixel_colours."""
    projection = Projection(Scene.from_gaussians(gaussians), _camera_eye(cameras, camera), antialiased)
    offsets = torch.zeros(len(rows), dtype=torch.float64)
    colours, margins = _colours(
        projection,
        _centres(columns),
        _centres(rows),
        offsets,
        torch.as_tensor(channels, dtype=torch.int64),
        _float64(background),
    )
    return (colours.cpu().numpy(), margins.cpu().numpy()) if return_margin else colours.cpu().numpy()


def dense_torch(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    limits: Tensor,
    width: int,
    height: int,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return images [B,V,H,W,3], alpha and depth [B,V,H,W] of B small scenes before V cameras each.

    Everything is float64 and differentiable.

    Args:
        means: [B,N,3].
        quaternions: [B,N,4].
        scales: [B,N,3].
        opacities: [B,N].
        sh: [B,N,K,3].
        background: [B,V,3].
        world_to_camera: [B,V,4,4].
        intrinsics: [B,V,4] (fx, fy, cx, cy).
        limits: [B,V,5] (lo_x, hi_x, lo_y, hi_y, offset from the centre of a rig).
        width: Pixels.
        height: Pixels.
        antialiased: See lightfield_gs.render.
    """
    scenes = [Scene(*fields) for fields in zip(means, quaternions, scales, opacities, sh)]
    images = [
        _dense_image(Projection(scene, Eye(pose, camera, limit[:4], limit[4]), antialiased), colour, width, height)
        for scene, *views in zip(scenes, world_to_camera, intrinsics, limits, background)
        for pose, camera, limit, colour in zip(*views)
    ]
    batch = world_to_camera.shape[:2]
    image, alpha, depth = (torch.stack(part).reshape(*batch, *part[0].shape) for part in zip(*images))
    return image, alpha, depth


def _dense_image(projection: Projection, background: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    rows, columns = (index.ravel() for index in np.indices((height, width)))
    samples = Samples(_centres(columns), _centres(rows), torch.zeros(width * height, dtype=torch.float64))
    image, alpha, depth = [], [], []
    for _, chunk, blend in _chunks(projection, samples):
        colour = projection.colour(blend.gaussian, chunk.offsets[blend.sample])
        image.append(blend.sum(colour) + blend.transmittance[:, None] * background)
        alpha.append(1 - blend.transmittance)
        depth.append(blend.sum(projection.position[blend.gaussian, 2]))
    return (
        torch.cat(image).reshape(height, width, 3),
        torch.cat(alpha).reshape(height, width),
        torch.cat(depth).reshape(height, width),
    )


def _camera_eye(cameras: Cameras, camera: int) -> Eye:
    intrinsics = cameras.intrinsics()[camera].to("cpu", torch.float64)
    pose = cameras.world_to_camera[camera].to("cpu", torch.float64)
    if cameras.jacobian_limits is None:
        fx, fy, cx, cy = intrinsics.tolist()
        width, height = cast(int, cameras.width_px), cast(int, cameras.height_px)  # no cameras are without a size
        return Eye(pose, intrinsics, frustum_limits(fx, fy, cx, cy, width, height))
    limits = cameras.jacobian_limits[camera].to("cpu", torch.float64)
    return Eye(pose, intrinsics, limits[:4], limits[4])


def _centres(index: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(index), dtype=torch.float64) + 0.5


def _float64(values: Sequence[float]) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)
