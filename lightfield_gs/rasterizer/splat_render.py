"""Ordinary images by the stages as operators of their own, with features, depths and normals by the same weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs import _core
from lightfield_gs.base.harmonics import rotations
from lightfield_gs.base.options import CAMERA_MODELS
from lightfield_gs.rasterizer import image_render, torch_projection
from lightfield_gs.rasterizer.render_options import RenderOptions
from lightfield_gs.rasterizer.splat_operators import (
    ProjectArguments,
    composite_features,
    composite_median_depth,
    composite_splats,
    list_splats,
    project_splats,
)
from lightfield_gs.rasterizer.splat_shapes import hidden_splats
from lightfield_gs.rasterizer.workspace import RenderState


class Drawn(NamedTuple):
    """The images of B scenes before V cameras each.

    Attributes:
        image: [B, V, H, W, 3].
        alpha: [B, V, H, W].
        depth: [B, V, H, W], the sum of weight * z.
        splats: [B * V, N, SPLAT_FIELDS], without gradients; None: they are not known.
        features: [B, V, H, W, D].
        normals: [B, V, H, W, 3].
        median_depth: [B, V, H, W].
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    splats: Tensor | None = None
    features: Tensor | None = None
    normals: Tensor | None = None
    median_depth: Tensor | None = None


class View(NamedTuple):
    """The images that are drawn together.

    Attributes:
        background: [B, V, 3].
        world_to_camera, intrinsics, limits: [B, V, ...], see ImageArguments.
        width, height, model: See ImageArguments.
    """

    background: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    limits: Tensor
    width: int
    height: int
    model: int


def draw_splats(fields: Sequence[Tensor], view: View, options: RenderOptions, screen: Tensor | None) -> Drawn:
    """Draw B scenes, differentiable in what `render` names.

    Without gradients some cameras are drawn at a time, so that the memory in addition to the images stays the same.

    Args:
        fields: means, quaternions, scales, opacities and sh as in ImageArguments.
        view: images and cameras.
        options: of render; its tensors are [B, V or 1, N, ...].
        screen: see ImageArguments.
    """
    scenes, cameras = view.background.shape[:2]
    numbers = 2 * image_render._SPLAT_NUMBERS * scenes * fields[0].shape[1]
    step = max(1, image_render.CHUNK_BYTES // max(fields[0].element_size() * numbers, 1))
    moving = (*fields, *view[:4], options.features, options.colors, options.covars, screen)
    asked = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in moving)
    if asked or step >= cameras:
        return _draw(fields, view, options, screen)
    parts = []
    for first in range(0, cameras, step):
        chunk = slice(first, first + step)
        part = view._replace(**{name: getattr(view, name)[:, chunk] for name in View._fields[:4]})
        parts.append(_draw(fields, part, options.for_cameras(lambda t, _, chunk=chunk: t[:, chunk]), None))
    return Drawn._make(_joined(name, each, scenes) for name, each in zip(Drawn._fields, zip(*parts)))


def _joined(name: str, parts: Sequence[Tensor | None], scenes: int) -> Tensor | None:
    """Join a field of Drawn over chunks of cameras."""
    known = [part for part in parts if part is not None]
    if not known:
        return None
    if name != "splats":
        return torch.cat(known, 1)
    return torch.cat([part.view(scenes, -1, *part.shape[1:]) for part in known], 1).flatten(0, 1)


def _draw(fields: Sequence[Tensor], view: View, options: RenderOptions, screen: Tensor | None) -> Drawn:
    """Draw all cameras at once; see draw_splats."""
    scenes, cameras = view.background.shape[:2]
    count, size = fields[0].shape[1], (view.width, view.height)
    colors, masks = options.colors, options.masks
    if masks is not None:
        masks = masks.expand(scenes, cameras, count)
    splats, colours, lists = (_projected_by_torch if options.by_torch else _projected)(
        fields, view, options, screen, masks
    )
    if options.by_torch and colors is None:
        colors = torch_projection.colours(fields[0], fields[4], view.world_to_camera)
    plain = colors is not None
    if colors is not None:
        padded = functional.pad(colors, (0, _core.COLOUR_STRIDE - 3))
        colours = padded.expand(scenes, cameras, count, -1).reshape(colours.shape)
    absolute = screen is not None and screen.shape[-1] == 4
    image, alpha, depth = composite_splats(splats, colours, lists, view.background, *size, absolute, plain)
    state = splats, colours.detach(), lists
    found: dict[str, Tensor] = {}
    if options.features is not None:
        features = options.features if options.features.shape[1] > 1 else options.features.squeeze(1)
        found["features"] = composite_features(*state, features, *size)
    if options.normals:
        found["normals"] = composite_features(*state, facing_normals(fields, view), *size)
    if options.median_depth:
        found["median_depth"] = composite_median_depth(splats.detach(), *state[1:], scenes, *size)
    return Drawn(image, alpha, depth, splats.detach(), **found)


