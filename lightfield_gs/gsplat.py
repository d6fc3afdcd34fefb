"""gsplat's interface over this rasterizer: change one import of a program that uses gsplat 1.5.

`rasterization` has gsplat's arguments, shapes and names. Images, alphas and gradients are those of `render`. Arguments
that change a result and have no counterpart here are refused by name; docs/gsplat.md has the table.

Source of the interface: Ye et al., "gsplat: An Open-Source Library for Gaussian Splatting", JMLR 2025; version 1.5.3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Literal, cast

import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import RENDER_MODES, CameraModel, RenderMode
from lightfield_gs.fitting.selective_adam import SelectiveAdam
from lightfield_gs.fitting.strategies import DefaultStrategy, MCMCStrategy
from lightfield_gs.rasterizer.images import RenderedImages, render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

__all__ = ["DefaultStrategy", "MCMCStrategy", "SelectiveAdam", "rasterization"]

_TILE = 16
_MODELS: dict[str, CameraModel] = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}
# Arguments whose other values are refused, and the way out
_REFUSED = {
    "sparse_grad": (False, "gradients are dense here"),
    "distributed": (False, "give each process its own cameras, and all Gaussians"),
    "with_ut": (
        False,
        "Gaussians are projected by the camera's Jacobian here; cameras of other models need no with_ut",
    ),
    "with_eval3d": (False, "Gaussians are evaluated on the screen here"),
    "tangential_coeffs": (None, "undistort the photographs, or use camera_model='fisheye'"),
    "thin_prism_coeffs": (None, "undistort the photographs, or use camera_model='fisheye'"),
    "ftheta_coeffs": (None, "use camera_model='fisheye' with radial_coeffs of 4 numbers"),
    "viewmats_rs": (None, "use lightfield_gs.render, whose Cameras have rolling shutters"),
    "tile_size": (_TILE, "tiles have 16 x 16 pixels here"),
}


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,  # noqa: N803
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = _TILE,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: Literal["pinhole", "ortho", "fisheye"] = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw Gaussians before C cameras, with the arguments of gsplat 1.5.

    Args:
        means: [..., N, 3]; `...` are any dimensions of a batch.
        quats: [..., N, 4], wxyz, any length but zero.
        scales: [..., N, 3], standard deviations.
        opacities: [..., N], 0..1.
        colors: [..., (C,) N, D], as they are; with sh_degree [..., (C,) N, K, 3] spherical harmonics.
        viewmats: [..., C, 4, 4], world to camera.
        Ks: [..., C, 3, 3].
        width, height: of the images, pixels.
        near_plane, far_plane: only Gaussians of depths between them are drawn; near_plane is 0.01 or more.
        radius_clip: Gaussians of this radius or less, pixels, are not drawn.
        eps2d: variance of the blur, px^2.
        sh_degree: the degree that is drawn, of the stored one or lower; None: colors are colours.
        packed: the entries of meta that belong to Gaussians have only those that are drawn, one after the other.
        tile_size: 16.
        backgrounds: [..., C, D]; None: zeros.
        render_mode: "RGB", "D" (sum of weight * z), "ED" (D / alpha), "RGB+D" or "RGB+ED".
        absgrad: meta["means2d"].absgrad is there after backward (Ye et al., "AbsGS", 2024).
        rasterize_mode: "antialiased": opacities make up for the blur.
        channel_chunk, segmented: taken, and without effect.
        camera_model: "pinhole", "ortho" or "fisheye".
        covars: [..., N, 3, 3], in place of quats and scales.
        radial_coeffs: [..., C, 4], k1 to k4 of a fisheye.
        sparse_grad, distributed, with_ut, with_eval3d, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs,
            viewmats_rs: only their defaults.
        rolling_shutter: None, or gsplat's GLOBAL.

    Returns:
        Images [..., C, H, W, D, D + 1 or 1], alphas [..., C, H, W, 1], and meta: radii [..., C, N, 2] int32, means2d
        [..., C, N, 2] (whose .grad is there after backward), depths and opacities [..., C, N], conics
        [..., C, N, 3], tiles_per_gauss [..., C, N], tile_width, tile_height, tile_size, width, height, n_batches,
        n_cameras; packed: these as [M, ...], with batch_ids, camera_ids and gaussian_ids [M], else None.

    Raises:
        InputError: an argument that is refused, or another type, shape, device or value.
    """
    given = dict(locals())
    _refuse(given)
    for name in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"):
        if not (name in ("quats", "scales") and covars is not None and given[name] is None):
            expect(name, given[name], Tensor)
    if backgrounds is not None:
        expect("backgrounds", backgrounds, Tensor)
    lead, count, views = means.shape[:-2], means.shape[-2], viewmats.shape[-3] if viewmats.dim() > 2 else 0
    if tuple(viewmats.shape) != (*lead, views, 4, 4) or tuple(Ks.shape) != (*lead, views, 3, 3):
        raise InputError(
            f"viewmats, Ks: expected {[*lead, 'C', 4, 4]} and {[*lead, 'C', 3, 3]} beside means {list(means.shape)}, "
            f"got {list(viewmats.shape)} and {list(Ks.shape)}"
        )

    # The fields, with one dimension of a batch or none
    def flat(tensor: Tensor) -> Tensor:
        return tensor.reshape(-1, *tensor.shape[len(lead) :]) if lead else tensor

    if covars is not None:  # quaternions and scales do not matter then
        quats, scales = torch.ones_like(means[..., :1]).expand(*means.shape[:-1], 4), torch.ones_like(means)
        covars = flat(covars)
    harmonics, drawn = _colours(colors, lead, views, count, sh_degree)
    by_gaussian = (means, quats, scales, opacities, harmonics)
    scene = from_tensors(flat(field).contiguous() for field in by_gaussian)
    cameras = Cameras(
        flat(viewmats),
        flat(Ks),
        width_px=width,
        height_px=height,
        model=_MODELS[camera_model],
        distortion=None if radial_coeffs is None else flat(radial_coeffs).to(viewmats),
    )
    screen = _Screen(scene, cameras, absgrad, (covars, backgrounds, *drawn.values()))
    behind: Any = (0.0, 0.0, 0.0)
    if backgrounds is not None and "features" not in drawn:
        behind = flat(backgrounds)
    options: dict[str, Any] = {name: flat(tensor) for name, tensor in drawn.items()}
    images = render(
        scene,
        cameras,
        background=behind,
        alpha=True,
        render_mode=render_mode,
        antialiased=rasterize_mode == "antialiased",
        near_plane=near_plane,
        far_plane=min(far_plane, _FARTHEST),
        radius_clip=radius_clip,
        eps2d=eps2d,
        covars=covars,
        screen=screen.tensor,
        radii=True,
        means2d=True,
        conics=True,
        tiles=True,
        sh_degree=sh_degree,
        **options,
    )

    def full(tensor: Tensor) -> Tensor:
        return tensor.reshape(*lead, *tensor.shape[1:]) if lead else tensor

    alphas = cast(Tensor, images.alpha).unsqueeze(-1)
    picture = images.image
    if images.features is not None and "RGB" in render_mode:
        picture = images.features
        if backgrounds is not None:
            picture = picture + (1 - alphas) * flat(backgrounds)[..., None, None, :]
        if "D" in render_mode:
            picture = torch.cat([picture, images.image[..., -1:]], -1)
    meta = _meta(images, scene, cameras, screen, packed, full)
    meta |= {"n_batches": max(1, lead.numel())}
    return full(picture), full(alphas), meta


