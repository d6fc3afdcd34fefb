"""Batches of cameras: pinhole, orthographic, fisheye, equirectangular."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from torch.nn import functional

import lightfield_gs
from lightfield_gs.base.arrays import is_eager
from lightfield_gs.base.checks import expect, real_number, shown, whole_number, wrong_type
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CAMERA_MODELS, ROLLING_SHUTTERS, CameraModel, RollingShutter
from lightfield_gs.scene.gaussians import check_finite
from lightfield_gs.scene.rolling_shutter import moving_poses, rotation_vector, shutter_number
from lightfield_gs.scene.rows import Rows

# Largest deviation from orthonormal rows: rotations written with three decimals deviate by up to 1.7e-3
_ORTHONORMAL = 2e-3
_MOST_TURN_DEG = 90.0  # of a camera during a readout
_WIDEST_DEG = 100.0  # of fisheyes that do not say what they see: lenses of 200 degrees are common
_BOTTOM = 1e-5  # largest deviation of the bottom row: checks of gradients move every number by 1e-6

if TYPE_CHECKING:
    from lightfield_gs import NotebookPicture
    from lightfield_gs.io.captures.camera_files import FileCamera


@dataclass(eq=False)
class Cameras(Rows):
    """The C cameras of one scene, or [B, C] cameras of B scenes; all have one image size.

    They are used like a tensor: `len`, `cameras[3]`, `cameras[:10]`, `Cameras.cat`, `clone`, `to`, see Rows.

    Instead of focal_px and principal_point_px, K may be given as in other rasterizers, [..., C, 3, 3] without skew:
    Cameras(world_to_camera, K, width_px=..., height_px=...).

    Args:
        world_to_camera: [..., C, 4, 4], [R|t] over 0 0 0 1, OpenCV axes (x right, y down, z forward), column vectors.
        focal_px: [..., C, 2] (fx, fy), pixels, > 0.
        principal_point_px: [..., C, 2] (cx, cy), pixels from the outer corner of the first pixel (centres at i + 0.5).
        width_px: width of the images, 1..65536 pixels.
        height_px: height of the images, 1..65536 pixels.
        jacobian_limits: [..., C, 5] (low_x, high_x, low_y, high_y, offset), limits of X/Z and Y/Z in the projection's
            Jacobian. They hold at the centre of a rig; the camera stands `offset` to the right of the centre. None: the
            camera's frustum and 15 % of the image beyond each edge (Kerbl et al.). Pinhole cameras alone have them.
        model: of all cameras, one of CAMERA_MODELS (csrc/math/camera_model.h has the formulas). "orthographic":
            focal_px is in pixels per scene unit. "fisheye": focal_px is in pixels per radian. "equirectangular":
            likewise; see the method of this name.
        distortion: [..., C, 4], k1 to k4 of a fisheye as OpenCV has them (Kannala & Brandt 2006); None: zeros.
        widest_deg: 0..180, of a fisheye: what lies at larger angles from the axis is not drawn. None: 100, or where the
            distortion turns the image inside out, if that is less. Up to 90 Gaussians are ordered by z, else by their
            distance.
        rolling_shutter: of all cameras, one of ROLLING_SHUTTERS: in which direction rows or columns are read. Each
            Gaussian is then drawn by the pose at which the row (or column) of its mean is read. The Jacobian has the
            motion in it, so footprints are sheared as in the photograph (csrc/math/rolling_shutter.h). Not for
            equirectangular images.
        world_to_camera_end: [..., C, 4, 4], of rolling shutters: the pose when the last row is read, world_to_camera
            that of the first. Between them the camera turns about one axis at constant speed, less than 90 degrees, and
            its centre moves along a line.

    Raises:
        InputError: shapes or values make no camera. Values on a device are not checked, for a check would wait for the
            device: NaN and infinity draw a meaningless image.
    """

    world_to_camera: torch.Tensor
    focal_px: torch.Tensor
    principal_point_px: torch.Tensor | None = None
    width_px: int | None = None
    height_px: int | None = None
    jacobian_limits: torch.Tensor | None = None
    model: CameraModel = "pinhole"
    distortion: torch.Tensor | None = None
    widest_deg: float | None = None
    rolling_shutter: RollingShutter = "none"
    world_to_camera_end: torch.Tensor | None = None

    _first, _row_numbers = "world_to_camera", 2

    def __post_init__(self) -> None:
        if self.principal_point_px is None:
            self.focal_px, self.principal_point_px = _split_intrinsics(self.focal_px)
        optional = ("jacobian_limits", "distortion", "world_to_camera_end")
        for name in ("world_to_camera", "focal_px", "principal_point_px", *optional):
            value = getattr(self, name)
            if name not in optional or value is not None:
                if not isinstance(value, torch.Tensor):
                    raise wrong_type(f"cameras: {name}", value, torch.Tensor)
                if not value.is_floating_point() or value.layout != torch.strided:
                    raise InputError(
                        f"cameras: {name}: expected floating point numbers, dense, got {value.dtype}, {value.layout}"
                    )
        lead = self.world_to_camera.shape[:-2]
        expected = {"world_to_camera": (*lead, 4, 4), "focal_px": (*lead, 2), "principal_point_px": (*lead, 2)}
        for name, numbers in zip(optional, ((5,), (4,), (4, 4))):
            if getattr(self, name) is not None:
                expected[name] = (*lead, *numbers)
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape or len(lead) not in (1, 2):
                raise InputError(f"cameras: {name} must be {['...', 'C', *shape[len(lead) :]]}, got {list(found)}")
            if getattr(self, name).device.type == "cpu":
                check_finite(f"cameras: {name}", getattr(self, name))
        if _is_readable(self.world_to_camera):
            _check_poses("world_to_camera", self.world_to_camera.detach())
        if _is_readable(self.focal_px) and not bool((self.focal_px > 0).all()):
            raise InputError(f"cameras: focal_px must be > 0, got {float(self.focal_px.min())}")
        for name in ("width_px", "height_px"):
            if getattr(self, name) is None:
                raise InputError(
                    f"cameras: {name} is missing; no matrix says how large the image is: give width_px and height_px"
                )
            setattr(self, name, whole_number(f"cameras: {name}", getattr(self, name), 1, 65536))
        self._check_model()
        self._check_shutter()

    def _check_model(self) -> None:
        """Check what belongs to the model. Raises InputError."""
        if self.model not in CAMERA_MODELS:
            raise InputError(f"cameras: model: expected one of {', '.join(CAMERA_MODELS)}, got {shown(self.model)}")
        if self.jacobian_limits is not None and self.model != "pinhole":
            raise InputError(f"cameras: jacobian_limits are for pinhole cameras, and these are {self.model}")
        if self.model != "fisheye" and not (self.distortion is None and self.widest_deg is None):
            raise InputError(
                f"cameras: distortion and widest_deg are for fisheyes, and these cameras are {self.model}: undistort "
                "the images, or leave both out"
            )
        if self.widest_deg is not None:
            self.widest_deg = real_number("cameras: widest_deg", self.widest_deg, 0.1, 180)
        elif self.model == "fisheye":
            self.widest_deg = _widest_deg(self.distortion)

    def _check_shutter(self) -> None:
        """Check what belongs to a rolling shutter. Raises InputError."""
        shutter, end = self.rolling_shutter, self.world_to_camera_end
        if shutter not in ROLLING_SHUTTERS:
            raise InputError(
                f"cameras: rolling_shutter: expected one of {', '.join(ROLLING_SHUTTERS)}, got {shown(shutter)}"
            )
        if (shutter == "none") != (end is None):
            raise InputError(
                "cameras: rolling_shutter and world_to_camera_end go together, got "
                f"{'no world_to_camera_end' if end is None else 'no rolling_shutter'}"
            )
        if end is None:
            return
        if self.model == "equirectangular":
            raise InputError(
                "cameras: rolling_shutter: equirectangular images are put together from several lenses, and have no "
                "rows that are read in turn: leave it out"
            )
        if not (_is_readable(end) and _is_readable(self.world_to_camera)):
            return
        _check_poses("world_to_camera_end", end.detach())
        turn = rotation_vector((end[..., :3, :3] @ self.world_to_camera[..., :3, :3].to(end).mT).detach())
        turned = math.degrees(float(turn.norm(dim=-1).max())) if turn.numel() else 0.0
        if turned >= _MOST_TURN_DEG:
            raise InputError(
                f"cameras: world_to_camera_end: expected a turn of less than {_MOST_TURN_DEG:g} degrees from "
                f"world_to_camera, got {turned:.4g}"
            )

    @property
    def is_all_round(self) -> bool:
        """Whether equirectangular images show 360 degrees. It reads values, and waits for a device.

        Raises:
            InputError: they do, but their middle is not in the middle, or their columns are no multiple of 4. Or values
                cannot be read, see is_eager.
        """
        if self.model != "equirectangular":
            return False
        if not is_eager((self.focal_px, self._centres())):
            raise InputError(
                "cameras: model: expected another than equirectangular where values cannot be read, as under "
                "torch.compile: render equirectangular images outside of it"
            )
        width, (turn, middle) = cast(int, self.width_px), torch.stack([self.focal_px, self._centres()])[..., 0].cpu()
        if not bool(((turn * math.tau - width).abs() <= 1e-4 * width).all()):
            return False
        if width % 4 or not bool(((middle * 2 - width).abs() <= 1e-4 * width).all()):
            raise InputError(
                "cameras: expected equirectangular images of 360 degrees with a multiple of 4 columns and the middle "
                f"in the middle, got {width} columns: make them with Cameras.equirectangular"
            )
        return True

    @classmethod
    def equirectangular(cls, world_to_camera: torch.Tensor, width_px: int) -> Cameras:
        """Return cameras that see all around: 360 degrees in `width_px` columns, 180 in half as many rows.

        The middle of an image is the direction of z. Columns go with the azimuth, rows with the elevation.

        Args:
            world_to_camera: [..., C, 4, 4], as of Cameras.
            width_px: a multiple of 4, 4..65536, since an image is drawn in two halves.

        Raises:
            InputError: another width.
        """
        width = whole_number("cameras: width_px", width_px, 4, 65536)
        ones = world_to_camera.new_ones(*world_to_camera.shape[:-2], 2)
        focal, centre = ones * (width / math.tau), ones * ones.new_tensor([width / 2, width / 4])
        return cls(world_to_camera, focal, centre, width, width // 2, model="equirectangular")

    @classmethod
    def from_K(cls, K: Any, world_to_camera: Any, width_px: int, height_px: int) -> Cameras:  # noqa: N803
        """Return pinhole cameras of matrices, as gsplat and OpenCV have them.

        Args:
            K: [3, 3], of all cameras, or [..., C, 3, 3]: fx 0 cx, 0 fy cy, 0 0 1, pixels.
            world_to_camera: [4, 4], of one camera, or [..., C, 4, 4]; [3, 4] for both without the row 0 0 0 1. OpenCV
                axes: x right, y down, z forward.
            width_px, height_px: of the images.

        Raises:
            InputError: shapes or values make no camera.
        """
        poses = _as_poses("world_to_camera", world_to_camera)
        matrices = _as_floats("K", K).to(poses)
        if matrices.ndim == 2:
            matrices = matrices.expand(*poses.shape[:-2], *matrices.shape)
        return cls(poses, matrices, width_px=width_px, height_px=height_px)

    @classmethod
    def from_opengl(
        cls,
        camera_to_world: Any,
        K: Any,  # noqa: N803
        width_px: int,
        height_px: int,
        *,
        dataparser: str | Path | None = None,
    ) -> Cameras:
        """Return pinhole cameras of nerfstudio's poses: camera to world, x right, y up, z backward.

        Args:
            camera_to_world: [4, 4] or [3, 4], of one camera, or [..., C, 4, 4] or [..., C, 3, 4].
            K: as in from_K.
            width_px, height_px: of the images.
            dataparser: a dataparser_transforms.json. The poses are then those of the capture, and the cameras those for
                a scene that nerfstudio exported.

        Raises:
            InputError: shapes or values make no camera, or the file cannot be read.
        """
        from lightfield_gs.io.captures.dataparser import read_dataparser_transform

        poses = _as_poses("camera_to_world", camera_to_world)
        axes = poses.new_tensor([1.0, -1.0, -1.0])
        rotation = (poses[..., :3, :3] * axes).mT
        inverse = poses.clone()
        inverse[..., :3, :3], inverse[..., :3, 3:] = rotation, -rotation @ poses[..., :3, 3:]
        if dataparser is not None:
            moved = read_dataparser_transform(Path(dataparser))
            places = [torch.from_numpy(moved.pose(pose)) for pose in inverse.double().cpu().reshape(-1, 4, 4).numpy()]
            inverse = torch.stack(places).reshape(inverse.shape).to(inverse)
        return cls.from_K(K, inverse, width_px, height_px)

    @classmethod
    def from_inria(cls, path: str | Path, index: int | None = None) -> Cameras:
        """Read the cameras [C] of a cameras.json of 3D Gaussian splatting, float64.

        Args:
            path: the file.
            index: read this camera only.

        Raises:
            InputError: the file is malformed, or has images of several sizes and no index is given.
        """
        from lightfield_gs.io.captures.camera_files import read_inria

        return _from_file(cls, path, read_inria(path), index)

    @classmethod
    def from_transforms(cls, path: str | Path, index: int | None = None) -> Cameras:
        """Read the cameras [C] of a transforms.json (NeRF; OpenGL axes in the file), float64.

        Args:
            path: the file.
            index: read this camera only.

        Raises:
            InputError: the file is malformed, has images of several sizes and no index is given, does not state their
                size, or has lens distortion.
        """
        from lightfield_gs.io.captures.camera_files import read_transforms

        return _from_file(cls, path, read_transforms(path), index)

    def _repr_html_(self) -> str:
        """Return the picture that a notebook shows."""
        return lightfield_gs.NotebookPicture.of_cameras(self)._repr_html_()

    def show(self) -> NotebookPicture:
        """Return a drawing of the cameras that turns with the pointer, in a notebook."""
        return lightfield_gs.NotebookPicture.of_cameras(self, lightfield_gs.NotebookPicture.FRAMES)

    @property
    def count(self) -> int:
        """Return C, the number of cameras in each set."""
        return self.world_to_camera.shape[-3]

    def intrinsics(self) -> torch.Tensor:
        """Return fx, fy, cx and cy, [..., C, 4]."""
        return torch.cat([self.focal_px, self._centres()], -1)

    @property
    def model_number(self) -> int:
        """Return the number of the model and the shutter in the core (csrc/scene/camera.h)."""
        return model_number(self.model, self.rolling_shutter)

    def poses(self) -> torch.Tensor:
        """Return world_to_camera; of rolling shutters with the motion in two more rows, [..., C, 6, 4]."""
        if self.world_to_camera_end is None:
            return self.world_to_camera
        return moving_poses(self.world_to_camera, self.world_to_camera_end, self.rolling_shutter)

    def limits(self) -> torch.Tensor:
        """Return jacobian_limits, or their default, [..., C, 5].

        Of other models than the pinhole return the lens: k1 to k4, and the widest angle in radians.
        """
        if self.model != "pinhole":
            bend = self.focal_px.new_zeros(*self.focal_px.shape[:-1], 4) if self.distortion is None else self.distortion
            return functional.pad(bend, (0, 1), value=math.radians(self.widest_deg or 0))
        if self.jacobian_limits is not None:
            return self.jacobian_limits
        centre, focal = self._centres(), self.focal_px
        edges = _edges(*self._size(), centre) - centre.unsqueeze(-1)
        return functional.pad((edges / focal.unsqueeze(-1)).flatten(-2), (0, 1))

    def select(self, indices: slice | list[int] | torch.Tensor) -> Cameras:
        """Select cameras by their indices along C, as cameras[indices]."""
        return self[indices]

    def ends(self) -> dict[str, torch.Tensor]:
        """Return world_to_camera, and world_to_camera_end if there is one, by name."""
        named = {"world_to_camera": self.world_to_camera, "world_to_camera_end": self.world_to_camera_end}
        return {name: pose for name, pose in named.items() if pose is not None}

    def _centres(self) -> torch.Tensor:
        """Return principal_point_px, which is None only before K is split."""
        return cast(torch.Tensor, self.principal_point_px)

    def _size(self) -> tuple[int, int]:
        """Return width_px and height_px, which are never None after construction."""
        return cast(int, self.width_px), cast(int, self.height_px)

    def relative_to(self, origin: Sequence[float]) -> Cameras:
        """Move the cameras to coordinates with this origin; see Rig.relative_to."""
        ends: dict[str, Any] = {name: pose.clone() for name, pose in self.ends().items()}
        for pose in ends.values():
            pose[..., :3, 3] += pose[..., :3, :3] @ pose.new_tensor(origin)
        return replace(self, **ends)


def model_number(model: CameraModel, shutter: RollingShutter = "none") -> int:
    """Return the number of a model and a shutter in the core (csrc/scene/camera.h)."""
    return CAMERA_MODELS.index(model) + len(CAMERA_MODELS) * shutter_number(shutter)


def pose_rows(number: int) -> int:
    """Return how many rows Cameras.poses has for each camera of a model and a shutter with this number."""
    return 4 if number < len(CAMERA_MODELS) else 6


_FAR = 64  # units, and times the cameras' extent: cameras farther from the origin are moved to it


def recentre(means: torch.Tensor, cameras: Cameras) -> tuple[torch.Tensor, Cameras]:
    """Move means and cameras to the middle of the cameras if it is far from the origin.

    The translation of a pose is as large as the distance from the origin. Far away float32 has too few digits: at 1e5 a
    pixel is off by a third. The middle is subtracted in float64, from poses and means. Gradients pass through; for
    poses they hold for motions of a camera that keep its rotation a rotation.
    Means of float64, and cameras within 64 units of the origin or 64 times their extent, are not moved. Neither are
    cameras on a CUDA device, since reading their values would wait.

    Where values cannot be read (is_eager) all are moved, those near the origin by 0, which changes no bit.

    Args:
        means: [..., N, 3].
        cameras: for these means.

    Returns:
        Means and cameras.
    """
    poses = cameras.world_to_camera
    if means.dtype == torch.float64 or poses.is_cuda:
        return means, cameras
    with torch.no_grad():
        exact = poses.double()
        centres = -(exact[..., :3, :3].mT @ exact[..., :3, 3:]).squeeze(-1)
        middle = centres.mean(-2, keepdim=True)
        extent = (centres - middle).norm(dim=-1).amax(-1)
        far = middle.norm(dim=-1).squeeze(-1) > _FAR * extent.clamp_min(1)
        if is_eager((poses,)) and not bool(far.any()):
            return means, cameras
        origin = torch.where(far[..., None, None], middle, 0.0)  # [..., 1, 3]
    ends: dict[str, Any] = {}
    for name, pose in cameras.ends().items():
        moved = pose.double()
        translations = moved[..., :3, 3:] + moved[..., :3, :3] @ origin.unsqueeze(-1)
        ends[name] = torch.cat([torch.cat([moved[..., :3, :3], translations], -1), moved[..., 3:, :]], -2)
    return (means.double() - origin.to(means.device)).to(means.dtype), replace(cameras, **ends)


def _edges(width_px: int, height_px: int, like: torch.Tensor) -> torch.Tensor:
    """Return the limits of the Jacobian in the image, pixels: low and high for x, then y, [2, 2]; like another tensor.

    They are cached, since every copy of numbers to a device waits.
    """
    sides = tuple((-0.15 * size, 1.15 * size) for size in (width_px, height_px))
    return _constant(sides, like.dtype, like.device) if is_eager((like,)) else like.new_tensor(sides)


@lru_cache(maxsize=64)
def _constant(numbers: tuple[tuple[float, ...], ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    with torch.inference_mode(False):  # it may be part of a graph of gradients later
        return torch.tensor(numbers, dtype=dtype, device=device)


def _widest_deg(distortion: torch.Tensor | None) -> float:
    """Return the angle up to which fisheyes with this distortion [..., 4] see more at larger angles, at most 100."""
    if distortion is None:
        return _WIDEST_DEG
    if not is_eager((distortion,)):
        raise InputError("cameras: widest_deg: the values of distortion cannot be read here: give widest_deg")
    angles = np.radians(np.linspace(0, _WIDEST_DEG, 1001))
    rows = distortion.detach().double().cpu().numpy().reshape(-1, 4)
    slope = 1 + sum((2 * k + 3) * rows[:, k : k + 1] * angles ** (2 * k + 2) for k in range(4))
    turned = (slope <= 0).any(0)
    return float(np.degrees(angles[int(turned.argmax()) - 1])) if turned.any() else _WIDEST_DEG


def _is_readable(tensor: torch.Tensor) -> bool:
    """Return whether values may be checked without waiting for a device."""
    return tensor.device.type == "cpu" and is_eager((tensor,))


def _check_poses(name: str, poses: torch.Tensor) -> None:
    """Raise InputError for the first of poses [..., 4, 4] that is no rotation and translation over 0 0 0 1."""
    matrices = poses.double().numpy().reshape(-1, 4, 4)
    rotations, unit = matrices[:, :3, :3], np.eye(4)
    with np.errstate(over="ignore", invalid="ignore"):
        gram = rotations @ rotations.swapaxes(1, 2)
        ends_well = (np.abs(matrices[:, 3] - unit[3]) <= _BOTTOM).all(1)
        orthonormal = (np.abs(gram - unit[:3, :3]) <= _ORTHONORMAL).all((1, 2))
        wrong = ~(ends_well & orthonormal & (np.linalg.det(rotations) > 0))
        if not wrong.any():
            return
        index = int(wrong.argmax())
        square = float(gram[index].trace()) / 3
        uniform = bool((np.abs(gram[index] / square - unit[:3, :3]) <= _ORTHONORMAL).all())
    if not ends_well[index]:
        bottom = matrices[index, 3]
        found = f"the bottom row {shown(bottom.tolist())}"
        if np.abs(matrices[index, :, 3] - unit[3]).max() <= _BOTTOM:
            found += "; [R|t] acts on column vectors: transpose the matrix"
        elif bottom[3] and np.abs(bottom[:3]).max() <= _BOTTOM:
            found += "; divide the matrix by its last number"
    elif orthonormal[index]:
        found = "a mirrored one (determinant -1); turn the sign of one axis of the scene as well"
    elif uniform:
        found = f"a rotation times {square**0.5:.6g}; divide the rotation, or the scene, by that"
    else:
        found = (
            f"rows that are not orthonormal: {shown(rotations[index].tolist())}; the nearest rotation is U @ Vh of "
            "torch.linalg.svd"
        )
    raise InputError(f"cameras: {name}[{index}]: expected a rotation and 0 0 0 1 below, got {found}")


def _as_floats(name: str, values: Any) -> torch.Tensor:
    """Return numbers of any kind as a tensor of floats. Raises InputError."""
    try:
        tensor = torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"cameras: {name}: expected a tensor or numbers, got {shown(values)}") from None
    if tensor.is_complex() or tensor.dtype == torch.bool:
        raise InputError(f"cameras: {name}: expected real numbers, got {tensor.dtype}")
    return tensor if tensor.is_floating_point() else tensor.double()


def _as_poses(name: str, values: Any) -> torch.Tensor:
    """Return poses [C, 4, 4] or [B, C, 4, 4]; the last row may be missing, and so may C for one. Raises InputError."""
    poses = _as_floats(name, values)
    if poses.ndim < 2 or poses.ndim > 4 or poses.shape[-1] != 4 or poses.shape[-2] not in (3, 4):
        raise InputError(
            f"cameras: {name}: expected [4, 4], [C, 4, 4] or [B, C, 4, 4], or 3 rows in place of 4, got "
            f"{list(poses.shape)}"
        )
    if poses.shape[-2] == 3:
        last = poses.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*poses.shape[:-2], 1, 4)
        poses = torch.cat([poses, last], -2)
    return poses[None] if poses.ndim == 2 else poses


def _split_intrinsics(matrices: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Split intrinsics K [..., C, 3, 3] into focal_px and principal_point_px; values on a device are not checked."""
    expect("cameras: K", matrices, torch.Tensor)
    if matrices.shape[-2:] != (3, 3):
        raise InputError(
            "cameras: expected focal_px [..., C, 2] and principal_point_px [..., C, 2], or K "
            f"[..., C, 3, 3] in place of both, got {list(matrices.shape)} alone"
        )
    if _is_readable(matrices):
        for row, column, value in ((0, 1, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 2, 1)):
            if not bool((matrices[..., row, column] == value).all()):
                raise InputError(
                    f"cameras: expected K of fx 0 cx, 0 fy cy, 0 0 1 (no skew), got other than {value} in "
                    f"row {row}, column {column}"
                )
    return matrices[..., (0, 1), (0, 1)], matrices[..., :2, 2]


