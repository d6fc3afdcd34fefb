"""Float64 oracle: the colour of any chosen sample by brute force, in plain PyTorch.

One Gaussian, one sample, one formula at a time, as the published equations print them; no tiles, no fits, no fixed-point
phases. It shares nothing with the native rasterizer, so that each can be judged by the other, and autograd through
it is the truth for gradients. Sources: Kerbl et al., "3D Gaussian Splatting", 2023 (blending and its thresholds);
Zwicker et al., "EWA Splatting", 2002 (projected covariance); van Berkel, "Image preparation for 3D-LCD", 1999 (lens phase).

Speed: 20,000 random sub-pixels of 262,144 Gaussians take less than ten seconds on two cores, in some 500 MB.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from lightfield_gs.cameras import Cameras
    from lightfield_gs.gaussians import Gaussians
    from lightfield_gs.panel import Panel
    from lightfield_gs.rig import Rig

NEAR = 0.01  # view-space depth below which a Gaussian is not drawn, scene units
LOW_PASS_PX2 = 0.3  # added to both variances of the projected Gaussian
ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
TRANSMITTANCE_MIN = 1e-4
CLAMP_MARGIN = 0.15  # the Jacobian is clamped this share of the image beyond each of its edges
NEARLY = 0.9  # Gaussians with alpha above NEARLY * ALPHA_MIN are looked at, so that margins below it are known
SAMPLES_PER_CHUNK = 16384


@dataclass(frozen=True)
class Scene:
    """Float64 tensors of one set of Gaussians: means [N,3], quaternions [N,4] (wxyz), scales [N,3], opacities [N], sh [N,K,3]."""

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    @staticmethod
    def of(gaussians: Gaussians) -> Scene:
        fields = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.sh)
        return Scene(*(field.detach().to("cpu", torch.float64) for field in fields))


@dataclass(frozen=True)
class Eye:
    """A camera that may also look from a distance `offset` to its right, its principal point then moved by `shift_px` * offset.

    limits: (lo_x, hi_x, lo_y, hi_y) of X/Z and Y/Z as seen from the centre camera, which stands `to_centre` to the left of this one.
    """

    world_to_camera: Tensor  # [4,4]
    intrinsics: Tensor  # fx, fy, cx, cy in pixels
    limits: Tensor
    to_centre: Tensor | float = 0.0
    shift_px: float = 0.0  # pixels per scene unit


@dataclass(frozen=True)
class Samples:
    """Places in the image, in pixels (centres at +0.5), and view offsets, in scene units: each [M] float64, sorted by row."""

    columns: Tensor
    rows: Tensor
    offsets: Tensor

    def part(self, begin: int, end: int) -> Samples:
        return Samples(self.columns[begin:end], self.rows[begin:end], self.offsets[begin:end])


@dataclass(frozen=True)
class Blend:
    """Front-to-back weights of M samples as P pairs: sample [P], gaussian [P], weight [P]; transmittance left [M], margin [M]."""

    sample: Tensor
    gaussian: Tensor
    weight: Tensor
    transmittance: Tensor
    margin: Tensor

    def sum(self, values: Tensor) -> Tensor:
        """Weighted sum over each sample's Gaussians of values [P] or [P,C] -> [M] or [M,C]."""
        weight = self.weight.reshape(-1, *[1] * (values.dim() - 1))
        total = values.new_zeros(len(self.transmittance), *values.shape[1:])
        return total.index_add(0, self.sample, weight * values)


# ---- one Gaussian ----------------------------------------------------------------------------------------------------

