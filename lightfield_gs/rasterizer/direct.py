"""The sub-pixels of a panel as a torch operator with its backward: torch.ops.lightfield_gs.render_direct.

The stages are project, order, bin and composite (docs/design.md). The camera offset of a sub-pixel is the offset of its
own view. Results are deterministic: the same bits for any number of threads.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightfield_gs.base.arrays import check_tensor
from lightfield_gs.base.device import device_guard
from lightfield_gs.rasterizer.frame_cuda import known_frames
from lightfield_gs.rasterizer.lenticular_camera import CameraNumbers, LenticularCamera
from lightfield_gs.rasterizer.operators import operator_schema, register_operator
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import OpticsGradients, RenderSize, SceneTensors
from lightfield_gs.rasterizer.workspace_cuda import WORKSPACES, Workspace

# Orders of the polynomials for colours that vary over a rig. float64 takes the higher one: it is there to be exact
COLOUR_ORDER, EXACT_COLOUR_ORDER = 8, 16


class DirectRender:
    """A render of one light-field image: checked Gaussians, background and camera."""

    def __init__(
        self, fields: Iterable[Tensor], background: Tensor, camera: LenticularCamera, antialiased: bool = False
    ):
        """Check the tensors.

        Args:
            fields: means [N, 3], quaternions, scales, opacities and sh of one scene.
            background: [3].
            camera: of the panel's sub-pixels.
            antialiased: see encoding.encode.

        Raises:
            InputError: for tensors of other shapes, types or devices.
        """
        self.scene = SceneTensors(*(t.unsqueeze(0) for t in fields))
        self.background = check_tensor("background", background, (3,), self.scene.dtype, self.scene.device)
        self.camera, self.antialiased, self.native = camera, antialiased, camera.native(antialiased)
        self.compensated = antialiased or camera.aperture > 0  # opacities are lowered where footprints are widened
        self.width, self.height = camera.lens.width_px, camera.lens.height_px
        exact = background.dtype == torch.float64
        self.colour_order = 0 if self.scene.degree == 0 else EXACT_COLOUR_ORDER if exact else COLOUR_ORDER

    def new_image(self, as_bytes: bool = False) -> Tensor:
        """Allocate the image [H, W, 3], of the scene's dtype or, with as_bytes, uint8."""
        return self.scene.new(self.height, self.width, 3, dtype=torch.uint8 if as_bytes else None)

    def workspace(self, stats: Stats, threads: int, quality: Quality = EXACT) -> Workspace:
        """Run the stages before the composite, and return their workspace."""
        with device_guard(self.scene.device):
            with stats.stage("project"):
                size = RenderSize(1, self.width, self.height, True, self.colour_order, self.compensated)
                work = WORKSPACES[self.scene.device.type](self.scene, size, stats, threads)
                stats.colour_error = work.project_direct(self.native, quality)
            work.order_and_bin()
        return work

    def draw(
        self,
        as_bytes: bool = False,
        quality: Quality = EXACT,
        stats: Stats | None = None,
        threads: int | None = None,
        out: Tensor | None = None,
    ) -> Tensor:
        """Draw the image [H, W, 3] without gradients.

        On CUDA the fast kernels of a frame draw it. They err by up to 1/255, except where a sample lies on a threshold,
        such as the least alpha of a splat.

        Args:
            as_bytes: whether the image is uint8 = round(255 clamp(c, 0, 1)).
            quality: how much error is allowed.
            stats: filled with times and counts.
            threads: of the CPU; None: torch's.
            out: an image of that size and type, which the caller has checked.
        """
        stats, threads = stats or Stats(), threads or torch.get_num_threads()
        if self.scene.device.type == "cuda":
            return known_frames(self, quality).draw(self, as_bytes, stats, out)
        work = self.workspace(stats, threads, quality)
        with stats.stage("composite"):
            out = self.new_image(as_bytes) if out is None else out
            work.composite_direct(self.native, quality, self.background, out)
        return out

    def draw_exactly(self) -> Tensor:
        """Draw the image [H, W, 3] that `backward` takes the gradients of."""
        work, out = self.workspace(Stats(), torch.get_num_threads()), self.new_image()
        with device_guard(self.scene.device):
            work.composite_direct(self.native, EXACT, self.background, out)
        return out

    def backward(
        self, image: Tensor, g_image: Tensor, optics: bool = False
    ) -> tuple[list[Tensor], Tensor, OpticsGradients | None]:
        """Return the gradients of the five fields, of the background and, with optics, of the camera.

        Args:
            image: what draw_exactly returned.
            g_image: its gradient.
            optics: whether the gradients of the camera are asked for.

        Raises:
            InputError: for images of other shapes, types or devices.
        """
        shape, like = (self.height, self.width, 3), (self.scene.dtype, self.scene.device)
        image, g_image = (check_tensor(n, t, shape, *like) for n, t in (("image", image), ("g_image", g_image)))
        work = self.workspace(Stats(), torch.get_num_threads())
        with device_guard(self.scene.device):
            fields, parts, of_camera = work.direct_backward(self.native, self.background, image, g_image, optics)
        return [g.squeeze(0) for g in fields], parts.sum(0), of_camera


