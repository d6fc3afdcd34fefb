"""The stages of ordinary images as operators of their own: Gaussians to splats, splats to images, features and depths.

Images without such wishes are one operator, or two nodes of autograd: image_operators. The gradient of splats is no
gradient of their numbers: it is the sums of ImageRender.backward_sums, which project_splats alone understands.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.image_operators import camera_gradients, fake_state
from lightfield_gs.rasterizer.image_render import ImageBuffers, ImageInputs, ImageRender
from lightfield_gs.rasterizer.operators import operator_schema, register_operator
from lightfield_gs.rasterizer.splat_shapes import hidden_splats
from lightfield_gs.rasterizer.workspace import GradientRequest, RenderState

_COLOURS = slice(_core.COLOUR_SUM, _core.COLOUR_SUM + 3)  # in the sums of a splat


class ProjectArguments(NamedTuple):
    """The arguments of project_splats: B scenes of N Gaussians, each seen by V cameras; see ImageArguments.

    Attributes:
        masks: [B, V, N] bool, the Gaussians that are drawn; None: all.
        near, far: Depths between which Gaussians are drawn, scene units.
        radius: Splats of this radius or a smaller one are not drawn, pixels.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    limits: Tensor
    width: int
    height: int
    antialiased: bool
    model: int
    screen: Tensor | None
    masks: Tensor | None
    near: float
    far: float
    radius: float

    def inputs(self) -> ImageInputs:
        """Return the checked Gaussians and cameras. Raises InputError."""
        return ImageInputs(self[:5], self[5:8], self.width, self.height, self.antialiased, self.model)

    def hidden(self, splats: Tensor) -> Tensor:
        """Return which splats [I, N, SPLAT_FIELDS] are not to be drawn, [I, N]."""
        masks = None if self.masks is None else self.masks.flatten(0, 1)
        return hidden_splats(splats, masks, self.near, self.far, self.radius)


class _ProjectGradients(NamedTuple):
    """The arguments of the backward of project_splats after its first twelve."""

    splats: Tensor
    colours: Tensor
    lists: Tensor
    sums: Tensor
    screen_numbers: int
    cameras: bool
    optics: bool


_MADE = 12  # arguments of project_splats that its backward takes too


