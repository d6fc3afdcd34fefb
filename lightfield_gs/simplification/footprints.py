"""Gaussians as images show them: their area in pixels, by the eyes before a panel or from the sides of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.harmonics import rotations
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

_BLUR_PX2 = 0.3  # variance that the rasterizer adds to every footprint
_LEAST_DEPTH = 1e-3  # fraction of the zero plane's depth; nearer Gaussians are not drawn sharply anyway
_LEAST_DETERMINANT = 1e-9
_AXES = {"xx": 0, "xy": 1, "xz": 2, "yy": 3, "yz": 4, "zz": 5}  # of covariances
_SIDES = (("xx", "xy", "yy"), ("xx", "xz", "zz"), ("yy", "yz", "zz"))


class Viewpoints(Protocol):
    """The V images by which merging judges Gaussians; rotation [3,3] and translation [3] lead to their axes."""

    @property
    def rotation(self) -> Tensor: ...

    @property
    def translation(self) -> Tensor: ...

    def project(self, means: Tensor, covariances: Tensor) -> Footprints:
        """Return the footprints of Gaussians given by camera_moments."""
        ...

    def places(self, means: Tensor) -> Tensor:
        """Return [N,3], pixels: what is near there is near in the images."""
        ...


@dataclass(frozen=True)
class Eyes:
    """The cameras of a rig before a panel, float32 numbers for tensors; they are one image, averaged over the eyes.

    Attributes:
        rotation: [3,3], world to camera.
        translation: [3].
        focal_px: fx, fy.
        spread_px: standard deviation of the eyes' positions times fx, scene units times pixels.
        zero_depth: depth of the plane without parallax.
    """

    rotation: Tensor
    translation: Tensor
    focal_px: tuple[float, float]
    spread_px: float
    zero_depth: float

    @classmethod
    def of(cls, panel: Panel, rig: Rig, device: torch.device) -> Eyes:
        """Return the eyes of a rig; they stand evenly over its width."""
        pose = torch.from_numpy(np.asarray(rig.world_to_camera, np.float32)).to(device)
        spread = rig.half_width(panel) / math.sqrt(3) * rig.focal_px[0]
        return cls(pose[:3, :3], pose[:3, 3], rig.focal_px, spread, rig.zero_depth)

    def project(self, means: Tensor, covariances: Tensor) -> Footprints:
        """Return the footprints of Gaussians given by camera_moments."""
        (fx, fy), (x, y, z) = self.focal_px, means.unbind(-1)
        z = z.clamp_min(_LEAST_DEPTH * self.zero_depth)
        xx, xy, xz, yy, yz, zz = covariances.unbind(-1)
        across, down = fx / z, fy / z
        lean_x, lean_y = -across * x / z, -down * y / z
        parallax = self.spread_px / z
        prints = (
            across.square() * xx
            + 2 * across * lean_x * xz
            + (lean_x.square() + (parallax / z).square()) * zz
            + _BLUR_PX2,
            across * down * xy + across * lean_y * xz + lean_x * down * yz + lean_x * lean_y * zz,
            down.square() * yy + 2 * down * lean_y * yz + lean_y.square() * zz + _BLUR_PX2,
        )
        return Footprints(self.places(means)[:, None], *(part[:, None] for part in prints))

    def places(self, means: Tensor) -> Tensor:
        """Return [N,3]: x, y, and the standard deviation over the eyes of the parallax from the plane at infinity."""
        (fx, fy), (x, y, z) = self.focal_px, means.unbind(-1)
        z = z.clamp_min(_LEAST_DEPTH * self.zero_depth)
        return torch.stack([fx / z * x, fy / z * y, self.spread_px / z], -1)


@dataclass(frozen=True)
class Sides:
    """Orthographic images along the axes of a scene, from far away: they stand for all viewpoints.

    Attributes:
        rotation: [3,3], the identity.
        translation: [3], zeros.
        pixel: scene units.
    """

    rotation: Tensor
    translation: Tensor
    pixel: float

    @classmethod
    def of(cls, pixel: float, device: torch.device) -> Sides:
        """Return the images with pixels of this size."""
        return cls(torch.eye(3, device=device), torch.zeros(3, device=device), pixel)

    def project(self, means: Tensor, covariances: Tensor) -> Footprints:
        """Return the footprints of Gaussians given by camera_moments."""
        places, flat = self.places(means), torch.zeros_like(means[:, 0])
        pairs = ((0, 1), (0, 2), (1, 2))
        xx, xy, yy = (
            torch.stack([covariances[:, _AXES[side[part]]] for side in _SIDES], -1) / self.pixel**2 for part in range(3)
        )
        where = torch.stack([torch.stack([places[:, i], places[:, j], flat], -1) for i, j in pairs], 1)
        return Footprints(where, xx + _BLUR_PX2, xy, yy + _BLUR_PX2)

    def places(self, means: Tensor) -> Tensor:
        """Return [N,3], the means in pixels."""
        return means / self.pixel


@dataclass(frozen=True)
class Footprints:
    """Gaussians in V images, float32.

    Attributes:
        places: [N,V,3] pixels: x, y, and the standard deviation over the eyes of the parallax from the plane at
            infinity, where an image stands for several eyes.
        xx, xy, yy: [N,V], covariance in px^2, averaged over the eyes, with the rasterizer's blur.
    """

    places: Tensor
    xx: Tensor
    xy: Tensor
    yy: Tensor

    def take(self, indices: Tensor) -> Footprints:
        """Return some of the footprints."""
        return Footprints(self.places[indices], self.xx[indices], self.xy[indices], self.yy[indices])

    def area(self) -> Tensor:
        """Return [N], the integral of exp(-q / 2) over an image, px^2, averaged over the images."""
        return 2 * math.pi * (self.xx * self.yy - self.xy.square()).clamp_min(_LEAST_DETERMINANT).sqrt().mean(-1)


def overlap(a: Footprints, b: Footprints) -> Tensor:
    """Return [N], integrals over an image of the products of two normalised Gaussians, 1 / px^2, averaged."""
    dx, dy, parallax = (a.places - b.places).unbind(-1)
    xx, xy, yy = a.xx + b.xx, a.xy + b.xy, a.yy + b.yy
    determinant = (xx * yy - xy.square()).clamp_min(_LEAST_DETERMINANT)
    q = (yy * (dx.square() + parallax.square()) - 2 * xy * dx * dy + xx * dy.square()) / determinant
    return (torch.exp(-0.5 * q.clamp_max(80)) / (2 * math.pi * determinant.sqrt())).mean(-1)


def camera_moments(gaussians: Gaussians, eyes: Viewpoints) -> tuple[Tensor, Tensor]:
    """Return means [N,3] and covariances [N,6] (xx, xy, xz, yy, yz, zz) in the axes of the images."""
    axes = (eyes.rotation @ rotations(gaussians.quaternions)) * gaussians.scales[:, None]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    covariances = torch.stack([(axes[:, i] * axes[:, j]).sum(-1) for i, j in pairs], -1)
    return gaussians.means @ eyes.rotation.T + eyes.translation, covariances