class SceneArguments(NamedTuple):
    """The first arguments of the operators of light-field images; all float32, or on the CPU all float64.

    Attributes:
        means: [N, 3].
        quaternions: [N, 4], wxyz.
        scales: [N, 3], > 0.
        opacities: [N], in (0, 1].
        sh: [N, K, 3].
        background: [3].
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    background: Tensor


class _Options(NamedTuple):
    antialiased: bool = False


class DrawnImage(NamedTuple):
    image: Tensor
    g_image: Tensor


_CAMERA = len(SceneArguments._fields)  # where CameraNumbers begin among the arguments
_OPTIONS = _CAMERA + len(CameraNumbers._fields)


def _unpack(arguments: tuple[Any, ...]) -> DirectRender:
    """Return the render of an operator's arguments."""
    scene, camera = SceneArguments(*arguments[:_CAMERA]), CameraNumbers(*arguments[_CAMERA:_OPTIONS])
    options = _Options(*arguments[_OPTIONS : _OPTIONS + 1])
    return DirectRender(scene[:5], scene.background, LenticularCamera.from_numbers(camera), options.antialiased)


def draw_sub_pixels(*arguments: Any) -> Tensor:
    """Return the image [H, W, 3] that a panel with slanted lenses shows of N Gaussians.

    It is differentiable in the first six arguments. A sub-pixel of view coordinate x is seen by the camera at
    offset_start + offset_step * x. lightfield_gs.encode makes the arguments from a Panel and a Rig.

    Args:
        arguments: of SceneArguments, CameraNumbers and _Options.

    Raises:
        InputError: for arguments of other shapes, types or values.
    """
    return _unpack(arguments).draw_exactly()


def _fake(*arguments):
    camera = CameraNumbers(*arguments[_CAMERA:_OPTIONS])
    return arguments[0].new_empty((camera.height_px, camera.width_px, 3))


def sub_pixel_gradients(*arguments: Any) -> tuple[Tensor, ...]:
    """Return the gradients of render_direct's first six arguments.

    arguments: of render_direct, then its image and the gradient of that.
    """
    fields, background, _ = _unpack(arguments).backward(*DrawnImage(*arguments[_OPTIONS + 1 :]))
    return (*fields, background)


def fake_sub_pixel_gradients(*arguments):
    """Return tensors of the shapes of sub_pixel_gradients."""
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in arguments[:_CAMERA])


render_direct_backward = register_operator(
    "render_direct_backward",
    operator_schema(SceneArguments, CameraNumbers, _Options, DrawnImage, outputs=6, defaults=False),
    sub_pixel_gradients,
    fake_sub_pixel_gradients,
    batches=False,
)


def _setup_context(ctx, inputs, output):
    ctx.numbers = inputs[_CAMERA:]
    ctx.save_for_backward(*inputs[:_CAMERA], output)


def _backward(ctx, grad):
    *tensors, image = ctx.saved_tensors
    out = render_direct_backward(*tensors, *ctx.numbers, image, grad)
    return (*out, *(None for _ in ctx.numbers))


render_direct = register_operator(
    "render_direct",
    operator_schema(SceneArguments, CameraNumbers, _Options, outputs=1),
    draw_sub_pixels,
    _fake,
    _setup_context,
    _backward,
    batches=False,
)
