"""Ordinary images as torch operators with their backward: torch.ops.lightfield_gs.render_images.

The stages are project, order, bin and composite (docs/design.md). Results are deterministic: the same bits for any
number of threads. All arguments are checked, and all buffers are torch tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from lightfield_gs.base.arrays import is_eager
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.image_render import ImageArguments, ImageBuffers, ImageInputs, ImageRender
from lightfield_gs.rasterizer.operators import (
    LIBRARY,
    differentiable_once,
    operator_schema,
    register_batches,
    register_operator,
)
from lightfield_gs.rasterizer.workspace import GradientRequest, RenderState

_Images = tuple[Tensor, Tensor, Tensor]  # image, alpha and depth
_SCREEN = ImageArguments._fields.index("screen")  # the argument of a render that its backward does not take


def draw_images(*arguments: Any) -> _Images:
    """Draw without autograd: the arguments and images of render_images."""
    return cast(_Images, tuple(ImageRender.from_arguments(ImageArguments(*arguments)).draw()))


def draw_images_and_splats(*arguments: Any) -> tuple[Tensor, ...]:
    """Draw without autograd; return the images of render_images, and the splats [B * V, N, SPLAT_FIELDS]."""
    render = ImageRender.from_arguments(ImageArguments(*arguments))
    return (*cast(_Images, render.draw()), render.splats)


def render_images(*arguments: Any) -> _Images:
    """Render B scenes before V cameras each (Kerbl et al. 2023): the operator of this name.

    It is differentiable in all tensors but the limits of cameras that are no pinholes. screen receives the gradient of
    the projected means, in 1 / pixels. With 4 numbers the last two are sums over pixels of absolute values (Ye et al.,
    "AbsGS", 2024).

    Args:
        arguments: of ImageArguments.

    Returns:
        image [B, V, H, W, 3] over the background, alpha [B, V, H, W], and depth [B, V, H, W], the sum of weight * z.

    Raises:
        InputError: for arguments of other shapes, types or devices.
    """
    given = ImageArguments(*arguments)
    if (screen := given.screen) is not None:
        size = [given.means.shape[0], *given.world_to_camera.shape[1:2], given.means.shape[1]]
        if screen.dim() != 4 or list(screen.shape[:3]) != size or screen.shape[3] not in (2, 4):
            raise InputError(f"screen must be {size} of 2 or 4 numbers, got {list(screen.shape)}")
    return cast(_Images, render_images_and_splats(*arguments)[:3])


def render_images_and_splats(*arguments: Any) -> tuple[Tensor, ...]:
    """Return the images of render_images, and the splats [B * V, N, SPLAT_FIELDS], which have no gradients."""
    given = ImageArguments(*arguments)
    # Parts of other tensors are copied here, once: the backward would copy them again while the device waits
    tensors = tuple(t.contiguous() for t in given[:9])
    if _is_for_cuda(given.means) and is_eager(tensors):
        return _render_in_two_nodes(tensors[:5], tensors[5], tensors[6:], *given[9:])
    return render_images_with_state(*tensors, *given[9:])[:4]


def render_scene(
    fields: tuple[Tensor, ...], background: Tensor, cameras: tuple[Tensor, ...], options: tuple[Any, ...]
) -> tuple[Tensor, ...]:
    """Render one scene, whose five fields [N, ...] have no leading B.

    On CUDA this saves the nodes of autograd and the call of an operator for a leading B.

    Args:
        fields: means, quaternions, scales, opacities and sh.
        background: [1, V, 3].
        cameras: world_to_camera, intrinsics and limits, with B = 1.
        options: the other arguments of ImageArguments, from width on.

    Returns:
        What render_images_and_splats returns.
    """
    if _is_for_cuda(fields[0]) and is_eager((*fields, background, *cameras)):
        fields, cameras = (tuple(t.contiguous() for t in tensors) for tensors in (fields, cameras))
        return _render_in_two_nodes(fields, background.contiguous(), cameras, *options)
    batch = (field.unsqueeze(0) for field in fields)
    return render_images_and_splats(*batch, background, *cameras, *options)


def _with_state(*arguments: Any) -> tuple[Tensor, ...]:
    """Return the images of render_images, and the RenderState that spares the backward to project, order and bin."""
    render = ImageRender.from_arguments(ImageArguments(*arguments))
    return (*cast(_Images, render.draw()), *render.work.state())


def fake_state(like: Tensor, images: int, count: int) -> RenderState:
    """Return a RenderState without values, whose lists have a size that is not known.

    Args:
        like: a tensor of its type and device.
        images: how many.
        count: of Gaussians.
    """
    mode = getattr(like, "fake_mode", None)  # meta tensors have none
    tracked = mode is not None and mode.shape_env is not None
    size = torch.library.get_ctx().new_dynamic_size() if tracked else 0
    splats, colours = (like.new_empty(shape) for shape in RenderState.shapes(images, count, 0))
    return RenderState(splats, colours, like.new_empty(size, dtype=torch.uint8))


def _fake_with_state(*arguments):
    given = ImageArguments(*arguments)
    means, lead = given.means, given.world_to_camera.shape[:2]
    size = (*lead, given.height, given.width)
    images = means.new_empty((*size, 3)), means.new_empty(size), means.new_empty(size)
    return (*images, *fake_state(means, lead[0] * lead[1], means.shape[1]))


class _DrawnArguments(NamedTuple):
    """The arguments of the backward pass after the arguments of the render: outputs, their gradients, and the request.

    Attributes:
        screen_numbers: 0, 2 or 4, of the screen.
        cameras: Whether the gradient of world_to_camera is asked for.
        optics: Whether those of intrinsics and limits are.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    splats: Tensor
    colours: Tensor
    lists: Tensor
    g_image: Tensor
    g_alpha: Tensor | None
    g_depth: Tensor | None
    screen_numbers: int
    cameras: bool
    optics: bool


