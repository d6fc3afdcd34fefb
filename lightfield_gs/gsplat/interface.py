"""gsplat's `rasterization`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import RENDER_MODES, CameraModel, RenderMode
from lightfield_gs.gsplat.meta import TILE, Description, Meta, Screen
from lightfield_gs.gsplat.parts import SeenRows, check_group, check_same, gather_from_all
from lightfield_gs.rasterizer.images import find_splats, render_and_splats
from lightfield_gs.rasterizer.render_options import RenderOptions, with_sh_degree
from lightfield_gs.rasterizer.splat_shapes import is_drawn
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

_MODELS: dict[str, CameraModel] = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}
# Arguments whose other values are refused, and the way out
_REFUSED = {
    "with_ut": (
        False,
        "Gaussians are projected by the camera's Jacobian here; cameras of other models need no with_ut",
    ),
    "with_eval3d": (False, "Gaussians are evaluated on the screen here"),
    "tangential_coeffs": (None, "undistort the photographs, or use camera_model='fisheye'"),
    "thin_prism_coeffs": (None, "undistort the photographs, or use camera_model='fisheye'"),
    "ftheta_coeffs": (None, "use camera_model='fisheye' with radial_coeffs of 4 numbers"),
    "viewmats_rs": (None, "use lightfield_gs.render, whose Cameras have rolling shutters"),
    "tile_size": (TILE, "tiles have 16 x 16 pixels here"),
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
    tile_size: int = TILE,
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
) -> tuple[Tensor, Tensor, Meta]:
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
        near_plane, far_plane: only Gaussians of depths between them are drawn; near_plane is 0.01 or more. The default
            far_plane cuts nothing.
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
        with_ut, with_eval3d, tangential_coeffs, thin_prism_coeffs, ftheta_coeffs,
            viewmats_rs: only their defaults.
        sparse_grad: gradients of means, quats, scales and covars are sparse (COO), with the rows of Gaussians that a
            camera draws; so are those of opacities and colors that are leaves. It goes with packed, and with no batch.
            Only these Gaussians are sorted and drawn. See SelectiveAdam.
        distributed: each process of torch.distributed's group holds a part of the Gaussians and C cameras of its own,
            whose images it returns. Gradients go back to the parts. All processes have the same C, width, height and
            numbers of a Gaussian, and all of them run backward. meta is about this process's Gaussians before the
            cameras of all processes, in the order of ranks.
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
    lead, views = means.shape[:-2], viewmats.shape[-3] if viewmats.dim() > 2 else 0
    if tuple(viewmats.shape) != (*lead, views, 4, 4) or tuple(Ks.shape) != (*lead, views, 3, 3):
        raise InputError(
            f"viewmats, Ks: expected {[*lead, 'C', 4, 4]} and {[*lead, 'C', 3, 3]} beside means {list(means.shape)}, "
            f"got {list(viewmats.shape)} and {list(Ks.shape)}"
        )
    _refuse_parts(given, len(lead))

    def full(tensor: Tensor) -> Tensor:
        return tensor.reshape(*lead, *tensor.shape[1:]) if lead else tensor

    fields = _Fields(means, quats, scales, opacities, colors, covars)
    scene, own = fields.drawn(views, sh_degree)
    cameras = Cameras(
        _flat(viewmats, lead),
        _flat(Ks, lead),
        width_px=width,
        height_px=height,
        model=_MODELS[camera_model],
        distortion=None if radial_coeffs is None else _flat(radial_coeffs, lead).to(viewmats),
    )
    choice: dict[str, Any] = {
        "antialiased": rasterize_mode == "antialiased",
        "near_plane": near_plane,
        "far_plane": math.inf if far_plane >= _FARTHEST else far_plane,
        "radius_clip": radius_clip,
        "eps2d": eps2d,
    }
    everyone = _everyones(cameras, scene) if distributed else cameras
    screen = Screen(scene, everyone, absgrad, (covars, backgrounds, *own.values()))
    splats, parts, asked = None, scene, screen.tensor()
    if sparse_grad or distributed:
        splats = find_splats(scene, everyone, RenderOptions(**choice, covars=covars))
        seen = SeenRows(is_drawn(splats).unflatten(0, (-1, views)).any(1), distributed)
        fields, asked = _seen_fields(fields, seen, asked, sh_degree, views, sparse_grad)
        parts, own = fields.drawn(views, sh_degree)
    behind: Any = (0.0, 0.0, 0.0)
    if backgrounds is not None and "features" not in own:
        behind = _flat(backgrounds, lead)
    options = RenderOptions(alpha=True, render_mode=render_mode, **choice, **own)
    images, drawn = render_and_splats(with_sh_degree(parts, sh_degree), cameras, behind, options, asked)
    alphas = cast(Tensor, images.alpha).unsqueeze(-1)
    picture = images.image
    if images.features is not None and "RGB" in render_mode:
        picture = images.features
        if backgrounds is not None:
            picture = picture + (1 - alphas) * _flat(backgrounds, lead)[..., None, None, :]
        if "D" in render_mode:
            picture = torch.cat([picture, images.image[..., -1:]], -1)
    known = {
        "tile_width": -(-width // TILE),
        "tile_height": -(-height // TILE),
        "tile_size": TILE,
        "width": width,
        "height": height,
        "n_batches": max(1, lead.numel()),
        "n_cameras": cameras.count,
    }
    of_each = Description(drawn if splats is None else splats, scene, everyone, screen, packed, full)
    return full(picture), full(alphas), Meta({**known, **of_each.entries()})


_FARTHEST = 1e10  # gsplat's default, scene units: from it on nothing is cut


def _flat(tensor: Tensor, lead: torch.Size) -> Tensor:
    """Return a tensor [*lead, ...] with one dimension of a batch, or none where it has none."""
    return tensor.reshape(-1, *tensor.shape[len(lead) :]) if lead else tensor


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


def _refuse_parts(given: dict[str, Any], batches: int) -> None:
    """Raise InputError for arguments that do not go with sparse gradients, or with Gaussians in parts."""
    for name in ("sparse_grad", "distributed"):
        expect(name, given[name], bool)
        if given[name] and batches:
            raise InputError(f"{name}: expected tensors without dimensions of a batch: call it for each set")
    if given["sparse_grad"] and not given["packed"]:
        raise InputError("sparse_grad: expected packed=True with it")
    if given["distributed"]:
        check_group()
        if given["colors"].dim() != (2 if given["sh_degree"] is None else 3):
            raise InputError(
                "colors: expected [N, D], or harmonics with sh_degree, where Gaussians are distributed: colours of "
                "each camera are for Gaussians of one process"
            )


@dataclass
class _Fields:
    """Numbers of each Gaussian, as gsplat has them."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor
    covars: Tensor | None

    def drawn(self, views: int, sh_degree: int | None) -> tuple[Gaussians, dict[str, Any]]:
        """Return the Gaussians, and what `render` takes beside them, with one dimension of a batch or none.

        Args:
            views: C.
            sh_degree: see rasterization.

        Raises:
            InputError: colours of another shape.
        """
        means, lead = self.means, self.means.shape[:-2]
        quats, scales = self.quats, self.scales
        if self.covars is not None or quats is None or scales is None:  # quaternions and scales do not matter then
            quats, scales = torch.ones_like(means[..., :1]).expand(*means.shape[:-1], 4), torch.ones_like(means)
        harmonics, own = self._colours(views, sh_degree)
        if self.covars is not None:
            own["covars"] = self.covars
        every = means, quats, scales, self.opacities, harmonics
        scene = from_tensors(_flat(field, lead).contiguous() for field in every)
        return scene, {name: _flat(tensor, lead) for name, tensor in own.items()}

    def _colours(self, views: int, sh_degree: int | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the harmonics, and the colors or features of `render` that take their place. Raises InputError."""
        colors, lead, count = self.colors, self.means.shape[:-2], self.means.shape[-2]
        own = (*lead, count), (*lead, views, count)
        if sh_degree is not None:
            if tuple(colors.shape[:-2]) != own[0] or colors.shape[-1] != 3:
                raise InputError(
                    f"colors: expected harmonics {[*own[0], 'K', 3]} with sh_degree, got {list(colors.shape)}: give "
                    "each camera its own by a call for each"
                )
            return colors, {}
        if tuple(colors.shape[:-1]) not in own or not colors.shape[-1]:
            raise InputError(
                f"colors: expected {[*own[0], 'D']} or {[*own[1], 'D']} without sh_degree, got {list(colors.shape)}"
            )
        none = colors.new_zeros(*lead, count, 1, 3)
        return none, {"colors" if colors.shape[-1] == 3 else "features": colors}


def _everyones(cameras: Cameras, scene: Gaussians) -> Cameras:
    """Return the cameras of all processes, in the order of ranks, without gradients. Raises InputError."""
    tensors = cameras.tensors()
    facts = {
        "cameras": cameras.count,
        "width": cast(int, cameras.width_px),
        "height": cast(int, cameras.height_px),
        "camera model": cameras.model_number,
        "numbers of all cameras": sum(tensor.numel() for tensor in tensors.values()),
        "bytes of a number": scene.means.element_size(),
    }
    check_same(facts, scene.device)
    every: dict[str, Any] = {name: gather_from_all(tensor) for name, tensor in tensors.items()}
    return replace(cameras, **every)


def _seen_fields(
    fields: _Fields, seen: SeenRows, screen: Tensor | None, sh_degree: int | None, views: int, sparse: bool
) -> tuple[_Fields, Tensor | None]:
    """Return the Gaussians that this process's cameras see, of all processes, and their screen [C, M, 2 or 4].

    Args:
        fields: the Gaussians of this process.
        seen: which of them go where.
        screen: of these Gaussians before the cameras of all processes.
        sh_degree: see rasterization.
        views: C, of each process.
        sparse: whether gradients are sparse. Those of opacities and colours that are no leaves are dense all the same:
            torch's sigmoid and cat take no sparse ones.
    """
    own_colours = sh_degree is None and fields.colors.dim() == 3
    taken: dict[str, Tensor] = {}
    for name, tensor in vars(fields).items():
        if tensor is None or fields.covars is not None and name in ("quats", "scales"):
            continue
        if name == "colors" and own_colours:
            taken[name] = tensor[:, seen.rows].transpose(0, 1)
        else:
            taken[name] = seen.take(tensor, sparse and (tensor.is_leaf or name not in ("opacities", "colors")))
    if sh_degree is not None:
        taken["colors"] = taken["colors"][:, : (sh_degree + 1) ** 2]
    if screen is not None:
        before = seen.owners[:, None] * views + torch.arange(views, device=screen.device)
        taken["screen"] = screen[before, seen.rows[:, None]]
    came = seen.exchange(taken)
    if own_colours:
        came["colors"] = came["colors"].transpose(0, 1)
    asked = came.pop("screen").transpose(0, 1) if screen is not None else None
    return _Fields(**{**dict.fromkeys(vars(fields)), **came}), asked  # type: ignore[arg-type]