def _project(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Project, sort and list Gaussians: the RenderState of ImageRender."""
    given = ProjectArguments(*arguments)
    return cast(tuple[Tensor, Tensor, Tensor], ImageRender(given.inputs(), None, hidden=given.hidden).work.state())


def _fake_project(*arguments):
    given = ProjectArguments(*arguments)
    images, count = given.world_to_camera.shape[0] * given.world_to_camera.shape[1], given.means.shape[1]
    return fake_state(given.means, images, count)


def _project_backward(*arguments: Any) -> tuple[Tensor, ...]:
    """Return the gradients of the first eight arguments of project_splats, and of screen."""
    given = ProjectArguments._make((*arguments[:_MADE], None, None, 0.0, 0.0, 0.0))
    known = _ProjectGradients(*arguments[_MADE:])
    render = ImageRender(given.inputs(), None, state=RenderState(*known[:3]))
    request = GradientRequest(known.screen_numbers, known.cameras, optics=known.optics)
    fields, g_poses, g_optics, screen = render.fields_backward(known.sums, request)
    lead, count = given.world_to_camera.shape[:2], given.means.shape[1]
    g_cameras = camera_gradients(given[5:8], g_poses, g_optics)
    return (*fields, *g_cameras, screen.view(*lead, count, known.screen_numbers))


def _fake_project_backward(*arguments):
    screen = arguments[0].new_empty(*arguments[5].shape[:2], arguments[0].shape[1], arguments[-3])
    return (*(torch.empty_like(t, memory_format=torch.contiguous_format) for t in arguments[:8]), screen)


project_splats_backward = register_operator(
    "project_splats_backward",
    operator_schema(ProjectArguments, _ProjectGradients, outputs=9, omit=("screen", "masks", "near", "far", "radius")),
    _project_backward,
    _fake_project_backward,
)


def _setup_project(ctx, inputs, output):
    given = ProjectArguments(*inputs)
    ctx.save_for_backward(*given[:8], *output)
    ctx.options = given[8:_MADE]
    ctx.screen_numbers = 0 if given.screen is None else given.screen.shape[-1]
    ctx.mark_non_differentiable(*output[1:])
    ctx.set_materialize_grads(False)


def _backward_project(ctx, sums, *_):
    if sums is None:
        return (None,) * len(ProjectArguments._fields)
    saved = ctx.saved_tensors
    asked = ctx.needs_input_grad[5], any(ctx.needs_input_grad[6:8])
    *fields, g_screen = project_splats_backward(*saved[:8], *ctx.options, *saved[8:], sums, ctx.screen_numbers, *asked)
    return (*fields, *(None,) * 4, g_screen if ctx.screen_numbers else None, *(None,) * 4)


project_splats = register_operator(
    "project_splats",
    operator_schema(ProjectArguments, outputs=3),
    _project,
    _fake_project,
    _setup_project,
    _backward_project,
)


class ListArguments(NamedTuple):
    """The arguments of list_splats.

    Attributes:
        splats: [B * V, N, SPLAT_FIELDS], of torch_projection.
        colours: [B * V, N, 1, COLOUR_STRIDE].
        screen: [B, V, N, 2 or 4], see ImageArguments.
        scenes: B.
        width, height: Of the images, pixels.
    """

    splats: Tensor
    colours: Tensor
    screen: Tensor | None
    scenes: int
    width: int
    height: int

    def inputs(self) -> ImageInputs:
        """Return the size of the images and scenes. Raises InputError."""
        return ImageInputs.of_splats(self.splats, self.scenes, self.width, self.height)


class _ListGradients(NamedTuple):
    """The arguments of the backward of list_splats."""

    splats: Tensor
    colours: Tensor
    lists: Tensor
    scenes: int
    width: int
    height: int
    sums: Tensor
    screen_numbers: int


def _list(*arguments: Any) -> tuple[Tensor, Tensor]:
    """Sort and list splats; return a copy of them, whose gradients are sums, and the lists."""
    given = ListArguments(*arguments)
    state = ImageRender(given.inputs(), None, splats=given.splats.contiguous()).work.state()
    return state.splats, state.lists


def _fake_list(*arguments):
    splats = arguments[0]
    return splats.new_empty(splats.shape), fake_state(splats, *splats.shape[:2])[2]


def _list_backward(*arguments: Any) -> tuple[Tensor, Tensor]:
    """Return the gradients of the splats' numbers, and of screen."""
    known = _ListGradients(*arguments)
    inputs = ImageInputs.of_splats(known.splats, known.scenes, known.width, known.height)
    render = ImageRender(inputs, None, state=RenderState(*known[:3]))
    gradients = render.splat_gradients(known.sums)
    absolute = known.sums[..., _COLOURS.stop :]
    screen = torch.cat([gradients[..., list(_core.SPLAT_PLACE_INDICES)], absolute], -1)[..., : known.screen_numbers]
    return gradients, screen.reshape(*inputs.lead, inputs.scene.count, known.screen_numbers).contiguous()


def _fake_list_backward(splats, colours, lists, scenes, width, height, sums, numbers):
    screen = splats.new_empty(scenes, splats.shape[0] // scenes, splats.shape[1], numbers)
    return splats.new_empty(splats.shape), screen


list_splats_backward = register_operator(
    "list_splats_backward", operator_schema(_ListGradients, outputs=2), _list_backward, _fake_list_backward
)


def _setup_list(ctx, inputs, output):
    given = ListArguments(*inputs)
    ctx.save_for_backward(output[0], given.colours, output[1])
    ctx.options, ctx.screen_numbers = given[3:], 0 if given.screen is None else given.screen.shape[-1]
    ctx.mark_non_differentiable(output[1])
    ctx.set_materialize_grads(False)


def _backward_list(ctx, sums, _):
    if sums is None:
        return (None,) * len(ListArguments._fields)
    saved = ctx.saved_tensors
    gradients, g_screen = list_splats_backward(*saved, *ctx.options, sums, ctx.screen_numbers)
    return gradients, None, g_screen if ctx.screen_numbers else None, None, None, None


list_splats = register_operator(
    "list_splats", operator_schema(ListArguments, outputs=2), _list, _fake_list, _setup_list, _backward_list
)


class CompositeArguments(NamedTuple):
    """The arguments of composite_splats.

    Attributes:
        splats, colours, lists: The outputs of project_splats.
        background: [B, V, 3].
        width, height: Of the images, pixels.
        absolute: Whether the gradient has sums of absolute values, for a screen of four numbers.
        plain: Whether colours [B * V, N, 1, COLOUR_STRIDE] are an argument in place of those of the harmonics.
    """

    splats: Tensor
    colours: Tensor
    lists: Tensor
    background: Tensor
    width: int
    height: int
    absolute: bool
    plain: bool

    def render(self) -> ImageRender:
        """Return the render of these splats. Raises InputError."""
        inputs = ImageInputs.of_splats(self.splats, self.background.shape[0], self.width, self.height)
        return ImageRender(inputs, self.background, state=RenderState(self.splats, self.colours, self.lists))


class _CompositeGradients(NamedTuple):
    """The arguments of the backward of composite_splats after those of the forward: images and their gradients."""

    image: Tensor
    alpha: Tensor
    depth: Tensor
    g_image: Tensor
    g_alpha: Tensor | None
    g_depth: Tensor | None


def _composite(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Return image, alpha and depth of splats, as render_images does."""
    return cast(tuple[Tensor, Tensor, Tensor], tuple(CompositeArguments(*arguments).render().draw()))


def _fake_composite(*arguments):
    given = CompositeArguments(*arguments)
    size = (*given.background.shape[:2], given.height, given.width)
    return tuple(given.splats.new_empty(shape) for shape in ((*size, 3), size, size))


def _composite_backward(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of splats, colours and background. That of colours is 0 unless they are plain."""
    given = CompositeArguments(*arguments[: len(CompositeArguments._fields)])
    known = _CompositeGradients(*arguments[len(given) :])
    sums, parts = given.render().backward_sums(ImageBuffers(*known[:3]), ImageBuffers(*known[3:]), given.absolute)
    g_colours = torch.zeros_like(given.colours)
    if given.plain:
        g_colours[..., 0, :3] = sums[..., _COLOURS]
        sums[..., _COLOURS] = 0
    return sums, g_colours, parts.view(*given.background.shape[:2], -1, 3).sum(2)


def _fake_composite_backward(*arguments):
    given = CompositeArguments(*arguments[: len(CompositeArguments._fields)])
    return tuple(t.new_empty(t.shape) for t in (given.splats, given.colours, given.background))


composite_splats_backward = register_operator(
    "composite_splats_backward",
    operator_schema(CompositeArguments, _CompositeGradients, outputs=3),
    _composite_backward,
    _fake_composite_backward,
)


def _setup_composite(ctx, inputs, output):
    given = CompositeArguments(*inputs)
    ctx.save_for_backward(*given[:4], *output)
    ctx.options = given[4:]
    ctx.set_materialize_grads(False)


def _backward_composite(ctx, g_image, g_alpha, g_depth):
    saved = ctx.saved_tensors
    g_image = torch.zeros_like(saved[4]) if g_image is None else g_image
    sums, g_colours, g_background = composite_splats_backward(
        *saved[:4], *ctx.options, *saved[4:], g_image, g_alpha, g_depth
    )
    return (sums, g_colours if ctx.needs_input_grad[1] else None, None, g_background, *(None,) * 4)


composite_splats = register_operator(
    "composite_splats",
    operator_schema(CompositeArguments, outputs=3),
    _composite,
    _fake_composite,
    _setup_composite,
    _backward_composite,
)


class FeatureArguments(NamedTuple):
    """The arguments of composite_features.

    Attributes:
        splats, colours, lists: The outputs of project_splats.
        features: [B, N, D], or [B, V, N, D] for each camera its own.
        width, height: Of the images, pixels.
    """

    splats: Tensor
    colours: Tensor
    lists: Tensor
    features: Tensor
    width: int
    height: int

    def render(self) -> ImageRender:
        """Return the render of these splats. Raises InputError."""
        if self.features.dim() not in (3, 4):
            raise InputError(f"features must be [B, N, D] or [B, V, N, D], got {list(self.features.shape)}")
        inputs = ImageInputs.of_splats(self.splats, self.features.shape[0], self.width, self.height)
        return ImageRender(inputs, None, state=RenderState(self.splats, self.colours, self.lists))


class _FeatureGradients(NamedTuple):
    """The arguments of the backward of composite_features after those of the forward."""

    image: Tensor
    g_image: Tensor


def _features(*arguments: Any) -> Tensor:
    """Return the sums of weight * feature, [B, V, H, W, D]."""
    given = FeatureArguments(*arguments)
    return given.render().draw_features(given.features)


def _fake_features(*arguments):
    given = FeatureArguments(*arguments)
    scenes, channels = given.features.shape[0], given.features.shape[-1]
    return given.splats.new_empty(scenes, given.splats.shape[0] // scenes, given.height, given.width, channels)


def _features_backward(*arguments: Any) -> tuple[Tensor, Tensor]:
    """Return the gradients of splats and features."""
    given = FeatureArguments(*arguments[: len(FeatureArguments._fields)])
    return given.render().features_backward(given.features, *arguments[len(given) :])


def _fake_features_backward(*arguments):
    return arguments[0].new_empty(arguments[0].shape), arguments[3].new_empty(arguments[3].shape)


composite_features_backward = register_operator(
    "composite_features_backward",
    operator_schema(FeatureArguments, _FeatureGradients, outputs=2),
    _features_backward,
    _fake_features_backward,
)


def _setup_features(ctx, inputs, output):
    given = FeatureArguments(*inputs)
    ctx.save_for_backward(*given[:4], output)
    ctx.options = given[4:]


def _backward_features(ctx, g_image):
    saved = ctx.saved_tensors
    sums, g_features = composite_features_backward(*saved[:4], *ctx.options, saved[4], g_image)
    return sums, None, None, g_features if ctx.needs_input_grad[3] else None, None, None


composite_features = register_operator(
    "composite_features",
    operator_schema(FeatureArguments, outputs=1),
    _features,
    _fake_features,
    _setup_features,
    _backward_features,
)


def _median_depth(splats: Tensor, colours: Tensor, lists: Tensor, scenes: int, width: int, height: int) -> Tensor:
    """Return the depth of the Gaussian at which less than half of the light is left, [B, V, H, W]; no gradients."""
    inputs = ImageInputs.of_splats(splats, scenes, width, height)
    return ImageRender(inputs, None, state=RenderState(splats, colours, lists)).median_depth()


def _fake_median_depth(splats, colours, lists, scenes, width, height):
    return splats.new_empty(scenes, splats.shape[0] // scenes, height, width)


def _without_gradients(ctx, inputs, output):
    ctx.mark_non_differentiable(output)


composite_median_depth = register_operator(
    "composite_median_depth",
    "(Tensor splats, Tensor colours, Tensor lists, SymInt scenes, SymInt width, SymInt height) -> Tensor",
    _median_depth,
    _fake_median_depth,
    _without_gradients,
)