def rotations(quaternions: Tensor) -> Tensor:
    """Rotation matrices [N,3,3] of quaternions [N,4] (wxyz, any length but zero)."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return torch.stack(rows, -1).reshape(*quaternions.shape[:-1], 3, 3)


def harmonics(directions: Tensor, count: int) -> Tensor:
    """The first `count` (1, 4, 9 or 16) real spherical harmonics [P,K] of unit directions [P,3], with the signs of 3DGS."""
    x, y, z = directions.unbind(-1)
    k0, k1, k20, k21, k22, k30, k31, k32, k33 = (
        np.sqrt(value / np.pi) / 4 for value in (4, 12, 5, 60, 15, 7, 21 / 2, 105, 35 / 2))
    basis = [torch.full_like(x, k0)]
    if count > 1:
        basis += [-k1 * y, k1 * z, -k1 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis += [k21 * x * y, -k21 * y * z, k20 * (2 * zz - xx - yy), -k21 * x * z, k22 * (xx - yy)]
    if count > 9:
        basis += [-k33 * y * (3 * xx - yy), 2 * k32 * x * y * z, -k31 * y * (4 * zz - xx - yy),
                  k30 * z * (2 * zz - 3 * xx - 3 * yy), -k31 * x * (4 * zz - xx - yy), k32 * z * (xx - yy),
                  -k33 * x * (xx - 3 * yy)]
    return torch.stack(basis, -1)


class Projection:
    """One scene before one eye: view-space means and covariances of the Gaussians it may draw, near ones first."""

    def __init__(self, scene: Scene, eye: Eye):
        self.scene, self.eye = scene, eye
        self.axes, self.translation = eye.world_to_camera[:3, :3], eye.world_to_camera[:3, 3]
        self.position = scene.means @ self.axes.T + self.translation
        spread = self.axes @ rotations(scene.quaternions) * scene.scales[:, None, :]
        self.covariance = spread @ spread.transpose(1, 2)
        depth = self.position[:, 2].detach()
        drawn = torch.nonzero((depth >= NEAR) & (scene.opacities.detach() * 255 >= 1)).flatten()
        self.order = drawn[torch.sort(depth[drawn], stable=True).indices]

    def footprint(self, gaussian: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
        """Projected mean u, v (px) and covariance xx, xy, yy (px^2) of Gaussians seen from an offset: EWA, first order."""
        fx, fy, cx, cy = self.eye.intrinsics.unbind()
        low_x, high_x, low_y, high_y = self.eye.limits.unbind()
        X, Y, Z = self.position[gaussian].unbind(-1)
        V = self.covariance[gaussian]

        # The Jacobian is taken at a point within the limits, the mean is projected from where it is.
        from_centre = self.eye.to_centre
        tx = Z * ((X + from_centre) / Z).clamp(low_x, high_x) - from_centre - offset
        ty = Z * (Y / Z).clamp(low_y, high_y)
        a, b, c, e = fx / Z, -fx * tx / Z**2, fy / Z, -fy * ty / Z**2
        xx = a * a * V[..., 0, 0] + 2 * a * b * V[..., 0, 2] + b * b * V[..., 2, 2] + LOW_PASS_PX2
        xy = a * c * V[..., 0, 1] + a * e * V[..., 0, 2] + b * c * V[..., 1, 2] + b * e * V[..., 2, 2]
        yy = c * c * V[..., 1, 1] + 2 * c * e * V[..., 1, 2] + e * e * V[..., 2, 2] + LOW_PASS_PX2
        u = fx * (X - offset) / Z + cx + self.eye.shift_px * offset
        v = fy * Y / Z + cy
        return u, v, xx, xy, yy

    def alpha(self, gaussian: Tensor, samples: Samples) -> Tensor:
        """Opacity of Gaussians at samples (broadcast against each other), before the cut at 1/255."""
        u, v, xx, xy, yy = self.footprint(gaussian, samples.offsets)
        dx, dy = samples.columns - u, samples.rows - v
        q = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
        return (self.scene.opacities[gaussian] * torch.exp(-q / 2)).clamp(max=ALPHA_MAX)

    def colour(self, gaussian: Tensor, offset: Tensor, channel: Tensor | None = None) -> Tensor:
        """Colour [P,3] of Gaussians seen from offsets, or [P] of one channel each."""
        centre = -self.axes.T @ self.translation + offset[:, None] * self.axes[0]
        direction = self.scene.means[gaussian] - centre
        basis = harmonics(direction / direction.norm(dim=-1, keepdim=True), self.scene.sh.shape[1])
        if channel is None:
            return (0.5 + (basis[:, :, None] * self.scene.sh[gaussian]).sum(1)).clamp(min=0)
        return (0.5 + (basis * self.scene.sh[gaussian, :, channel]).sum(1)).clamp(min=0)

    @torch.no_grad()
    def pairs(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Pairs (sample [P], Gaussian [P]) whose alpha reaches or nearly reaches the cut: by sample, then near to far."""
        zero = samples.offsets.new_zeros(())
        _, v, _, _, yy = self.footprint(self.order, zero)
        reach = (2 * yy * (self.scene.opacities[self.order] / (NEARLY * ALPHA_MIN)).log()).sqrt()
        rows, counts = torch.unique_consecutive(samples.rows, return_counts=True)
        begin, found = 0, []
        for row, count in zip(rows, counts.tolist()):
            near_row = self.order[(row - v).abs() <= reach]
            here = samples.part(begin, begin + count)
            column = Samples(here.columns[:, None], row, here.offsets[:, None])
            hit = torch.nonzero(self.alpha(near_row, column) > NEARLY * ALPHA_MIN)
            found.append((hit[:, 0] + begin, near_row[hit[:, 1]]))
            begin += count
        return tuple(torch.cat(part) for part in zip(*found))

    def blend(self, samples: Samples) -> Blend:
        """Front-to-back blending; a sample stops before its transmittance would fall below 1e-4 (Kerbl et al., section 6)."""
        sample, gaussian = self.pairs(samples)
        count = torch.bincount(sample, minlength=len(samples.rows))
        rank = torch.arange(len(sample)) - (count.cumsum(0) - count)[sample]
        full = self.alpha(gaussian, Samples(samples.columns[sample], samples.rows[sample], samples.offsets[sample]))
        shape = (len(samples.rows), max(1, int(count.max())))

        # Every sample a row of the table, its Gaussians from near to far; what is missing is transparent.
        table = full.new_zeros(shape).index_put((sample, rank), full)
        drawn = table.detach() >= ALPHA_MIN
        table = torch.where(drawn, table, 0.0)
        after = torch.cumprod(1 - table, 1)
        kept = after.detach() >= TRANSMITTANCE_MIN
        before = torch.cat([after.new_ones(shape[0], 1), after[:, :-1]], 1)
        weight = torch.where(kept, before * table, 0.0)[sample, rank]
        left = torch.where(kept, 1 - table, 1.0).prod(1)

        # Decisions are made up to and including the Gaussian that stops the sample.
        alive = before.detach() >= TRANSMITTANCE_MIN
        cut = (full.new_zeros(shape).index_put((sample, rank), full.detach()) * 255 - 1).abs()
        stop = torch.where(drawn, (after.detach() / TRANSMITTANCE_MIN - 1).abs(), torch.inf)
        margin = torch.where(alive, torch.minimum(cut, stop), torch.inf).amin(1).clamp(max=1 - NEARLY)
        return Blend(sample, gaussian, weight, left, margin)