_FARTHEST = 1e30


def _refuse(given: dict[str, Any]) -> None:
    """Raise InputError for arguments that would change the result and that nothing here honours."""
    for name, (usual, way_out) in _REFUSED.items():
        if given[name] is not usual and not (isinstance(usual, (int, bool)) and given[name] == usual):
            raise InputError(f"{name}: expected {shown(usual)}, got {shown(given[name])}: {way_out}")
    if getattr(given["rolling_shutter"], "name", "GLOBAL") != "GLOBAL":
        raise InputError(
            f"rolling_shutter: expected GLOBAL, got {given['rolling_shutter'].name}: use lightfield_gs.render"
        )
    for name, choices in (
        ("render_mode", RENDER_MODES),
        ("rasterize_mode", ("classic", "antialiased")),
        ("camera_model", tuple(_MODELS)),
    ):
        if given[name] not in choices:
            raise InputError(f"{name}: expected one of {', '.join(choices)}, got {shown(given[name])}")
    if given["radial_coeffs"] is not None and given["camera_model"] != "fisheye":
        raise InputError("radial_coeffs: expected none for cameras that are no fisheyes: undistort the photographs")


def _colours(
    colors: Tensor, lead: torch.Size, views: int, count: int, sh_degree: int | None
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the harmonics, and the colors or features of `render` that take their place.

    Raises:
        InputError: another shape.
    """
    own = (*lead, count), (*lead, views, count)
    if sh_degree is not None:
        if tuple(colors.shape[:-2]) != own[0] or colors.shape[-1] != 3:
            raise InputError(
                f"colors: expected harmonics {[*own[0], 'K', 3]} with sh_degree, got {list(colors.shape)}: give each "
                "camera its own by a call for each"
            )
        return colors, {}
    if tuple(colors.shape[:-1]) not in own or not colors.shape[-1]:
        raise InputError(
            f"colors: expected {[*own[0], 'D']} or {[*own[1], 'D']} without sh_degree, got {list(colors.shape)}"
        )
    none = colors.new_zeros(*lead, count, 1, 3)
    return none, {"colors" if colors.shape[-1] == 3 else "features": colors}


class _Screen:
    """The projected means of a drawing, whose gradients are there after backward as gsplat's are.

    Attributes:
        tensor: what `render` takes as screen; None without gradients.
        shown: the projected means of meta; a leaf, whose .grad and .absgrad backward sets.
    """

    def __init__(self, scene: Gaussians, cameras: Cameras, absgrad: bool, others: Iterable[Tensor | None]) -> None:
        """Prepare for gradients if one of the tensors asks for them; others: beside the scene's and the cameras'."""
        given = (*scene.tensors().values(), *cameras.tensors().values(), *others)
        tensors = [tensor for tensor in given if tensor is not None]
        lead = scene.means.shape[:-2]
        self.shape = (*lead, cameras.count, scene.count, 4 if absgrad else 2)
        self.absgrad, self.shown = absgrad, torch.empty(0)
        self.chosen: Tensor | None = None
        self.tensor: Tensor | None = None
        if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
            self.tensor = cast(Tensor, _Zeros.apply(scene.means.new_zeros((), requires_grad=True), self))

    def show(self, means2d: Tensor, chosen: Tensor | None, full: Callable[[Tensor], Tensor]) -> Tensor:
        """Keep and return the projected means; chosen: of packed ones, which they are."""
        self.chosen, self._full = chosen, full
        self.shown = self._as_shown(means2d).detach().clone()
        if self.tensor is not None:
            self.shown.requires_grad_()
        return self.shown

    def deliver(self, gradient: Tensor) -> None:
        """Set the gradients of what was shown."""
        place = self._as_shown(gradient[..., :2])
        self.shown.grad = place if self.shown.grad is None else self.shown.grad + place
        if self.absgrad:
            self.shown.absgrad = self._as_shown(gradient[..., 2:])  # type: ignore[attr-defined]

    def _as_shown(self, numbers: Tensor) -> Tensor:
        return self._full(numbers) if self.chosen is None else numbers[self.chosen]


class _Zeros(torch.autograd.Function):
    """Zeros on which no image depends, and which get the gradients of the projected means."""

    @staticmethod
    def forward(ctx: Any, leaf: Tensor, screen: _Screen) -> Tensor:
        ctx.screen = screen
        return leaf.new_zeros(screen.shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, None]:
        ctx.screen.deliver(gradient)
        return None, None


def _meta(
    images: RenderedImages,
    scene: Gaussians,
    cameras: Cameras,
    screen: _Screen,
    packed: bool,
    full: Callable[[Tensor], Tensor],
) -> dict[str, Any]:
    """Return gsplat's information on a drawing."""
    radii = cast(Tensor, images.radii)
    drawn = radii > 0
    means, opacities = scene.means.detach(), scene.opacities.detach()
    poses = cameras.world_to_camera.to(means)
    depths = (poses[..., 2, :3] @ means.mT) + poses[..., 2, 3:]
    numbers = {
        "radii": radii.ceil().to(torch.int32)[..., None].expand(*radii.shape, 2),
        "depths": depths,
        "conics": cast(Tensor, images.conics),
        "opacities": opacities[..., None, :].expand_as(radii),
        "tiles_per_gauss": cast(Tensor, images.tiles) * drawn,
    }
    chosen = drawn if packed else None
    ids: dict[str, Any] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if packed:
        places = drawn.nonzero().unbind(-1)
        ids |= {"camera_ids": places[-2], "gaussian_ids": places[-1]}
        ids["batch_ids"] = places[0] if len(places) == 3 else torch.zeros_like(places[-1])
    found = {name: full(value) if chosen is None else value[chosen] for name, value in numbers.items()}
    width, height = cast(int, cameras.width_px), cast(int, cameras.height_px)
    return {
        **ids,
        **found,
        "means2d": screen.show(cast(Tensor, images.means2d), chosen, full),
        "tile_width": -(-width // _TILE),
        "tile_height": -(-height // _TILE),
        "tile_size": _TILE,
        "width": width,
        "height": height,
        "n_cameras": cameras.count,
    }
