"""The float64 oracle of ordinary images before cameras of any model and shutter, by autograd's Jacobians.

A camera is a path: time in 0..1 to a pose. A mean is seen at the time when its row (or column) is read, which bisection
finds, and where it is seen then is differentiated as an implicit function of the mean and the poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from lightfield_gs import Cameras, Gaussians
from lightfield_gs.base.harmonics import harmonics, rotations
from lightfield_gs.reference.blend import Eye, Projection, Samples, Scene
from lightfield_gs.scene.rotation import rotation_quaternions

MARGIN = 0.15  # of the readout, for which time goes on beyond the image


def fisheye(t: Tensor, bend: Tensor) -> Tensor:
    """Return the plane's point [..., 2] by OpenCV's formulas, of points [..., 3]."""
    radius = torch.linalg.norm(t[..., :2], dim=-1)
    angle = torch.atan2(radius, t[..., 2])
    distance = angle * (1 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(bend)))
    return t[..., :2] * (distance / radius)[..., None]


def equirectangular(t: Tensor) -> Tensor:
    return torch.stack([torch.atan2(t[..., 0], t[..., 2]), torch.asin(t[..., 1] / torch.linalg.norm(t, dim=-1))], -1)


def pose_at(first: Tensor, last: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotation [..., 3, 3] and centre [..., 3] at times [...]: slerp, and a line of centres."""
    q, p = rotation_quaternions(torch.stack([first[:3, :3], last[:3, :3]])).unbind()
    p = p * torch.sign((p * q).sum()).detach()
    angle = 2 * torch.atan2((p - q).norm(), (p + q).norm())
    if float(angle.detach()) < 1e-7:
        turned = q + time[..., None] * (p - q)
    else:
        turned = (torch.sin((1 - time) * angle)[..., None] * q + torch.sin(time * angle)[..., None] * p) / angle.sin()
    centres = [-pose[:3, :3].T @ pose[:3, 3] for pose in (first, last)]
    return rotations(turned), centres[0] + time[..., None] * (centres[1] - centres[0])