# ---- many samples ----------------------------------------------------------------------------------------------------

def _chunks(projection: Projection, samples: Samples) -> Iterator[tuple[slice, Samples, Blend]]:
    """Blend samples (sorted by row) a chunk at a time."""
    for begin in range(0, len(samples.rows), SAMPLES_PER_CHUNK):
        span = slice(begin, min(begin + SAMPLES_PER_CHUNK, len(samples.rows)))
        chunk = samples.part(span.start, span.stop)
        yield span, chunk, projection.blend(chunk)


def _colours(projection: Projection, columns: Tensor, rows: Tensor, offsets: Tensor, channels: Tensor,
             background: Tensor) -> tuple[Tensor, Tensor]:
    """Colours [M] and margins [M] of samples in any order, each of one channel."""
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


# ---- sensors ---------------------------------------------------------------------------------------------------------

def lens_views(panel: Panel, rows: Sequence[int], columns: Sequence[int], channels: Sequence[int],
               continuous: bool = False) -> np.ndarray:
    """View x in [0,N) under which sub-pixels are seen, float64 [M]: exact in fractions, n + 1/2 (n whole) unless continuous."""
    pitch, slant, phase = (Fraction(float(value)) for value in (panel.line_number, panel.slant_tan, panel.phase))
    # Lens coordinate (D_0 + 3 j + k + 3 i tan) / P_e over one denominator, then whole numbers of any length.
    steps = (phase / pitch, 1 / pitch, 3 * slant / pitch)
    unit = math.lcm(*(step.denominator for step in steps))
    start, across, down = (int(step * unit) for step in steps)
    found = np.empty(len(rows))
    for index, (row, column, channel) in enumerate(zip(rows, columns, channels)):
        place = int(channel) if panel.subpixel_order == "RGB" else 2 - int(channel)
        x = (start + across * (3 * int(column) + place) + down * int(row)) % unit * panel.views
        found[index] = x / unit if continuous else x // unit + 0.5
    return found


