"""The Gaussians of whole pictures with depths, estimated or measured: picture after picture of one camera."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from lightfield_gs.app.options import AUTO, LookOptions, PhotoOptions
from lightfield_gs.app.photo import place_photo, read_frame
from lightfield_gs.app.photo_depth import depth_camera, network_picture, steady_pictures
from lightfield_gs.io.images import Picture
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.objects import to_device
from lightfield_gs.live.rgbd_cameras import RgbdPicture
from lightfield_gs.panels.panel import Panel
from lightfield_gs.photo.background_memory import BackgroundMemory
from lightfield_gs.photo.depth_models.model import Pixels
from lightfield_gs.photo.joint_upsampling import measured_to_photo
from lightfield_gs.photo.quick_layers import QuickLayers
from lightfield_gs.photo.rgbd import known_camera
from lightfield_gs.scene.gaussians import Gaussians

Camera = tuple[tuple[float, float], tuple[float, float]]  # focal lengths and principal point, pixels


class LiveDepths:
    """Makes the Gaussians of picture after picture, where they are drawn.

    Args:
        name: Of the source, for messages.
        photo: How its pictures are taken.
        look: See place_photo.
        panel: The panel.
        device: "cpu" or "cuda".
        memory: What was seen before behind what is in front. None: nothing is remembered.
        is_measured: Whether the camera's own depths are taken.
        detail: The size of what a network sees, which is told how long that takes.
    """

    def __init__(
        self,
        name: Path,
        photo: PhotoOptions,
        look: LookOptions,
        panel: Panel,
        device: str,
        memory: BackgroundMemory | None,
        is_measured: bool,
        detail: Detail,
    ):
        self._name, self._photo, self._look, self._panel = name, photo, look, panel
        self._device, self._memory, self._is_measured = torch.device(device), memory, is_measured
        self._detail = detail
        self._size: tuple[int, int] | None = None

    def read(self, picture: Picture) -> Photographed:
        """Return a picture as it is read. Raises InputError."""
        pixels = picture.pixels
        if isinstance(picture, RgbdPicture) and picture.z is not None and self._is_measured:
            return Photographed(pixels, picture.z, camera=(picture.focal_px, picture.centre_px))
        if self._photo.remove_background or not _is_plain(pixels) or self._photo.depth != AUTO:
            read = read_frame(self._name, picture, self._photo)
            pixels = read.photo.pixels
            if read.depth is not None:
                return Photographed(pixels, z=read.depth.z)
        return Photographed(pixels)

    def __call__(self, pictures: Iterable[tuple[int, Photographed]]) -> Iterator[tuple[int, Gaussians]]:
        """Yield the Gaussians of numbered pictures; their count changes with the pictures' size alone."""
        if self._is_measured or self._photo.depth != AUTO:
            for number, read in pictures:
                assert read.z is not None
                image, z = (to_device(part, self._device) for part in (read.pixels, read.z))
                image = _as_floats(image)
                if z.shape != image.shape[:2]:
                    z = measured_to_photo(z, image[..., :3])
                yield number, self._scene(image, z, read.camera)
            return
        pending: dict[int, torch.Tensor] = {}
        seen: deque[tuple[int, float]] = deque()  # shorter sides, and when the network began

        def images() -> Iterator[tuple[int, Pixels]]:
            for number, read in pictures:
                taken = to_device(read.pixels, self._device)
                pending[number] = _as_floats(taken)
                whole = taken if taken.is_cuda and _is_plain(read.pixels) else read.pixels
                began = time.perf_counter()
                small = network_picture(whole, self._photo, self._device.type, self._detail.most_network_px)
                seen.append((min(small.shape[:2]), began))
                yield number, small

        for number, find_z in steady_pictures(images(), self._photo, self._device.type):
            side_px, began = seen.popleft()
            self._detail.network_took(side_px, time.perf_counter() - began)
            image = pending.pop(number)
            yield number, self._scene(image, find_z(image[..., :3]))

    def _scene(self, image: torch.Tensor, z: torch.Tensor, camera: Camera | None = None) -> Gaussians:
        height, width = z.shape
        if self._size != (height, width):
            known = camera or settled_camera(self._photo, height, width)
            placed, _ = place_photo(self._photo, self._panel, self._look, _with_alpha(image), z.cpu(), *known)
            margin = (0, 0, 0, 0) if placed is None else placed.margin_px
            self._size = height, width
            self._layers = QuickLayers(self._size, *known, margin, self._device, self._memory)
        return self._layers(image, z)


class Photographed(NamedTuple):
    """A picture as it is read.

    Attributes:
        pixels: [H, W, 3 or 4], uint8, or float32 in 0..1.
        z: [H, W], scene units. None: a network estimates it.
        camera: Focal lengths and principal point, pixels. None: those of the options.
    """

    pixels: np.ndarray
    z: np.ndarray | None = None
    camera: Camera | None = None


def settled_camera(photo: PhotoOptions, height: int, width: int) -> Camera:
    """Return the focal lengths and the principal point of pictures of a size, by the options."""
    focal, centre, _, _ = depth_camera(photo, height, width, None)
    return known_camera(focal, centre, height, width)


def _as_floats(values: torch.Tensor) -> torch.Tensor:
    return values / 255 if values.dtype == torch.uint8 else values


def _is_plain(pixels: np.ndarray) -> bool:
    return pixels.dtype == np.uint8 and pixels.shape[2] == 3


def _with_alpha(image: torch.Tensor) -> torch.Tensor:
    return image if image.shape[2] == 4 else torch.cat([image, torch.ones_like(image[..., :1])], 2)