class Oracle(Projection):
    """One scene before the first of `cameras`, whose poses may have gradients."""

    def __init__(self, scene: Scene, cameras: Cameras, antialiased: bool = False):
        self.cameras = cameras
        poses = cameras.world_to_camera, cameras.world_to_camera_end
        self.first, self.last = (poses[0][0], poses[0 if poses[1] is None else 1][0])
        self.size = (cameras.height_px, cameras.width_px)
        self.shutter = cameras.rolling_shutter
        intrinsics = cameras.intrinsics()[0]
        self.focal, self.centre = intrinsics[:2], intrinsics[2:]
        self.formula = self._formula()
        self.world_spread = rotations(scene.quaternions) * scene.scales[:, None, :]  # [N, 3, 3]
        self.start, self.slope = self._times(scene.means.detach())
        super().__init__(scene, Eye(cameras.world_to_camera[0], intrinsics, torch.zeros(4).double()), antialiased)
        t, _ = self._seen(scene.means, self.start, self.slope)
        ahead = cameras.model in ("pinhole", "orthographic") or (cameras.widest_deg or 180) <= 90
        depth = t[:, 2].detach() if ahead else t.detach().norm(dim=1)
        seen = (depth >= 0.01) & (scene.opacities.detach() * 255 >= 1)
        if cameras.model == "fisheye":
            seen &= torch.atan2(t[:, :2].norm(dim=1), t[:, 2]) < math.radians(cameras.widest_deg)
        drawn = torch.nonzero(seen).flatten()
        self.order = drawn[torch.sort(depth[drawn], stable=True).indices]
        self.row, self.rows_reached = self._rows()

    def _formula(self) -> Callable[[Tensor], Tensor]:
        if self.cameras.model == "fisheye":
            bend = self.cameras.limits()[0, :4]
            return lambda t: fisheye(t, bend)
        if self.cameras.model == "equirectangular":
            return equirectangular
        return lambda t: t[..., :2] if self.cameras.model == "orthographic" else t[..., :2] / t[..., 2:]

    def _linear(self, t: Tensor, about: Tensor) -> Tensor:
        """Return a function of points t [3] with the Jacobian that footprints have at `about`."""
        if self.cameras.model != "pinhole":
            return self.formula(t)
        low_x, high_x, low_y, high_y, _ = self.cameras.limits()[0].unbind()
        slopes = about[:2] / about[2]
        kept = torch.stack([slopes[0].clamp(low_x, high_x), slopes[1].clamp(low_y, high_y)])
        return (t[:2] - kept * t[2]) / about[2]

    def _wanted(self, t: Tensor) -> Tensor:
        """Return the time at which points [..., 3] in camera axes are read."""
        axis = 0 if self.shutter in ("left_to_right", "right_to_left") else 1
        place = self.formula(t)[..., axis] * self.focal[axis] + self.centre[axis]
        time = (place - 0.5) / (self.size[1 - axis] - 1)
        return 1 - time if self.shutter in ("bottom_to_top", "right_to_left") else time

    def _at(self, means: Tensor, time: Tensor) -> Tensor:
        if self.shutter == "none":
            return means @ self.first[:3, :3].T + self.first[:3, 3]
        rotation, centre = pose_at(self.first, self.last, time)
        return (rotation @ (means - centre)[..., None])[..., 0]

    @torch.no_grad()
    def _times(self, means: Tensor) -> tuple[Tensor, Tensor]:
        """Return when means are read, and the slope of what is to be zero there; 0 where time is held."""
        if self.shutter == "none":
            return (torch.zeros(len(means)).double(),) * 2
        low, high = (torch.full((len(means),), x).double() for x in (-MARGIN, 1 + MARGIN))
        for _ in range(60):
            middle = (low + high) / 2
            later = self._wanted(self._at(means, middle)) > middle
            low, high = torch.where(later, middle, low), torch.where(later, high, middle)
        time, step = (low + high) / 2, 1e-5
        ahead, behind = (self._wanted(self._at(means, time + d)) for d in (step, -step))
        held = (time < -MARGIN + 1e-9) | (time > 1 + MARGIN - 1e-9)
        return time, torch.where(held, 0.0, 1 - (ahead - behind) / (2 * step))

    def _seen(self, means: Tensor, start: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Return means in camera axes when they are read, and that time, differentiable twice: steps from the root with
        a fixed slope have one more derivative right each."""
        time = start
        inverse = torch.where(slope == 0, 0.0, 1 / torch.where(slope == 0, 1.0, slope))
        for _ in range(0 if self.shutter == "none" else 3):
            time = time - (time - self._wanted(self._at(means, time))) * inverse
        return self._at(means, time), time

    def footprint(self, gaussian: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
        flat = gaussian.reshape(-1)
        means, given = self.scene.means[flat], (self.start[flat], self.slope[flat])
        with torch.enable_grad():
            t, _ = self._seen(means, *given)

            def linear(mean: Tensor, start: Tensor, slope: Tensor, about: Tensor) -> Tensor:
                return self._linear(self._seen(mean, start, slope)[0], about)

            each = torch.func.vmap(torch.func.jacrev(linear)) if len(flat) else lambda *_: means.new_zeros(0, 2, 3)
            rows = (each(means, *given, t) * self.focal[:, None]) @ self.world_spread[flat]
        u, v = (self.formula(t) * self.focal + self.centre).unbind(-1)
        across, down = rows.permute(1, 2, 0).reshape(2, 3, *gaussian.shape)
        return u.reshape(gaussian.shape), v.reshape(gaussian.shape), across, down

    def colour(self, gaussian: Tensor, offset: Tensor, channel: Tensor | None = None) -> Tensor:
        means = self.scene.means[gaussian]
        _, time = self._seen(means, self.start[gaussian], self.slope[gaussian])
        eye = -self.first[:3, :3].T @ self.first[:3, 3]
        if self.shutter != "none":
            _, eye = pose_at(self.first, self.last, time)
        direction = means - eye
        basis = harmonics(direction / direction.norm(dim=-1, keepdim=True), self.scene.sh.shape[1])
        return (0.5 + (basis[:, :, None] * self.scene.sh[gaussian]).sum(1)).clamp(min=0)


def image_of(projection: Projection, rows: Tensor, width: int, background: float) -> Tensor:
    """Return the rows (centres in pixels, [H]) of an image, [H, W, 3]."""
    y, x = torch.meshgrid(rows, torch.arange(width).double() + 0.5, indexing="ij")
    zeros = torch.zeros(y.numel()).double()
    blend = projection.blend(Samples(x.flatten(), y.flatten(), zeros))
    colours = projection.colour(blend.gaussian, torch.zeros(len(blend.gaussian)).double())
    return (blend.sum(colours) + blend.transmittance[:, None] * background).view(len(rows), width, 3)


def oracle_image(scene: Gaussians, cameras: Cameras, background: float, antialiased: bool = False) -> Tensor:
    """Return the image [H, W, 3] of the first camera."""
    projection = Oracle(Scene(*scene.fields().values()), cameras, antialiased)
    return image_of(projection, torch.arange(cameras.height_px).double() + 0.5, cameras.width_px, background)
