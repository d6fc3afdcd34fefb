"""Ordinary pinhole cameras, many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from lightfield_gs.checks import expect, whole_number
from lightfield_gs.errors import InputError
from lightfield_gs.gaussians import check_finite


@dataclass
class Cameras:
    """C cameras of one image size, or [B, C] of them: C for each of B sets of Gaussians.

    world_to_camera:    [..., C, 4, 4], [R|t] over 0 0 0 1, OpenCV axes (x right, y down, z forward), column vectors.
    focal_px:           [..., C, 2] (fx, fy), pixels, > 0.
    principal_point_px: [..., C, 2] (cx, cy), pixels from the outer corner of the first pixel (centres at i + 0.5).
    width_px, height_px: image size, 1..65536 pixels.
    jacobian_limits:    optional [..., C, 5] (low_x, high_x, low_y, high_y, offset): the limits of X/Z and Y/Z in the
                        projection's Jacobian, taken at the centre of a rig that this camera stands `offset` to the
                        right of. None: the camera's own frustum and 15 % of the image beyond each edge (Kerbl et al.).
    Raises InputError for shapes and values that make no camera; values on a device are not looked at, which would wait
    for it: there, what is not finite draws nothing that means anything.
    """

    world_to_camera: torch.Tensor
    focal_px: torch.Tensor
    principal_point_px: torch.Tensor
    width_px: int
    height_px: int
    jacobian_limits: torch.Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("world_to_camera", "focal_px", "principal_point_px", "jacobian_limits"):
            value = getattr(self, name)
            if name != "jacobian_limits" or value is not None:
                expect(f"cameras: {name}", value, torch.Tensor)
                if not value.is_floating_point() or value.layout != torch.strided or value.is_meta:
                    raise InputError(f"cameras: {name} must be floating point numbers, got {value.dtype} "
                                     f"({value.layout}, {value.device})")
        lead = self.world_to_camera.shape[:-2]
        expected = {"world_to_camera": (*lead, 4, 4), "focal_px": (*lead, 2), "principal_point_px": (*lead, 2)}
        if self.jacobian_limits is not None:
            expected["jacobian_limits"] = (*lead, 5)
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape or len(lead) not in (1, 2):
                raise InputError(f"cameras: {name} must be {['...', 'C', *shape[len(lead):]]}, got {list(found)}")
            if getattr(self, name).device.type == "cpu":
                check_finite(f"cameras: {name}", getattr(self, name))
        if self.focal_px.device.type == "cpu" and not bool((self.focal_px > 0).all()):
            raise InputError(f"cameras: focal_px must be > 0, got {float(self.focal_px.min())}")
        for name in ("width_px", "height_px"):
            setattr(self, name, whole_number(f"cameras: {name}", getattr(self, name), 1, 65536))

    @property
    def count(self) -> int:
        """C."""
        return self.world_to_camera.shape[-3]

    def intrinsics(self) -> torch.Tensor:
        """[..., C, 4]: fx, fy, cx, cy."""
        return torch.cat([self.focal_px, self.principal_point_px], -1)

    def limits(self) -> torch.Tensor:
        """jacobian_limits, or the default ones, [..., C, 5]."""
        if self.jacobian_limits is not None:
            return self.jacobian_limits
        edges = []
        for axis, size in enumerate((self.width_px, self.height_px)):
            centre, focal = self.principal_point_px[..., axis], self.focal_px[..., axis]
            edges += [-(centre + 0.15 * size) / focal, (1.15 * size - centre) / focal]
        return torch.stack([*edges, torch.zeros_like(edges[0])], -1)

    def select(self, views: slice | list[int] | torch.Tensor) -> "Cameras":
        """The cameras at these places along C."""
        limits = None if self.jacobian_limits is None else self.jacobian_limits[..., views, :]
        return Cameras(self.world_to_camera[..., views, :, :], self.focal_px[..., views, :],
                       self.principal_point_px[..., views, :], self.width_px, self.height_px, limits)

    def relative_to(self, origin: Sequence[float]) -> "Cameras":
        """The same cameras for coordinates that are given from `origin`; see Rig.relative_to."""
        poses = self.world_to_camera.clone()
        poses[..., :3, 3] += poses[..., :3, :3] @ poses.new_tensor(origin)
        return replace(self, world_to_camera=poses)

    def to(self, *args, **kwargs) -> "Cameras":
        """Every tensor through torch.Tensor.to."""
        limits = None if self.jacobian_limits is None else self.jacobian_limits.to(*args, **kwargs)
        return Cameras(self.world_to_camera.to(*args, **kwargs), self.focal_px.to(*args, **kwargs),
                       self.principal_point_px.to(*args, **kwargs), self.width_px, self.height_px, limits)
