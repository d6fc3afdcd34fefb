"""Ordinary images of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import torch
from torch import Tensor

import lightfield_gs
from lightfield_gs.base.arrays import Colour, background_tensor, check_tensor, for_graphs, is_eager
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import RenderMode
from lightfield_gs.rasterizer.image_operators import (
    draw_images,
    draw_images_and_splats,
    render_images,
    render_images_and_splats,
    render_scene,
)
from lightfield_gs.rasterizer.image_render import divide_by_alpha, draw_in_chunks
from lightfield_gs.rasterizer.operators import refuse_tangents
from lightfield_gs.rasterizer.render_options import BLUR, NEAREST, RenderOptions, with_sh_degree
from lightfield_gs.rasterizer.splat_render import Drawn, View, draw_splats, splats_of_view
from lightfield_gs.rasterizer.splat_shapes import splat_numbers
from lightfield_gs.scene.cameras import Cameras, recentre
from lightfield_gs.scene.gaussians import Gaussians, check_values

if TYPE_CHECKING:
    from lightfield_gs import NotebookPicture


class _FourImages(NamedTuple):
    image: Tensor
    alpha: Tensor | None = None
    depth: Tensor | None = None
    radii: Tensor | None = None


class RenderedImages(_FourImages):
    """The images of `render`; None where a field was not asked for. The first four are also a named tuple.

    Attributes:
        image: [..., C, H, W, 3], over the background; by other modes than "RGB" [..., C, H, W, 1 or 4], depth last.
        alpha: [..., C, H, W], 0..1.
        depth: [..., C, H, W], the expected view-space z of the Gaussians that cover a pixel, scene units; 0 where there
            are none. By the modes "D" and "RGB+D" the sum of weight * z.
        radii: [..., C, N], of the splats in pixels, without gradients; 0 where a Gaussian is not drawn.
        features: [..., C, H, W, D], the sums of weight * feature.
        normals: [..., C, H, W, 3], the sums of weight * normal, in world axes.
        median_depth: [..., C, H, W], scene units, without gradients.
        means2d: [..., C, N, 2], the projected means in pixels (x right, y down), without gradients; see `screen`.
        conics: [..., C, N, 3], xx, xy and yy of the inverse covariance on the screen, 1 / px^2, without gradients.
        tiles: [..., C, N] int32, the number of tiles of 16 x 16 pixels that the box around a splat touches.
    """

    features: Tensor | None = None
    normals: Tensor | None = None
    median_depth: Tensor | None = None
    means2d: Tensor | None = None
    conics: Tensor | None = None
    tiles: Tensor | None = None

    def __new__(
        cls,
        image: Tensor,
        alpha: Tensor | None = None,
        depth: Tensor | None = None,
        radii: Tensor | None = None,
        **others: Tensor | None,
    ) -> RenderedImages:
        """Make one; others: the fields after the fourth."""
        images = super().__new__(cls, image, alpha, depth, radii)
        for name in _OTHERS:
            setattr(images, name, others.get(name))
        return images

    def _repr_html_(self) -> str:
        """Return the picture that a notebook shows."""
        return lightfield_gs.NotebookPicture.of_images(self)._repr_html_()

    def show(self) -> NotebookPicture:
        """Return the images as a picture that changes from camera to camera with the pointer, in a notebook."""
        return lightfield_gs.NotebookPicture.of_images(self, beside=False)

    def named(self) -> dict[str, Tensor | None]:
        """Return all fields by name."""
        return self._asdict() | {name: getattr(self, name) for name in _OTHERS}

    def changed(self, change: Callable[[str, Tensor], Tensor]) -> RenderedImages:
        """Return these with each field that is there changed, from its name and tensor."""
        named = {name: None if tensor is None else change(name, tensor) for name, tensor in self.named().items()}
        return RenderedImages(**cast(dict[str, Any], named))


_OTHERS = ("features", "normals", "median_depth", "means2d", "conics", "tiles")
_OF_SPLATS = ("radii", "means2d", "conics", "tiles")


@for_graphs
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    alpha: bool = False,
    depth: bool = False,
    antialiased: bool = False,
    screen: Tensor | None = None,
    radii: bool = False,
    render_mode: RenderMode = "RGB",
    features: Tensor | None = None,
    colors: Tensor | None = None,
    sh_degree: int | None = None,
    masks: Tensor | None = None,
    near_plane: float = NEAREST,
    far_plane: float = math.inf,
    radius_clip: float = 0.0,
    normals: bool = False,
    median_depth: bool = False,
    means2d: bool = False,
    conics: bool = False,
    tiles: bool = False,
    covars: Tensor | None = None,
    eps2d: float = BLUR,
) -> RenderedImages:
    """Render ordinary images of Gaussians (Kerbl et al. 2023).

    The images are differentiable once, in the five fields of the Gaussians, features, colors, covars, the background
    and the cameras: their poses (world_to_camera and world_to_camera_end), focal_px, principal_point_px and
    jacobian_limits. Where limits are None, they follow from the other two, and so do their gradients.
    Under torch.compile, torch.export and torch.func, and of meta tensors, values are not checked.

    Args:
        gaussians: [N, ...] with cameras [C, ...]; or [B, N, ...] with cameras [B, C, ...], or with the same cameras
            [C, ...] for every set. float32 or float64.
        cameras: C cameras of any model. Those of other models than the pinhole draw each Gaussian by the model's
            Jacobian at its mean (Zwicker et al. 2001), so Gaussians of many degrees are only roughly in shape.
        background: three numbers in 0..1, or a tensor that broadcasts to [..., C, 3], whose values need only be finite.
        alpha: also return alpha.
        depth: also return depth.
        antialiased: for scenes trained with anti-aliasing (Yu et al., Mip-Splatting, 2024; gsplat's rasterize_mode).
            The blur of 0.3 px^2 widens each Gaussian, and the compensation lowers its opacity. The compensation is the
            root of the ratio of the determinants of the projected covariance without and with blur.
        screen: zeros [..., C, N, 2] that ask for gradients. The image does not depend on them. Their .grad is the
            gradient of the loss by the projected means (x right, y down), in 1 / pixels. With [..., C, N, 4] the last
            two numbers are the sums over pixels of absolute gradients (Ye et al., "AbsGS", 2024), of colours, alpha and
            depth alone.
        radii: also return radii: half the longest extent of the region where a Gaussian's alpha is 1/255 or more.
        render_mode: what `image` has: "RGB"; "D", the sum of weight * z; "ED", the expected z, which is D / alpha;
            "RGB+D" or "RGB+ED", both. Modes with depth also return `depth`.
        features: [..., N, D], or [..., C, N, D] for each camera its own; D from 1 on. They are blended by the weights
            of the image, over zeros.
        colors: [..., N, 3], or [..., C, N, 3] for each camera its own: colours as they are, of any value, in place of
            the spherical harmonics.
        sh_degree: 0..degree of the Gaussians: harmonics of higher degrees are left out. None: all count.
        masks: bool [..., N], or [..., C, N] for each camera its own: the Gaussians that are drawn.
        near_plane: Gaussians at a smaller depth are not drawn; 0.01 or more, scene units.
        far_plane: Gaussians at a larger depth are not drawn; scene units.
        radius_clip: Gaussians whose radius (see `radii`) is this or smaller are not drawn, pixels. 0: all are.
        normals: also return normals. The normal of a Gaussian is its shortest axis, turned towards the camera; it has
            gradients in the quaternions.
        median_depth: also return the depth of the Gaussian at which the light that is left falls below half. Of a pixel
            that keeps more it is the depth of its last Gaussian (Huang et al., "2D Gaussian Splatting", 2024), and 0
            without any. It has no gradients.
        means2d: also return means2d.
        conics: also return conics.
        tiles: also return tiles.
        covars: [..., N, 3, 3] covariances, in place of scales and quaternions, whose values then do not matter. They
            have gradients. For pinhole and orthographic cameras, as `eps2d`: torch projects the Gaussians then.
        eps2d: variance of the blur, px^2, 0 or more; others than 0.3 by torch.

    Returns:
        The images that were asked for, by name. As a tuple they are (image, alpha, depth, radii).

    Raises:
        InputError: for arguments of other types, shapes, devices or values.
    """
    expect("gaussians", gaussians, Gaussians)
    expect("cameras", cameras, Cameras)
    options = RenderOptions(
        alpha=alpha,
        depth=depth,
        radii=radii,
        antialiased=antialiased,
        render_mode=render_mode,
        features=features,
        colors=colors,
        masks=masks,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        normals=normals,
        median_depth=median_depth,
        means2d=means2d,
        conics=conics,
        tiles=tiles,
        covars=covars,
        eps2d=eps2d,
    )
    gaussians.validate_layout()
    if colors is not None and sh_degree is not None:
        raise InputError("sh_degree: colors take the place of the harmonics: leave sh_degree or colors out")
    gaussians, options = with_sh_degree(gaussians, sh_degree), options.checked(gaussians, cameras)
    if not cameras.is_all_round:
        return _render_by_model(gaussians, cameras, background, options, screen)
    for name in ("means2d", "conics", "tiles"):
        if getattr(options, name):
            raise InputError(f"{name}: equirectangular images are drawn in two halves, and have none: leave it out")
    if screen is not None:
        raise InputError("screen: equirectangular images are drawn in two halves, and have no screen: leave it out")
    return _render_all_round(gaussians, cameras, background, options)


def _render_all_round(
    gaussians: Gaussians, cameras: Cameras, background: Colour, options: RenderOptions
) -> RenderedImages:
    """Return equirectangular images of two halves, 90 degrees to either side of z and of -z: a seam in the middle of a
    half would cut Gaussians in two.
    """
    quarter = cast(int, cameras.width_px) // 4
    poses, centres = cameras.world_to_camera, cast(Tensor, cameras.principal_point_px)
    behind = torch.diag(poses.new_tensor([-1.0, 1, -1, 1])) @ poses
    both = replace(
        cameras.select(list(range(cameras.count)) * 2),
        world_to_camera=torch.cat([poses, behind], -3),
        principal_point_px=torch.cat([centres, centres], -2) - centres.new_tensor([quarter, 0]),
        width_px=2 * quarter,
    )
    if isinstance(background, Tensor) and background.dim() > 1 and background.shape[-2] > 1:
        background = torch.cat([background, background], -2)
    twice = options.for_cameras(lambda tensor, dimension: torch.cat([tensor, tensor], dimension))
    halves = _render_by_model(gaussians, both, background, twice, None)

    def joined(name: str, picture: Tensor) -> Tensor:
        if name == "radii":
            return torch.maximum(*picture.chunk(2, -2))
        columns, camera = (-1, -3) if name in ("alpha", "depth", "median_depth") else (-2, -4)
        ahead, back = picture.chunk(2, camera)
        right, left = back.split(quarter, columns)
        return torch.cat([left, ahead, right], columns)

    return halves.changed(joined)


def _render_by_model(
    gaussians: Gaussians, cameras: Cameras, background: Colour, options: RenderOptions, screen: Tensor | None
) -> RenderedImages:
    """Render as `render` does, each image whole."""
    drawn, view = _draw_by_model(gaussians, cameras, background, options, screen)
    return _asked_for(drawn, view, options, gaussians)


@for_graphs
def render_and_splats(
    gaussians: Gaussians, cameras: Cameras, background: Colour, options: RenderOptions, screen: Tensor | None
) -> tuple[RenderedImages, Tensor]:
    """Return what `render` returns of cameras that are not equirectangular, and the splats [..., C, N, SPLAT_FIELDS].

    The splats have no gradients.

    Args:
        gaussians: as by `render`.
        cameras: likewise.
        background: likewise.
        options: of `render`.
        screen: as by `render`.

    Raises:
        InputError: as by `render`.
    """
    gaussians.validate_layout()
    options = replace(options.checked(gaussians, cameras), splats=True)
    drawn, view = _draw_by_model(gaussians, cameras, background, options, screen)
    splats = _of_cameras(drawn, view, gaussians.count)
    return _asked_for(drawn, view, options, gaussians), splats if gaussians.is_batched else splats.squeeze(0)


def _draw_by_model(
    gaussians: Gaussians, cameras: Cameras, background: Colour, options: RenderOptions, screen: Tensor | None
) -> tuple[Drawn, View]:
    """Draw what the options ask for, [B or 1, C, ...]; see `render`. Raises InputError."""
    if not gaussians.means.is_cuda:
        check_values(gaussians)  # on CUDA looking at values would wait for the device
    like, *others = gaussians.fields().values()
    given = options.features, options.colors, options.covars
    refuse_tangents(like, *others, background, *cameras.tensors().values(), *given)
    if torch.is_grad_enabled() and cameras.distortion is not None and cameras.distortion.requires_grad:
        raise InputError(
            "cameras: distortion has no gradients, and it requires one: detach() it, or use torch.no_grad()"
        )
    batched = like.dim() == 3
    if cameras.world_to_camera.dim() == 4 and not batched:
        raise InputError(
            f"cameras [B, C, ...] go with batched Gaussians [B, N, ...], got means {list(like.shape)} and "
            f"cameras {list(cameras.world_to_camera.shape)}"
        )
    fields, view = _fields_and_view(gaussians, cameras, background)
    if screen is not None:
        screen = _checked_screen(screen, gaussians, cameras.count)
    return _drawn(fields, view, options, screen), view


def _fields_and_view(gaussians: Gaussians, cameras: Cameras, background: Colour) -> tuple[tuple[Tensor, ...], View]:
    """Return the fields [N, ...] or [B, N, ...] of Gaussians, and the cameras that see them, [B or 1, C, ...]."""
    like, *others = gaussians.fields().values()
    means, moved = recentre(like, cameras)
    views = [t.to(like) for t in (moved.poses(), moved.intrinsics(), moved.limits())]
    if cameras.world_to_camera.dim() == 3:  # shared by all sets of a batch
        views = [t.expand(like.shape[0] if like.dim() == 3 else 1, *t.shape) for t in views]
    colour = background_tensor(background, like).expand(*views[0].shape[:2], 3)
    return (means, *others), View._make((colour, *views, moved.width_px, moved.height_px, moved.model_number))


def find_splats(gaussians: Gaussians, cameras: Cameras, options: RenderOptions) -> Tensor:
    """Return the splats [C, N, SPLAT_FIELDS] that `render` draws, by a projection alone and without gradients.

    Args:
        gaussians: [N, ...].
        cameras: [C, ...], of any model but equirectangular.
        options: of render, without masks, colors and features.

    Raises:
        InputError: as by render.
    """
    gaussians.validate_layout()
    options = options.checked(gaussians, cameras)
    if not gaussians.means.is_cuda:
        check_values(gaussians)
    fields, view = _fields_and_view(gaussians, cameras, (0.0, 0.0, 0.0))
    options = options.with_set()
    return splats_of_view([field.unsqueeze(0) for field in fields], view, options)


def _drawn(fields: tuple[Tensor, ...], view: View, options: RenderOptions, screen: Tensor | None) -> Drawn:
    """Draw by the operators that serve these options fastest.

    Args:
        fields: of the Gaussians, in sets or not.
        view: images and cameras.
        options: of render.
        screen: [B, V, N, 2 or 4].
    """
    batched = fields[0].dim() == 3
    batch = list(fields) if batched else [field.unsqueeze(0) for field in fields]
    if options.by_splats:
        if not batched:
            options = options.with_set()
        return draw_splats(batch, view, options, screen)
    size = view.width, view.height, options.antialiased
    cameras = view[1:4]
    asked = screen is not None or any(t.requires_grad for t in (*fields, *view[:4]))
    by_operator = torch.is_grad_enabled() and asked or not is_eager((*fields, *view[:4]))
    if not by_operator and not options.reads_splats and not batched and options.render_mode == "RGB":
        wanted: dict[str, Any] = {"alpha": options.alpha or options.depth, "depth": options.depth, "model": view.model}
        return Drawn._make((*draw_in_chunks(batch, view.background, cameras, *size, **wanted), *(None,) * 4))
    if by_operator and not batched:
        return Drawn(*render_scene(fields, view.background, cameras, (*size, screen, view.model)))
    draw: Callable[..., tuple[Tensor, ...]]
    if by_operator:
        draw = render_images_and_splats if options.reads_splats else render_images
    else:  # at the first call of an operator with a backward torch spends a second on imports
        draw = draw_images_and_splats if options.reads_splats else draw_images
    return Drawn(*draw(*batch, view.background, *cameras, *size, screen, view.model))


def _asked_for(drawn: Drawn, view: View, options: RenderOptions, gaussians: Gaussians) -> RenderedImages:
    """Return the images that the options ask for, [B, C, ...], or of Gaussians without sets [C, ...]."""
    image, shown = drawn.image, None
    mode = options.render_mode
    if mode in ("D", "RGB+D"):
        shown = drawn.depth
    elif options.depth or mode != "RGB":
        shown = _expected_depth(drawn.depth, drawn.alpha)
    if mode != "RGB":
        assert shown is not None
        depths = shown.unsqueeze(-1)
        image = torch.cat([image, depths], -1) if mode.startswith("RGB") else depths
    others: dict[str, Tensor | None] = {name: getattr(drawn, name) for name in _OTHERS[:3]}
    if names := [name for name in _OF_SPLATS if getattr(options, name)]:
        others |= splat_numbers(_of_cameras(drawn, view, gaussians.count), names, view.width, view.height)
    images = RenderedImages(image, drawn.alpha if options.alpha else None, shown, **others)
    return images if gaussians.is_batched else images.changed(lambda name, tensor: tensor.squeeze(0))


def _of_cameras(drawn: Drawn, view: View, count: int) -> Tensor:
    """Return the splats as [B, C, N, SPLAT_FIELDS]; count: of Gaussians."""
    assert drawn.splats is not None
    return drawn.splats.view(*view.background.shape[:2], count, drawn.splats.shape[-1])


def _expected_depth(depth: Tensor, alpha: Tensor) -> Tensor:
    """Return the sum of weight * z [B, C, H, W] divided by alpha; in place where there are no gradients."""
    if torch.is_grad_enabled() and (depth.requires_grad or alpha.requires_grad) or not is_eager((depth,)):
        return depth / alpha.clamp_min(1e-10)
    return divide_by_alpha(depth, alpha)


def _checked_screen(screen: Tensor, gaussians: Gaussians, cameras: int) -> Tensor:
    """Return the argument `screen` of render as [B, C, N, 2 or 4]. Raises InputError."""
    expect("screen", screen, Tensor)
    shape = [*gaussians.means.shape[:-2], cameras, gaussians.count]
    if list(screen.shape[:-1]) != shape or screen.shape[-1] not in (2, 4):
        raise InputError(f"screen: expected {shape} of 2 or 4 numbers, got {list(screen.shape)}")
    check_tensor("screen", screen, screen.shape, gaussians.dtype, gaussians.device)
    if not screen.requires_grad:
        raise InputError("screen: nothing but its gradient means anything; make it with requires_grad=True")
    return screen if gaussians.is_batched else screen.unsqueeze(0)