def _of_backward(arguments: Sequence[Any]) -> tuple[ImageArguments, _DrawnArguments]:
    """Return the arguments of a backward pass as those of the render without screen, and those after them."""
    before, model, after = arguments[:_SCREEN], arguments[_SCREEN], arguments[_SCREEN + 1 :]
    return ImageArguments._make((*before, None, model)), _DrawnArguments(*after)


def _backward_of_state(*arguments: Any) -> tuple[Tensor, ...]:
    """Return the gradients of render_images's first nine arguments and of screen.

    The gradients of cameras are 0 where they are not asked for.

    Args:
        arguments: of render_images without screen, then of _DrawnArguments.
    """
    given, drawn = _of_backward(arguments)
    render = ImageRender.from_arguments(given, state=RenderState(drawn.splats, drawn.colours, drawn.lists))
    found = render.backward(
        ImageBuffers(drawn.image, drawn.alpha, drawn.depth),
        ImageBuffers(drawn.g_image, drawn.g_alpha, drawn.g_depth),
        GradientRequest(drawn.screen_numbers, drawn.cameras, optics=drawn.optics),
    )
    lead = render.inputs.lead
    g_background = found.background_parts.view(*lead, -1, 3).sum(2)
    g_screen = found.screen.view(*lead, given.means.shape[1], drawn.screen_numbers)
    return (*found.fields, g_background, *camera_gradients(given[6:9], found.cameras, found.optics), g_screen)


