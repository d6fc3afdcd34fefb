"""Photographs with their cameras in normalised coordinates, and how they are drawn.

Captures come in any unit and at any place, some in metres from a state's survey mark. Learning rates and limits are for
cameras about the origin with an extent of 1; float32 also has the most digits there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.options import CameraModel, RollingShutter
from lightfield_gs.fitting.photo_storage import DeviceRows, ReadAhead, RowFile, StoredRows, select_rows, white_rows
from lightfield_gs.fitting.readouts import last_poses, of_fewer_rows, readout_poses
from lightfield_gs.fitting.settings import Masks
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.rasterizer.image_render import ImageArguments, ImageRender
from lightfield_gs.scene.cameras import Cameras, model_number
from lightfield_gs.scene.gaussians import Gaussians

_BEYOND = 1.1  # times the angle of the farthest corner of a fisheye: Gaussians beyond the edge reach into the image


@dataclass(frozen=True)
class Normalization:
    """The normalised coordinates of a fit.

    Attributes:
        centre: their origin, in the capture's coordinates.
        extent: their unit.
    """

    centre: tuple[float, float, float]
    extent: float

    @classmethod
    def from_centres(cls, centres: np.ndarray, extent: float) -> Normalization:
        """Return coordinates with the median of the cameras' centres [C,3] as their origin."""
        x, y, z = map(float, np.median(centres, 0))
        return cls((x, y, z), extent)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return points [...,3] in normalised coordinates."""
        return (points - np.array(self.centre)) / self.extent

    def poses(self, world_to_camera: np.ndarray) -> np.ndarray:
        """Return poses [C,4,4] for normalised coordinates; depths have their unit too."""
        poses = world_to_camera.copy()
        poses[:, :3, 3] = (poses[:, :3, :3] @ np.array(self.centre) + poses[:, :3, 3]) / self.extent
        return poses

    def readouts(self, readouts: np.ndarray) -> np.ndarray:
        """Return turns and ways of cameras [C,2,3] in normalised coordinates."""
        return readouts / [[1.0], [self.extent]]

    def restore(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians in units of the capture, with `centre` as their origin."""
        return replace(
            gaussians, means=gaussians.means * self.extent, scales=gaussians.scales * self.extent, origin=self.centre
        )