def _rig_cone_rad(panel: Panel, rig: Rig) -> float:
    return float(np.radians(panel.cone_deg if rig.cone_deg is None else rig.cone_deg))


def lens_offsets(panel: Panel, rig: Rig, x: np.ndarray) -> np.ndarray:
    """Offset to the right of the centre camera, scene units, of views x."""
    width = 2 * rig.zero_depth * np.tan(_rig_cone_rad(panel, rig) / 2)
    return (-1 if panel.invert_views else 1) * width * (0.5 - np.asarray(x) / panel.views)


def rig_eye(panel: Panel, rig: Rig) -> Eye:
    """The centre camera of a rig; its Jacobian limits cover the frusta of all views, seen from the centre."""
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    limits = frustum_limits(fx, fy, cx, cy, panel.width_px, panel.height_px)
    widest = np.tan(_rig_cone_rad(panel, rig) / 2)  # largest |offset| / zero_depth
    limits += limits.new_tensor([-widest, widest, 0, 0])
    pose = torch.as_tensor(np.asarray(rig.world_to_camera), dtype=torch.float64)
    return Eye(pose, limits.new_tensor([fx, fy, cx, cy]), limits, shift_px=fx / rig.zero_depth)


def frustum_limits(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> Tensor:
    """(lo_x, hi_x, lo_y, hi_y) of X/Z and Y/Z: the frustum and 30 % of its half width and half height on every side."""
    x, y = CLAMP_MARGIN * width, CLAMP_MARGIN * height
    return torch.tensor([(-cx - x) / fx, (width - cx + x) / fx, (-cy - y) / fy, (height - cy + y) / fy], dtype=torch.float64)


def subpixel_colours(gaussians: Gaussians, panel: Panel, rig: Rig, rows: np.ndarray, columns: np.ndarray,
                     channels: np.ndarray, *, continuous: bool = False, background: Sequence[float] = (1, 1, 1),
                     return_margin: bool = False) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
    """Colours that chosen sub-pixels of a light-field image must have, float64 [M].

    rows, columns: 0-based pixels [M]; channels: image channels [M], 0 red to 2 blue. continuous: fractional views.
    With return_margin also [M]: how near, relatively, a decision about the sample came to its threshold (alpha = 1/255 or
    transmittance = 1e-4), at most 0.1; below some 1e-4 a float32 program may rightly decide otherwise.
    """
    offsets = lens_offsets(panel, rig, lens_views(panel, rows, columns, channels, continuous))
    projection = Projection(Scene.of(gaussians), rig_eye(panel, rig))
    colours, margins = _colours(projection, _centres(columns), _centres(rows), torch.from_numpy(offsets),
                                torch.as_tensor(channels, dtype=torch.int64), _float64(background))
    return (colours.numpy(), margins.numpy()) if return_margin else colours.numpy()


def lens_torch(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, background: Tensor,
               panel: Panel, rig: Rig, *, continuous: bool = False) -> Tensor:
    """The whole light-field image [H,W,3] of one small scene, differentiable in every tensor (float64, no batch)."""
    rows, columns, channels = (index.ravel() for index in np.indices((panel.height_px, panel.width_px, 3)))
    offsets = lens_offsets(panel, rig, lens_views(panel, rows, columns, channels, continuous))
    projection = Projection(Scene(means, quaternions, scales, opacities, sh), rig_eye(panel, rig))
    colours, _ = _colours(projection, _centres(columns), _centres(rows), torch.from_numpy(offsets),
                          torch.from_numpy(channels), background)
    return colours.reshape(panel.height_px, panel.width_px, 3)


def pixel_colours(gaussians: Gaussians, cameras: Cameras, camera: int, rows: np.ndarray, columns: np.ndarray,
                  channels: np.ndarray, *, background: Sequence[float] = (1, 1, 1),
                  return_margin: bool = False) -> np.ndarray | tuple[np.ndarray, np.ndarray]:
    """Colours of chosen pixels and channels of one ordinary camera, float64 [M]; arguments and margin as `subpixel_colours`."""
    projection = Projection(Scene.of(gaussians), _camera_eye(cameras, camera))
    colours, margins = _colours(projection, _centres(columns), _centres(rows), torch.zeros(len(rows), dtype=torch.float64),
                                torch.as_tensor(channels, dtype=torch.int64), _float64(background))
    return (colours.numpy(), margins.numpy()) if return_margin else colours.numpy()


def dense_torch(means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor, background: Tensor,
                world_to_camera: Tensor, intrinsics: Tensor, limits: Tensor, width: int,
                height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Images [B,V,H,W,3], alpha and depth [B,V,H,W] of B small scenes before V cameras each, differentiable, float64.

    means [B,N,3], quaternions [B,N,4], scales [B,N,3], opacities [B,N], sh [B,N,K,3], background [B,V,3], world_to_camera
    [B,V,4,4], intrinsics [B,V,4] (fx, fy, cx, cy), limits [B,V,5] (lo_x, hi_x, lo_y, hi_y, offset from the centre of a rig).
    """
    scenes = [Scene(*fields) for fields in zip(means, quaternions, scales, opacities, sh)]
    images = [_dense_image(Projection(scene, Eye(pose, camera, limit[:4], limit[4])), colour, width, height)
              for scene, *views in zip(scenes, world_to_camera, intrinsics, limits, background)
              for pose, camera, limit, colour in zip(*views)]
    batch = world_to_camera.shape[:2]
    return tuple(torch.stack(part).reshape(*batch, *part[0].shape) for part in zip(*images))


def _dense_image(projection: Projection, background: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    rows, columns = (index.ravel() for index in np.indices((height, width)))
    samples = Samples(_centres(columns), _centres(rows), torch.zeros(width * height, dtype=torch.float64))
    image, alpha, depth = [], [], []
    for _, chunk, blend in _chunks(projection, samples):
        colour = projection.colour(blend.gaussian, chunk.offsets[blend.sample])
        image.append(blend.sum(colour) + blend.transmittance[:, None] * background)
        alpha.append(1 - blend.transmittance)
        depth.append(blend.sum(projection.position[blend.gaussian, 2]))
    return (torch.cat(image).reshape(height, width, 3), torch.cat(alpha).reshape(height, width),
            torch.cat(depth).reshape(height, width))


def _camera_eye(cameras: Cameras, camera: int) -> Eye:
    intrinsics = torch.cat([cameras.focal_px[camera], cameras.principal_point_px[camera]]).to("cpu", torch.float64)
    pose = cameras.world_to_camera[camera].to("cpu", torch.float64)
    if cameras.jacobian_limits is None:
        return Eye(pose, intrinsics, frustum_limits(*intrinsics.tolist(), cameras.width_px, cameras.height_px))
    limits = cameras.jacobian_limits[camera].to("cpu", torch.float64)
    return Eye(pose, intrinsics, limits[:4], limits[4])


def _centres(index: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(index), dtype=torch.float64) + 0.5


def _float64(values: Sequence[float]) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)