def camera_gradients(cameras: Sequence[Tensor], g_poses: Tensor, g_optics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of world_to_camera, intrinsics and limits.

    Args:
        cameras: These three tensors.
        g_poses: As in ImageGradients; without images it stands for zeros, and so does g_optics.
        g_optics: Likewise.
    """
    # Copies: outputs of an operator may not share memory
    found = (g_poses, *(g.clone() for g in g_optics.split([cameras[1].shape[-1], cameras[2].shape[-1]], -1)))
    shaped = [g.reshape(t.shape) if len(g) else torch.zeros_like(t) for t, g in zip(cameras, found)]
    return shaped[0], shaped[1], shaped[2]


def _fake_backward(*arguments):
    given, drawn = _of_backward(arguments)
    screen = given.means.new_empty(*given.world_to_camera.shape[:2], given.means.shape[1], drawn.screen_numbers)
    return (*(torch.empty_like(t, memory_format=torch.contiguous_format) for t in given[:9]), screen)


render_images_backward = register_operator(
    "render_images_backward",
    operator_schema(ImageArguments, _DrawnArguments, outputs=10, defaults=False, omit=("screen",)),
    _backward_of_state,
    _fake_backward,
)


def _setup_context(ctx, inputs, output):
    *tensors, ctx.width, ctx.height, ctx.antialiased, screen, ctx.model = inputs
    ctx.screen_numbers = 0 if screen is None else screen.shape[-1]
    ctx.save_for_backward(*tensors, *output)
    ctx.mark_non_differentiable(*output[3:])
    ctx.set_materialize_grads(False)  # the state has no gradients, and neither have images that the loss does not read


def _backward(ctx, *grads):
    saved = ctx.saved_tensors
    g_image = torch.zeros_like(saved[9]) if grads[0] is None else grads[0]
    asked = ctx.needs_input_grad
    drawn = (*saved[9:], g_image, *grads[1:3], ctx.screen_numbers, asked[6], any(asked[7:9]))
    *out, g_screen = render_images_backward(*saved[:9], ctx.width, ctx.height, ctx.antialiased, ctx.model, *drawn)
    return (*out, *(None,) * 3, g_screen if ctx.screen_numbers else None, None)


render_images_with_state = register_operator(
    "render_images_with_state",
    operator_schema(ImageArguments, outputs=6),
    _with_state,
    _fake_with_state,
    _setup_context,
    _backward,
)


def _render_images_alone(*arguments: Any) -> _Images:
    """Return the images of render_images: the operator of this name.

    A compiler sees three outputs. It is told that the size of the lists, which are none of them, does not matter.
    """
    mode = torch._guards.detect_fake_mode()
    if mode is None or mode.shape_env is None:
        return render_images(*arguments)
    with mode.shape_env.ignore_fresh_unbacked_symbols():
        return render_images(*arguments)


LIBRARY.define("render_images" + operator_schema(ImageArguments, outputs=3))
LIBRARY.impl("render_images", _render_images_alone, "CompositeImplicitAutograd")
register_batches("render_images", render_images)


def _is_for_cuda(means: Tensor) -> bool:
    """Return whether the stages run on CUDA, where the backward pass has two halves."""
    return means.is_cuda


# On CUDA a render is two nodes of autograd. Autograd frees the tensors of a node after its backward pass. So images,
# splats and lists are freed before the gradients of the Gaussians are computed. With few Gaussians the device waits for
# the host, so arguments are checked once for both nodes, and scenes without a batch stay so: a view of each is a node
# too.


def _render_in_two_nodes(
    fields: tuple[Tensor, ...],
    background: Tensor,
    cameras: tuple[Tensor, ...],
    width: int,
    height: int,
    antialiased: bool,
    screen: Tensor | None,
    model: int = 0,
) -> tuple[Tensor, ...]:
    """Return what render_images_and_splats returns, by two nodes of autograd.

    Args:
        fields: its first five arguments, contiguous, or the fields of one scene without B.
        background: as in ImageArguments.
        cameras: world_to_camera, intrinsics and limits.
        width: as in ImageArguments, and so are the others.
    """
    made: list[ImageRender] = []
    options = (width, height, antialiased, model)
    state = _Project.apply(*fields, *cameras, background.detach(), options, screen, made)
    absolute = screen is not None and screen.shape[-1] == 4
    return (*_Composite.apply(*state, background, made.pop(), absolute), state[0].detach())


class _Project(torch.autograd.Function):
    """Project Gaussians to the RenderState. The gradient of its splats is the sums of ImageRender.backward_sums."""

    @staticmethod
    def forward(ctx, *inputs):
        """Run the first node of a render; `made` is a list that receives the render, ready for the composite."""
        *tensors, background, options, screen, made = inputs
        ctx.batched = tensors[0].dim() == 3
        render = ImageRender(_inputs(tensors, options), background)
        made.append(render)
        ctx.save_for_backward(*tensors)
        ctx.options, ctx.screen_numbers = options, 0 if screen is None else screen.shape[-1]
        state = render.work.state()
        ctx.mark_non_differentiable(state.colours, state.lists)
        ctx.set_materialize_grads(False)
        return tuple(state)

    @staticmethod
    @differentiable_once
    def backward(ctx, sums, *_):
        if sums is None:
            return (None,) * 12
        inputs = _inputs(ctx.saved_tensors, ctx.options)
        asked = ctx.needs_input_grad
        request = GradientRequest(ctx.screen_numbers, asked[5], optics=any(asked[6:8]))
        fields, g_poses, g_optics, screen = inputs.backward_from_sums(sums.contiguous(), request)
        g_cameras: tuple[Tensor | None, ...] = (None,) * 3
        if any(asked[5:8]):
            g_cameras = camera_gradients(ctx.saved_tensors[5:8], g_poses, g_optics)
        return (
            *(fields if ctx.batched else (g.squeeze(0) for g in fields)),
            *g_cameras,
            *(None,) * 2,  # background and options
            screen.view(*inputs.lead, inputs.scene.count, ctx.screen_numbers) if ctx.screen_numbers else None,
            None,
        )


class _Composite(torch.autograd.Function):
    """Composite the RenderState to images. The gradient of splats is as _Project takes it."""

    @staticmethod
    def forward(ctx, splats, colours, lists, background, render, absolute):
        ctx.inputs, ctx.absolute = render.inputs.without_values(), absolute
        images = tuple(render.draw())
        ctx.save_for_backward(splats, colours, lists, background, *images)
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    @differentiable_once
    def backward(ctx, g_image, g_alpha, g_depth):
        splats, colours, lists, background, image, alpha, depth = ctx.saved_tensors
        render = ImageRender(ctx.inputs, background, state=RenderState(splats, colours, lists))
        g_image = torch.zeros_like(image) if g_image is None else g_image
        images, gradients = ImageBuffers(image, alpha, depth), ImageBuffers(g_image, g_alpha, g_depth)
        sums, parts = render.backward_sums(images, gradients, ctx.absolute)
        g_background = parts.view(*ctx.inputs.lead, -1, 3).sum(2) if ctx.needs_input_grad[3] else None
        return sums, None, None, g_background, None, None


def _inputs(tensors, options) -> ImageInputs:
    """Return the inputs of five fields, with B or without, and of world_to_camera, intrinsics and limits."""
    fields = tensors[:5] if tensors[0].dim() == 3 else [t.unsqueeze(0) for t in tensors[:5]]
    return ImageInputs(fields, tensors[5:], *options)