def _from_file(cls: type[Cameras], path: str | Path, cameras: list[FileCamera], index: int | None) -> Cameras:
    """Convert the cameras of a file, which need one image size."""
    if index is not None:
        cameras = [cameras[whole_number(f"{path}: index", index, 0, len(cameras) - 1)]]
    sizes = {(camera.width_px, camera.height_px) for camera in cameras}
    if len(sizes) > 1:
        raise InputError(f"{path}: expected images of one size, got {len(sizes)} sizes; choose a camera by its index")
    for camera in cameras:
        if camera.assumed:
            raise InputError(f"{path}: expected w and h, the size of the images: {camera.assumed}")
        if camera.distorted:
            raise InputError(
                f"{path}: expected cameras without lens distortion (k1 ... p2 zero); undistort the images "
                "first, or set these to zero for their flat perspective"
            )
    pose, focal, centre = (
        torch.from_numpy(np.array([getattr(camera, name) for camera in cameras], np.float64))
        for name in ("world_to_camera", "focal_px", "principal_point_px")
    )
    ((width, height),) = sizes
    # numbers of any kind in the file; Cameras checks that they are whole
    return cls(pose, focal, centre, cast(int, width), cast(int, height))


torch.serialization.add_safe_globals([Cameras])  # torch.load reads them without weights_only=False