@dataclass
class PosedImages:
    """C photographs of one size with their cameras.

    Smaller photographs stand in the upper left, and count nowhere else. They are on the device of the fit, where a step
    takes any of them without waiting, or elsewhere: then `stage` brings those of a step.

    Attributes:
        names: of the photographs.
        photos: [C,H,W,3] uint8, as are weights and opacity: tensors, or rows of a file.
        weights: [C,H,W], 255 where a photograph counts; None: everywhere.
        world_to_camera: [C,4,4] float32, normalised coordinates; of rolling shutters [C,6,4], see Cameras.poses.
        intrinsics: [C,4] float32, fx, fy, cx, cy.
        limits: [C,5] float32, of the Jacobian.
        sizes: width and height of each.
        opacity: [C,H,W], the target of alpha by the masks; None: masks are no target.
        model: of all cameras, see Cameras; fisheyes are equidistant.
        widest_deg: of fisheyes, see Cameras.
    """

    names: list[str]
    photos: StoredRows
    weights: StoredRows | None
    world_to_camera: Tensor
    intrinsics: Tensor
    limits: Tensor
    sizes: list[tuple[int, int]]
    opacity: StoredRows | None = None
    model: CameraModel = "pinhole"
    widest_deg: float | None = None
    _reader: ReadAhead | None = field(default=None, init=False, repr=False)
    _copies: dict[int, DeviceRows] = field(default_factory=dict, init=False, repr=False)  # by the size of the batch
    _staged: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def load(
        cls,
        capture: Capture,
        indices: Sequence[int],
        normalization: Normalization,
        device: str,
        progress: Iterable[int],
        masks: Masks = "ignore",
        where: str | Path | None = None,
    ) -> PosedImages:
        """Read photographs of a capture.

        Args:
            capture: where they are.
            indices: indices of the photographs.
            normalization: the coordinates of the fit.
            device: where the fit runs.
            progress: `indices` once more; a progress bar may wrap them.
            masks: pixels outside masks and the photographs' alpha count nowhere ("ignore"), or are to be transparent
                ("alpha"). Pixels beyond the frame of a distorted photograph never count.
            where: the device whose memory takes photographs and masks, or an empty folder; None: `device`.

        Raises:
            InputError: a photograph cannot be read, or the folder's disk is full.
        """
        where = device if where is None else where
        sizes = [(int(w), int(h)) for w, h in capture.sizes_px[list(indices)]]
        width, height = (max(side) for side in zip(*sizes))
        if len(set(sizes)) > 1:
            wasted = 1 - sum(w * h for w, h in sizes) / (len(sizes) * width * height)
            assume(
                f"photographs are of {len(set(sizes))} sizes: all are drawn as {width} x {height}, {wasted:.0%} more"
            )
        frame = len(sizes), height, width
        photos = white_rows((*frame, 3), where, "photographs")
        weights, opacity = _Masks(frame, where, "weights"), _Masks(frame, where, "opacity")
        for row, (index, (w, h)) in enumerate(zip(progress, sizes)):
            photos[row] = torch.from_numpy(_padded(capture.image(index), height, width))
            counts = capture.valid_area(index) if masks == "alpha" else capture.mask(index)
            if counts is None and (w, h) != (width, height):
                counts = np.full((h, w), 255, np.uint8)
            weights.set(row, None if counts is None else _padded(counts, height, width))
            opaque = capture.opacity(index) if masks == "alpha" else None
            opacity.set(row, None if opaque is None else _padded(opaque, height, width, 255))
        focal, principal = torch.from_numpy(capture.intrinsics[list(indices)]).split(2, -1)
        poses = torch.from_numpy(normalization.poses(capture.world_to_camera[list(indices)]))
        widest = _widest_deg(focal, principal, width, height) if capture.model == "fisheye" else None
        cameras = Cameras(poses, focal, principal, width, height, model=capture.model, widest_deg=widest)
        if capture.readouts is not None:
            readouts = normalization.readouts(capture.readouts[list(indices)])
            poses = readout_poses(poses, torch.from_numpy(readouts), [h for _, h in sizes], height)
        return cls(
            [capture.names[index] for index in indices],
            photos,
            weights.rows,
            poses.float().to(device),
            cameras.intrinsics().float().to(device),
            cameras.limits().float().to(device),
            sizes,
            opacity.rows,
            capture.model,
            widest,
        )

    def targets(self, indices: Tensor, background: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return the targets of the renders of some photographs.

        Where masks are the target of alpha, a photograph stands over the background. A render with too little alpha
        then differs from it, most of all if each step has another background.

        Args:
            indices: [V].
            background: [V,3].

        Returns:
            Photographs [V,H,W,3], uint8 or float32, and weights [V,H,W] in 0..1 if there are any.
        """
        photos, weights = self._select("photos", indices), self._select("weights", indices)
        assert photos is not None
        weights = None if weights is None else weights / 255
        opacity = self._select("opacity", indices)
        if opacity is None:
            return photos, weights
        alpha = opacity[..., None] / 255
        return photos / 255 * alpha + (1 - alpha) * background[:, None, None], weights

    @property
    def rolling_shutter(self) -> RollingShutter:
        """Of all cameras."""
        return "none" if self.world_to_camera.shape[1] == 4 else "top_to_bottom"

    @property
    def is_staged(self) -> bool:
        """Whether photographs are elsewhere than on the device of the fit, so that each step has to stage its own."""
        return isinstance(self.photos, RowFile) or self.photos.device != self.device

    def stage(self, steps: Tensor) -> None:
        """Bring the photographs steps[0] to the device, for the next `targets`; else do nothing.

        A CUDA graph finds them: for a number of photographs their memory stays the same.

        Args:
            steps: [S,V], the photographs of this step and of following ones, some of which are read ahead.
        """
        if not self.is_staged:
            return
        if self._reader is None:
            self._reader = ReadAhead(self._stored(), pinned=self.device.type == "cuda")
        self._staged = self._reader.take(steps)
        if self.device.type == "cuda":
            count = steps.shape[1]
            if count not in self._copies:
                self._copies[count] = DeviceRows(self._staged, self.device)
            self._copies[count].copy(self._staged)
            self._staged = self._copies[count].rows

    def _stored(self) -> dict[str, StoredRows]:
        named = {"photos": self.photos, "weights": self.weights, "opacity": self.opacity}
        return {name: stored for name, stored in named.items() if stored is not None}

    def _select(self, name: str, indices: Tensor) -> Tensor | None:
        """Return photos, weights or opacity at `indices`, or their staged copies."""
        if self.is_staged:
            return self._staged.get(name)
        stored = self._stored().get(name)
        return None if stored is None else stored.index_select(0, indices)

    def render_job(
        self,
        gaussians: Gaussians,
        chosen: Tensor,
        world_to_camera: Tensor,
        background: Tensor,
        antialiased: bool,
        *,
        capacity: int | None = None,
        size_px: tuple[int, int] | None = None,
    ) -> ImageRender:
        """Return the job that draws the scene from the cameras of some photographs, without autograd.

        Args:
            gaussians: the scene, normalised coordinates.
            chosen: [V], the photographs.
            world_to_camera: the poses of all photographs, as the attribute.
            background: [V,3].
            antialiased: the scene's render mode.
            capacity: for (tile, Gaussian) intersections, on CUDA; None: the host waits for their number.
            size_px: width and height of the upper left part to draw; None: all.
        """
        width, height = size_px or (self.width_px, self.height_px)
        poses, intrinsics, limits = (
            tensor.index_select(0, chosen)[None] for tensor in (world_to_camera, self.intrinsics, self.limits)
        )
        poses = of_fewer_rows(poses, self.height_px, height)
        fields = [tensor[None] for tensor in gaussians.fields().values()]
        views = (background[None], poses, intrinsics, limits, width, height, antialiased, None)
        arguments = ImageArguments._make((*fields, *views, model_number(self.model, self.rolling_shutter)))
        return ImageRender.from_arguments(arguments, capacity=capacity)

    def pixel_weights(self, index: int) -> Tensor:
        """Return [H,W] float32, the weights 0..1 of a photograph's pixels."""
        if self.weights is None:
            return torch.ones(self.height_px, self.width_px, device=self.device)
        return self.weights[index].to(self.device) / 255

    def masked_out(self) -> list[int]:
        """Return the indices of photographs whose masks leave less than a pixel to count, or to be opaque."""
        masks = [stored for stored in (self.weights, self.opacity) if stored is not None]
        return [i for i in range(self.count) if any(int(mask[i].sum(dtype=torch.int64)) < 255 for mask in masks)]

    def select(self, indices: Sequence[int]) -> PosedImages:
        """Return some of the photographs."""
        chosen = list(indices)
        parts: dict[str, Any] = {
            name: select_rows(value, chosen) for name, value in vars(self).items() if isinstance(value, StoredRows)
        }
        parts |= {name: [getattr(self, name)[index] for index in chosen] for name in ("names", "sizes")}
        return replace(self, **parts)

    @property
    def device(self) -> torch.device:
        """The device of the fit."""
        return self.world_to_camera.device

    def cameras(self, index: int | None = None) -> Cameras:
        """Return the cameras of all photographs, or of one, each with the size of the largest photograph."""
        some = slice(None) if index is None else slice(index, index + 1)
        poses, intrinsics, limits = (t[some] for t in (self.world_to_camera, self.intrinsics, self.limits))
        focal, centre = intrinsics.split(2, -1)
        edges = limits if self.model == "pinhole" else None
        size = self.width_px, self.height_px
        cameras = Cameras(poses[:, :4], focal, centre, *size, edges, self.model, widest_deg=self.widest_deg)
        if self.rolling_shutter == "none":
            return cameras
        return replace(cameras, rolling_shutter=self.rolling_shutter, world_to_camera_end=last_poses(poses))

    @property
    def count(self) -> int:
        """C."""
        return len(self.names)

    @property
    def height_px(self) -> int:
        return self.photos.shape[1]

    @property
    def width_px(self) -> int:
        return self.photos.shape[2]


class _Masks:
    """Masks of C photographs of one size, which take memory once one of them is not white all over.

    Attributes:
        rows: [C,H,W] uint8; None: all are white.

    Args:
        shape: C, H and W.
        where: see white_rows.
        name: see white_rows.
    """

    def __init__(self, shape: tuple[int, int, int], where: str | Path, name: str):
        self._shape, self._where, self._name = shape, where, name
        self.rows: StoredRows | None = None

    def set(self, row: int, mask: np.ndarray | None) -> None:
        """Set the mask [H,W] of a photograph; None: white."""
        if mask is None or mask.min() == 255:
            return
        if self.rows is None:
            self.rows = white_rows(self._shape, self._where, self._name)
        self.rows[row] = torch.from_numpy(mask)


def _padded(pixels: np.ndarray, height: int, width: int, value: int = 0) -> np.ndarray:
    """Return pixels [h,w,...] in the upper left of [height,width,...], contiguous, with `value` elsewhere."""
    if pixels.shape[:2] == (height, width):
        return np.ascontiguousarray(pixels)
    padded = np.full((height, width, *pixels.shape[2:]), value, pixels.dtype)
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    return padded


def _widest_deg(focal: Tensor, principal: Tensor, width_px: int, height_px: int) -> float:
    """Return the angle of what is farthest from the axis in an image of equidistant fisheyes, and a little beyond."""
    corners = torch.tensor([[0, 0], [width_px, 0], [0, height_px], [width_px, height_px]], dtype=focal.dtype)
    angles = ((corners - principal[:, None]) / focal[:, None]).norm(dim=-1)
    return min(180.0, math.degrees(_BEYOND * float(angles.max())))
