"""The float64 oracle's arithmetic: one Gaussian, one sample, one formula at a time, as published equations print them.

Sources: blending and its thresholds from "3D Gaussian Splatting" (Kerbl et al., 2023), the projected covariance from
"EWA Splatting" (Zwicker et al., 2002), opacities of anti-aliased scenes from "Mip-Splatting" (Yu et al., 2024). The
native rasterizer shares no code with this module.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import harmonics, rotations

if TYPE_CHECKING:
    from lightfield_gs.scene.gaussians import Gaussians

NEAR = 0.01  # view-space depth below which a Gaussian is not drawn, scene units
LOW_PASS_PX2 = 0.3  # added to both variances of the projected Gaussian
ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
TRANSMITTANCE_MIN = 1e-4
NEARLY = 0.9  # Gaussians with alpha above NEARLY * ALPHA_MIN are evaluated, so that margins below it are known
ALPHAS_AT_ONCE = {"cpu": 2**13, "cuda": 2**24}  # samples times Gaussians: the cache of a core, enough for a GPU


@dataclass(frozen=True)
class Scene:
    """Float64 tensors of a set: means [N,3], quaternions [N,4] (wxyz), scales [N,3], opacities [N], sh [N,K,3]."""

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    @staticmethod
    def from_gaussians(gaussians: Gaussians) -> Scene:
        fields = (gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.sh)
        return Scene(*(field.detach().to(torch.float64) for field in fields))


@dataclass(frozen=True)
class Eye:
    """A camera that may also look from `offset` to its right, its principal point then moved by shift_px * offset.

    Attributes:
        world_to_camera: [4,4].
        intrinsics: fx, fy, cx, cy in pixels.
        limits: (lo_x, hi_x, lo_y, hi_y) of X/Z and Y/Z as seen from the centre camera.
        to_centre: Distance of the centre camera to the left of this one, scene units.
        shift_px: Pixels per scene unit.
        aperture: Standard deviation of the offsets that each footprint is averaged over, scene units.
    """

    world_to_camera: Tensor  # [4,4]
    intrinsics: Tensor  # fx, fy, cx, cy in pixels
    limits: Tensor
    to_centre: Tensor | float = 0.0
    shift_px: float = 0.0  # pixels per scene unit
    aperture: float = 0.0  # standard deviation of the offsets that each footprint is averaged over, scene units

    def to(self, device: torch.device) -> Eye:
        """Return the same eye, its tensors on a device."""
        to_centre = self.to_centre.to(device) if isinstance(self.to_centre, Tensor) else self.to_centre
        return replace(
            self,
            world_to_camera=self.world_to_camera.to(device),
            intrinsics=self.intrinsics.to(device),
            limits=self.limits.to(device),
            to_centre=to_centre,
        )


@dataclass(frozen=True)
class Samples:
    """Positions in pixels (centres at +0.5) and view offsets in scene units, each [M] float64, sorted by row."""

    columns: Tensor
    rows: Tensor
    offsets: Tensor

    def part(self, begin: int, end: int) -> Samples:
        return Samples(self.columns[begin:end], self.rows[begin:end], self.offsets[begin:end])


@dataclass(frozen=True)
class Blend:
    """Blending weights of M samples as P intersections.

    Attributes:
        sample: [P].
        gaussian: [P].
        weight: [P].
        transmittance: [M], left over.
        margin: [M].
    """

    sample: Tensor
    gaussian: Tensor
    weight: Tensor
    transmittance: Tensor
    margin: Tensor

    def sum(self, values: Tensor) -> Tensor:
        """Return the weighted sum over each sample's Gaussians of values [P] or [P,C] -> [M] or [M,C]."""
        weight = self.weight.reshape(-1, *[1] * (values.dim() - 1))
        total = values.new_zeros(len(self.transmittance), *values.shape[1:])
        return total.index_add(0, self.sample, weight * values)


def square(vectors: Tensor) -> Tensor:
    """Return the squared length of vectors [3, ...]."""
    return (vectors * vectors).sum(0)


