"""What `render` may draw beside colours, and which Gaussians it leaves out: its options, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from lightfield_gs.base.arrays import check_tensor, is_eager, to_tensor
from lightfield_gs.base.checks import expect, real_number, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import RENDER_MODES, RenderMode
from lightfield_gs.rasterizer.torch_projection import MODELS
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, check_finite

BLUR = 0.3  # px^2, csrc/math/constants.h
NEAREST = 0.01  # csrc/math/constants.h: nothing nearer is drawn
_FARTHEST = 1e30
_ASYMMETRY = 1e-4  # of covariances, as a fraction of the largest number


@dataclass(frozen=True)
class RenderOptions:
    """The options of `render` that have the same meaning for every camera model; see render for all of them."""

    alpha: bool = False
    depth: bool = False
    radii: bool = False
    antialiased: bool = False
    render_mode: RenderMode = "RGB"
    features: Tensor | None = None
    colors: Tensor | None = None
    masks: Tensor | None = None
    near_plane: float = NEAREST
    far_plane: float = math.inf
    radius_clip: float = 0.0
    normals: bool = False
    median_depth: bool = False
    means2d: bool = False
    conics: bool = False
    tiles: bool = False
    covars: Tensor | None = None
    eps2d: float = BLUR
    splats: bool = False  # for render_and_splats

    def __post_init__(self) -> None:
        """Check what needs neither Gaussians nor cameras. Raises InputError."""
        flags = "alpha", "depth", "antialiased", "radii", "normals", "median_depth", "means2d", "conics", "tiles"
        for name in flags:
            expect(name, getattr(self, name), bool)
        if self.render_mode not in RENDER_MODES:
            raise InputError(f"render_mode: expected one of {', '.join(RENDER_MODES)}, got {shown(self.render_mode)}")
        near = real_number("near_plane", self.near_plane, NEAREST, _FARTHEST)
        if self.far_plane != math.inf:
            real_number("far_plane", self.far_plane, near, _FARTHEST)
        real_number("radius_clip", self.radius_clip, 0.0, 1e6)
        real_number("eps2d", self.eps2d, 0.0, 1e6)
        if self.covars is not None and self.normals:
            raise InputError(
                "normals: they are the shortest axes of scales and quaternions, and covars have none: leave normals out"
            )

    def checked(self, gaussians: Gaussians, cameras: Cameras) -> RenderOptions:
        """Return these options with tensors checked: [..., C or 1, N, ...]. Raises InputError."""
        found: dict[str, Any] = {}
        for name, last in (("features", "D"), ("colors", 3)):
            if (value := getattr(self, name)) is not None:
                found[name] = _per_gaussian(name, value, gaussians, cameras.count, (last,))
        if self.covars is not None:
            found["covars"] = _checked_covariances(self.covars, gaussians)
        if self.by_torch and (cameras.model not in MODELS or cameras.rolling_shutter != "none"):
            name = "eps2d" if self.covars is None else "covars"
            got = cameras.model if cameras.model not in MODELS else "a rolling shutter"
            raise InputError(
                f"{name}: expected cameras of the models {' or '.join(MODELS)}, got {got}: leave {name} out"
            )
        if self.masks is not None:
            found["masks"] = _per_gaussian("masks", self.masks, gaussians, cameras.count, (), torch.bool)
        return replace(self, **found)

    def for_cameras(self, change: Any) -> RenderOptions:
        """Return these options with the tensors that differ between cameras, [..., C, N, ...], changed.

        Args:
            change: from a tensor and its dimension of cameras to a tensor.
        """
        found = {}
        for name, dimension in (("features", -3), ("colors", -3), ("masks", -2)):
            value = getattr(self, name)
            if value is not None and value.shape[dimension] > 1:
                found[name] = change(value, dimension)
        return replace(self, **found)

    def with_set(self) -> RenderOptions:
        """Return these options with tensors [1, ...], for a set of one scene."""
        given = {name: getattr(self, name) for name in ("features", "colors", "masks", "covars")}
        return replace(self, **{name: tensor.unsqueeze(0) for name, tensor in given.items() if tensor is not None})

    @property
    def by_splats(self) -> bool:
        """Whether the stages have to be operators of their own: splat_render."""
        cuts = self.near_plane > NEAREST or self.far_plane < math.inf or self.radius_clip > 0
        if self.by_torch:
            return True
        tensors = (self.features, self.colors, self.masks)
        return cuts or self.normals or self.median_depth or any(t is not None for t in tensors)

    @property
    def by_torch(self) -> bool:
        """Whether torch projects the Gaussians: torch_projection."""
        return self.covars is not None or self.eps2d != BLUR

    @property
    def reads_splats(self) -> bool:
        """Whether splats, or numbers of them, are asked for."""
        return self.splats or self.radii or self.means2d or self.conics or self.tiles


def _per_gaussian(
    name: str,
    value: object,
    gaussians: Gaussians,
    cameras: int,
    last: tuple[Any, ...],
    dtype: torch.dtype | None = None,
) -> Tensor:
    """Return numbers of each Gaussian [..., N, *last], or of each before each camera [..., C, N, *last], as
    [..., C or 1, N, *last].

    Args:
        name: in messages.
        value: the numbers.
        gaussians: N of them, in sets or not.
        cameras: C.
        last: sizes of the last dimensions; "D" is any size from 1 on.
        dtype: None: that of the Gaussians, finite.

    Raises:
        InputError: other shapes, types, devices, or values on the CPU.
    """
    expect(name, value, Tensor)
    value = to_tensor(name, cast(Tensor, value), meta=True)
    sizes = tuple(value.shape[-1] if size == "D" and value.dim() and value.shape[-1] else size for size in last)
    lead, count = tuple(gaussians.means.shape[:-2]), gaussians.count
    shared, own = (*lead, count, *sizes), (*lead, cameras, count, *sizes)
    if tuple(value.shape) not in (shared, own):
        wanted = " or ".join(str([*lead, *each, count, *last]).replace("'", "") for each in ((), (cameras,)))
        raise InputError(
            f"{name}: expected {wanted}: of {count} Gaussians, or for each of {cameras} cameras its own; "
            f"got {list(value.shape)}"
        )
    check_tensor(name, value, tuple(value.shape), dtype or gaussians.dtype, gaussians.device)
    if dtype is None and not value.is_cuda:
        check_finite(name, value)
    return value if tuple(value.shape) == own and value.dim() > len(shared) else value.unsqueeze(len(lead))


def _checked_covariances(covars: Tensor, gaussians: Gaussians) -> Tensor:
    """Return covariances [..., N, 3, 3] contiguous. Raises InputError; values on CUDA are not checked."""
    expect("covars", covars, Tensor)
    shape = (*gaussians.means.shape[:-1], 3, 3)
    check_tensor("covars", to_tensor("covars", covars, meta=True), shape, gaussians.dtype, gaussians.device)
    if covars.is_cuda or not covars.numel() or not is_eager((covars,)):
        return covars
    check_finite("covars", covars)
    with torch.no_grad():
        least, most = torch.linalg.eigvalsh((covars + covars.mT) / 2)[..., 0], covars.abs().amax((-1, -2))
        bad = ((covars - covars.mT).abs().amax((-1, -2)) > _ASYMMETRY * most) | (least < -_ASYMMETRY * most)
    if bool(bad.any()):
        index = tuple(int(i) for i in bad.nonzero()[0])
        raise InputError(
            f"covars{list(index)}: expected a symmetric matrix without negative eigenvalues, got "
            f"{shown(covars[index].tolist())}"
        )
    return covars


def with_sh_degree(gaussians: Gaussians, degree: int | None) -> Gaussians:
    """Return Gaussians of this degree of harmonics, 0 to that which they have. Raises InputError."""
    if degree is None:
        return gaussians
    if (stored := gaussians.sh_degree) < (asked := whole_number("sh_degree", degree, 0, 3)):
        raise InputError(f"sh_degree: expected 0..{stored}, the degree of these Gaussians, got {asked}")
    return gaussians if asked == stored else replace(gaussians, sh=gaussians.sh[..., : (asked + 1) ** 2, :])
