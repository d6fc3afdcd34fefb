"""Ordinary images with splats so large that a whole block adds up their intersections.

On these the CUDA stages compiled for the CPU are compared with the CPU's stages, with enough capacity and with too
little.
"""

from __future__ import annotations

from typing import Any

import torch
from rasterizer_cases import turned_pose
from torch import Tensor

from lightfield_gs import Cameras
from lightfield_gs.bench.scenes import sheet, with_harmonics
from lightfield_gs.rasterizer.image_render import ImageArguments, ImageBuffers, ImageRender
from lightfield_gs.rasterizer.workspace import GradientRequest
from lightfield_gs.rasterizer.workspace_cuda import CudaWorkspace

SIDE_PX = 272  # 17 x 17 tiles: a splat before all of them has more intersections than one warp adds up
SCENES, VIEWS = 2, 3
_GUARD_BYTES, _GUARD = 4096, 0xA5


def _arguments(dtype: torch.dtype) -> list[Tensor]:
    """Those of ImageRender up to the size: sheets, and before each some splats that fill the images, apart from each
    other in memory."""
    scenes = [with_harmonics(sheet(18, seed), 1) for seed in range(SCENES)]
    for scene in scenes:
        filling = torch.tensor([5, 6, 150, 301])
        scene.means[filling] = torch.tensor([[0.1, 0, 1.5], [-0.1, 0, 1.6], [0, 0.1, 1.7], [0, 0, 1.8]])
        scene.scales[filling] = torch.tensor([[1.5, 2.0, 0.3], [2.0, 2.0, 0.1], [3.0, 1.0, 0.2], [2.5, 2.5, 0.4]])
        scene.opacities[filling] = torch.tensor([0.1, 0.2, 0.3, 0.2])
    poses = torch.stack([torch.from_numpy(turned_pose(yaw, 0.05)) for yaw in (-0.1, 0.0, 0.1)])
    focal, centre = torch.full((VIEWS, 2), 1.1 * SIDE_PX), torch.full((VIEWS, 2), SIDE_PX / 2)
    cameras = Cameras(poses, focal.double(), centre.double(), SIDE_PX, SIDE_PX)
    fields = [torch.stack([scene.fields()[name] for scene in scenes]) for name in scenes[0].fields()]
    background = torch.full((SCENES, VIEWS, 3), 0.3)
    views = (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())
    each = [t.expand(SCENES, *t.shape) for t in views]
    return [tensor.to(dtype).contiguous() for tensor in (*fields, background, *each)]


def images_and_gradients(dtype: torch.dtype, capacity: int | None = None) -> tuple[dict[str, Tensor], ImageRender]:
    """The images and gradients of a loss on them, of places with absolute values. capacity: of ImageRender."""
    job = ImageRender.from_arguments(ImageArguments(*_arguments(dtype), SIDE_PX, SIDE_PX), capacity=capacity)
    images, random = job.draw(), torch.Generator().manual_seed(7)
    given = ImageBuffers(*(torch.randn(image.shape, generator=random).to(image) for image in images))
    found = job.backward(images, given, GradientRequest(4, optics=True))
    fields = dict(zip(("means", "quaternions", "scales", "opacities", "sh"), found.fields))
    others = {
        "cameras": found.cameras,
        "optics": found.optics,
        "places": found.screen[..., :2],
        "absolute": found.screen[..., 2:],
    }
    background = found.background_parts.view(SCENES * VIEWS, -1, 3).sum(1)
    return {**images._asdict(), **fields, **others, "background": background}, job


def with_capacities() -> dict[str, Any]:
    """Return results of the CUDA stages with several capacities for intersections.

    Returns:
        waited: Images and gradients when the host waits for the number of intersections.
        enough: The same with just enough capacity.
        intersections: Their number.
        short: For each capacity that is too small the number that is reported, and whether all buffers kept their
            edges.
    """
    waited, _ = images_and_gradients(torch.float32)
    needed = int(images_and_gradients(torch.float32, capacity=1 << 20)[1].intersections_on_device)
    enough, _ = images_and_gradients(torch.float32, capacity=needed)
    short = []
    for capacity in (needed - 1, needed // 2, 1):
        with Guards() as guards:
            job = images_and_gradients(torch.float32, capacity)[1]
        short.append(
            {"intersections": int(job.intersections_on_device), "buffers": len(guards.made), "intact": guards.intact()}
        )
    return {"waited": waited, "enough": enough, "intersections": needed, "short": short}


class Guards:
    """Put known bytes before and behind new tensors and the buffers of workspaces, while it is entered.

    It covers the tensors of torch.empty, empty_like and zeros.
    """

    def __enter__(self) -> Guards:
        self.made: list[tuple[Tensor, int]] = []
        self._usual = torch.empty, torch.empty_like, torch.zeros, CudaWorkspace._work
        empty, empty_like, zeros, _ = self._usual
        torch.empty = lambda *given, **options: self._guarded(empty(*given, **options))
        torch.empty_like = lambda *given, **options: self._guarded(empty_like(*given, **options))
        torch.zeros = lambda *given, **options: self._guarded(zeros(*given, **options)).zero_()
        CudaWorkspace._work = lambda work, *sizes: self._apart(sizes)
        return self

    def __exit__(self, *_: object) -> None:
        torch.empty, torch.empty_like, torch.zeros, CudaWorkspace._work = self._usual

    def intact(self) -> bool:
        """Whether the bytes are what they were."""
        edges = ((raw[:_GUARD_BYTES], raw[_GUARD_BYTES + size :]) for raw, size in self.made)
        return all(bool((edge == _GUARD).all()) for both in edges for edge in both)

    def _guarded(self, like: Tensor) -> Tensor:
        """Of this shape and dtype; all bits set, which is no number."""
        size = like.numel() * like.element_size()
        raw = self._usual[0](size + 2 * _GUARD_BYTES, dtype=torch.uint8).fill_(_GUARD)
        self.made.append((raw, size))
        return raw[_GUARD_BYTES : _GUARD_BYTES + size].fill_(0xFF).view(like.dtype).view(like.shape)

    def _apart(self, sizes: tuple[int, ...]) -> tuple[Tensor, list[int]]:
        buffers = [torch.empty(size, dtype=torch.uint8) for size in sizes]
        return buffers[0], [buffer.data_ptr() for buffer in buffers]