class Projection:
    """One scene before one eye: view-space means and spreads of the visible Gaussians, near ones first.

    With antialiased, the compensation lowers an opacity by as much as the low pass spreads the Gaussian, so that it
    keeps its light. An aperture of the eye also spreads a Gaussian, which keeps its light.
    """

    def __init__(self, scene: Scene, eye: Eye, antialiased: bool = False):
        self.scene, self.eye, self.antialiased = scene, eye.to(scene.means.device), antialiased
        self.axes, self.translation = self.eye.world_to_camera[:3, :3], self.eye.world_to_camera[:3, 3]
        self.position = scene.means @ self.axes.T + self.translation
        self.spread = (self.axes @ rotations(scene.quaternions) * scene.scales[:, None, :]).permute(1, 2, 0)
        depth = self.position[:, 2].detach()
        drawn = torch.nonzero((depth >= NEAR) & (scene.opacities.detach() * 255 >= 1)).flatten()
        self.order = drawn[torch.sort(depth[drawn], stable=True).indices]
        self.row, self.rows_reached = self._rows()

    @torch.no_grad()
    def _rows(self) -> tuple[Tensor, Tensor]:
        """Return the row of each Gaussian of `order`, px, and its reach above and below, near the cut."""
        _, v, _, down = self.footprint(self.order, self.position.new_zeros(()))
        variance = square(down) + LOW_PASS_PX2
        return v, (2 * variance * (self.scene.opacities[self.order] / (NEARLY * ALPHA_MIN)).log()).sqrt()

    def footprint(self, gaussian: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
        """Return the projected mean u, v (px) of Gaussians seen from an offset, and the rows [3, ...] of their spread.

        The products of these two vectors, in px, are the covariance (EWA) before the low pass. The arguments have the
        same number of dimensions and are broadcast, or there is one offset for all.
        """
        fx, fy, cx, cy = self.eye.intrinsics.unbind()
        low_x, high_x, low_y, high_y = self.eye.limits.unbind()
        X, Y, Z = self.position[gaussian].unbind(-1)
        F = self.spread[:, :, gaussian]

        # The Jacobian is taken at a point within the limits, the mean is projected from where it is.
        from_centre = self.eye.to_centre
        tx = Z * ((X + from_centre) / Z).clamp(low_x, high_x) - from_centre - offset
        ty = Z * (Y / Z).clamp(low_y, high_y)
        a, b, c, e = fx / Z, -fx * tx / Z**2, fy / Z, -fy * ty / Z**2
        across, down = a * F[0] + b * F[2], c * F[1] + e * F[2]
        u = fx * (X - offset) / Z + cx + self.eye.shift_px * offset
        v = fy * Y / Z + cy
        return u, v, *torch.broadcast_tensors(across, down)

    def swept(self, gaussian: Tensor) -> Tensor:
        """Return the variance along the row, px^2, that the aperture adds to Gaussians.

        Over the offsets o the column fx (X - o) / Z + shift o of a point has the variance aperture^2 (shift - fx /
        Z)^2. The points of the spread lie at Z + z. To first order in z the mean of this variance is its value at Z
        plus aperture^2 (fx / Z^2)^2 times the variance of z.
        """
        Z, fx = self.position[gaussian, 2], self.eye.intrinsics[0]
        moved = self.eye.shift_px - fx / Z, fx / Z**2 * self.spread[2][:, gaussian]
        return self.eye.aperture**2 * (moved[0] ** 2 + square(moved[1]))

    def alpha(self, gaussian: Tensor, samples: Samples) -> Tensor:
        """Return the opacity of Gaussians at samples (broadcast against each other), before the cut at 1/255."""
        u, v, across, down = self.footprint(gaussian, samples.offsets)
        dx, dy = samples.columns - u, samples.rows - v
        # Sums of squares, no differences of products: these keep their digits where a needle is 10^9 pixels long.
        along = square(down * dx - across * dy) + LOW_PASS_PX2 * (dx * dx + dy * dy)
        sharp = square(torch.linalg.cross(across, down, dim=0))  # determinant before the low pass
        determinant = sharp + LOW_PASS_PX2 * (square(across) + square(down) + LOW_PASS_PX2)
        opacity = self.scene.opacities[gaussian]
        if self.antialiased or self.eye.aperture > 0:
            swept, before = self.swept(gaussian), sharp if self.antialiased else determinant
            along, determinant = along + swept * dy * dy, determinant + swept * (square(down) + LOW_PASS_PX2)
            opacity = opacity * (before / determinant).sqrt()
        q = along / determinant
        return (opacity * torch.exp(-q / 2)).clamp(max=ALPHA_MAX)

    def colour(self, gaussian: Tensor, offset: Tensor, channel: Tensor | None = None) -> Tensor:
        """Return the colour [P,3] of Gaussians seen from offsets, or [P] of one channel each."""
        centre = -self.axes.T @ self.translation + offset[:, None] * self.axes[0]
        direction = self.scene.means[gaussian] - centre
        basis = harmonics(direction / direction.norm(dim=-1, keepdim=True), self.scene.sh.shape[1])
        if channel is None:
            return (0.5 + (basis[:, :, None] * self.scene.sh[gaussian]).sum(1)).clamp(min=0)
        return (0.5 + (basis * self.scene.sh[gaussian, :, channel]).sum(1)).clamp(min=0)

    @torch.no_grad()
    def intersections(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Return intersections (sample, Gaussian), each [P], with an alpha near the cut or above, in order."""
        rows, counts = torch.unique_consecutive(samples.rows, return_counts=True)
        begin, found, most = 0, [], ALPHAS_AT_ONCE[samples.rows.device.type]
        for row, count in zip(rows, counts.tolist()):
            near_row = self.order[(row - self.row).abs() <= self.rows_reached][None]
            end, step = begin + count, max(1, most // max(1, near_row.numel()))
            for first in range(begin, end, step):
                here = samples.part(first, min(first + step, end))
                column = Samples(here.columns[:, None], row, here.offsets[:, None])
                hit = torch.nonzero(self.alpha(near_row, column) > NEARLY * ALPHA_MIN)
                found.append((hit[:, 0] + first, near_row[0, hit[:, 1]]))
            begin = end
        sample, gaussian = (torch.cat(part) for part in zip(*found))
        return sample, gaussian

    def blend(self, samples: Samples) -> Blend:
        """Blend front to back; a sample stops before its transmittance would fall below 1e-4 (Kerbl et al.)."""
        sample, gaussian = self.intersections(samples)
        count = torch.bincount(sample, minlength=len(samples.rows))
        rank = torch.arange(len(sample), device=sample.device) - (count.cumsum(0) - count)[sample]
        full = self.alpha(gaussian, Samples(samples.columns[sample], samples.rows[sample], samples.offsets[sample]))
        shape = (len(samples.rows), max(1, int(count.max())))

        # Every sample has a row of the table with its Gaussians from near to far; missing entries are transparent.
        table = full.new_zeros(shape).index_put((sample, rank), full)
        drawn = table.detach() >= ALPHA_MIN
        table = torch.where(drawn, table, 0.0)
        after = torch.cumprod(1 - table, 1)
        kept = after.detach() >= TRANSMITTANCE_MIN
        before = torch.cat([after.new_ones(shape[0], 1), after[:, :-1]], 1)
        weight = torch.where(kept, before * table, 0.0)[sample, rank]
        left = torch.where(kept, 1 - table, 1.0).prod(1)

        # The margin: decisions are made up to and including the Gaussian that stops the sample.
        alive = before.detach() >= TRANSMITTANCE_MIN
        cut = (full.new_zeros(shape).index_put((sample, rank), full.detach()) * 255 - 1).abs()
        stop = torch.where(drawn, (after.detach() / TRANSMITTANCE_MIN - 1).abs(), torch.inf)
        margin = torch.where(alive, torch.minimum(cut, stop), torch.inf).amin(1).clamp(max=1 - NEARLY)
        return Blend(sample, gaussian, weight, left, margin)