_State = tuple[Tensor, Tensor, Tensor]  # splats, colours and lists


def splats_of_view(fields: Sequence[Tensor], view: View, options: RenderOptions) -> Tensor:
    """Return the splats [B * V, N, SPLAT_FIELDS] that draw_splats draws; they have no order, and no gradients.

    Args:
        fields: see draw_splats.
        view: likewise.
        options: likewise, without masks.
    """
    with torch.no_grad():
        if options.by_torch:
            return _splats_by_torch(fields, view, options, None)
        given = _project_arguments(_without_harmonics(fields), view, options, None, None)
        return image_render.ImageRender(given.inputs(), None, hidden=given.hidden, listed=False).splats


def _projected(
    fields: Sequence[Tensor], view: View, options: RenderOptions, screen: Tensor | None, masks: Tensor | None
) -> _State:
    """Return splats, colours and lists; see draw_splats. masks: [B, V, N]."""
    if options.colors is not None:
        fields = _without_harmonics(fields)
    return project_splats(*_project_arguments(fields, view, options, screen, masks))


def _without_harmonics(fields: Sequence[Tensor]) -> Sequence[Tensor]:
    """Return the fields with one harmonic of zero, for splats whose colours are not read."""
    return (*fields[:4], fields[0].new_zeros(*fields[0].shape[:2], 1, 3))


def _project_arguments(
    fields: Sequence[Tensor], view: View, options: RenderOptions, screen: Tensor | None, masks: Tensor | None
) -> ProjectArguments:
    size = view.width, view.height, options.antialiased, view.model
    return ProjectArguments._make((*fields, *view[1:4], *size, screen, masks, *_cuts(options)))


def _cuts(options: RenderOptions) -> tuple[float, float, float]:
    return options.near_plane, options.far_plane, float(options.radius_clip)


def _projected_by_torch(
    fields: Sequence[Tensor], view: View, options: RenderOptions, screen: Tensor | None, masks: Tensor | None
) -> _State:
    """Do as _projected, but by torch_projection; colours have no values."""
    splats = _splats_by_torch(fields, view, options, masks)
    colours = splats.new_zeros(RenderState.shapes(splats.shape[0], splats.shape[1], 0)[1])
    splats, lists = list_splats(splats, colours, screen, fields[0].shape[0], view.width, view.height)
    return splats, colours, lists


def _splats_by_torch(fields: Sequence[Tensor], view: View, options: RenderOptions, masks: Tensor | None) -> Tensor:
    """Return splats [B * V, N, SPLAT_FIELDS] of torch_projection."""
    means, quaternions, scales, opacities, _ = fields
    covars = options.covars
    if covars is None:
        covars = torch_projection.covariances(quaternions, scales)
    size = view.width, view.height
    splats = torch_projection.project(
        means, covars, opacities, view[1:4], size, view.model, float(options.eps2d), options.antialiased
    )
    hidden = hidden_splats(splats.detach(), masks, *_cuts(options))
    reach = torch.arange(splats.shape[-1], device=splats.device) == _core.SPLAT_REACH_INDEX
    return splats.masked_fill(hidden.unsqueeze(-1) & reach, -1).flatten(0, 1)


def facing_normals(fields: Sequence[Tensor], view: View) -> Tensor:
    """Return the shortest axis of each Gaussian in world axes, turned towards each camera, [B, V, N, 3] of length 1.

    Before a rolling shutter it is turned to where the camera reads its first row.

    Args:
        fields: see draw_splats.
        view: likewise.
    """
    means, quaternions, scales = fields[:3]
    shortest = scales.detach().argmin(-1)[..., None, None].expand(*scales.shape, 1)
    normals = rotations(quaternions).gather(-1, shortest).squeeze(-1).unsqueeze(1)
    poses = view.world_to_camera.detach()
    rotation, translation = poses[..., :3, :3], poses[..., :3, 3:]
    if CAMERA_MODELS[view.model % len(CAMERA_MODELS)] == "orthographic":
        directions = rotation[..., 2:, :]
    else:
        directions = means.detach().unsqueeze(1) + (rotation.mT @ translation).mT
    away = (directions * normals.detach()).sum(-1, keepdim=True) > 0
    return torch.where(away, -normals, normals)
