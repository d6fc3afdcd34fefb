"""What `rasterization` says about a drawing beside its images: gsplat's meta, and gradients of projected means."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable, Iterable
from functools import cached_property, partial
from typing import Any, cast

import torch
from torch import Tensor

from lightfield_gs.rasterizer.splat_shapes import splat_conics, splat_means, splat_radii, splat_tiles
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

TILE = 16  # side of the tiles, pixels


class Screen:
    """The projected means of a drawing, whose gradients are there after backward as gsplat's are.

    Attributes:
        has_gradients: whether backward sets gradients.
        shown: the projected means of meta; a leaf, whose .grad and .absgrad backward sets. None: nobody has read them.
    """

    def __init__(self, scene: Gaussians, cameras: Cameras, absgrad: bool, others: Iterable[Tensor | None]) -> None:
        """Prepare for gradients if one of the tensors asks for them; others: beside the scene's and the cameras'."""
        given = (*scene.tensors().values(), *cameras.tensors().values(), *others)
        tensors = [tensor for tensor in given if tensor is not None]
        lead = scene.means.shape[:-2]
        self.shape = (*lead, cameras.count, scene.count, 4 if absgrad else 2)
        self.absgrad = absgrad
        self.shown: Tensor | None = None
        self._early: Tensor | None = None
        self.has_gradients = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
        self._like = scene.means.detach()

    def tensor(self) -> Tensor | None:
        """Return what `render` takes as screen; None without gradients.

        It is not kept: it holds this object by its graph, and a circle would keep the drawing's memory for long.
        """
        if not self.has_gradients:
            return None
        return cast(Tensor, _Zeros.apply(self._like.new_zeros((), requires_grad=True), self))

    def show(self, means2d: Tensor, chosen: Tensor | None, full: Callable[[Tensor], Tensor]) -> Tensor:
        """Keep and return the projected means; chosen: of packed ones, which they are."""
        self._chosen, self._full = chosen, full
        self.shown = self._as_shown(means2d).detach().clone()
        if self.has_gradients:
            self.shown.requires_grad_()
        if self._early is not None:
            self.deliver(self._early)
        return self.shown

    def deliver(self, gradient: Tensor) -> None:
        """Set the gradients of what is shown, or keep them for it."""
        if self.shown is None:
            self._early = gradient if self._early is None else self._early + gradient
            return
        place = self._as_shown(gradient[..., :2])
        self.shown.grad = place if self.shown.grad is None else self.shown.grad + place
        if self.absgrad:
            self.shown.absgrad = self._as_shown(gradient[..., 2:])  # type: ignore[attr-defined]

    def _as_shown(self, numbers: Tensor) -> Tensor:
        return self._full(numbers) if self._chosen is None else numbers[self._chosen]


class _Zeros(torch.autograd.Function):
    """Zeros on which no image depends, and which get the gradients of the projected means."""

    @staticmethod
    def forward(ctx: Any, leaf: Tensor, screen: Screen) -> Tensor:
        ctx.screen = screen
        return leaf.new_zeros(screen.shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, None]:
        ctx.screen.deliver(gradient)
        return None, None


class Later:
    """An entry of Meta that is made when it is read for the first time."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self._make = make

    @cached_property
    def value(self) -> Any:
        """The entry."""
        return self._make()


class Meta(UserDict[str, Any]):
    """gsplat's meta, of which an entry may be a Later: few loops read all tensors."""

    def __getitem__(self, name: str) -> Any:
        """Return an entry."""
        entry = self.data[name]
        return entry.value if isinstance(entry, Later) else entry

    def __repr__(self) -> str:
        """Return all entries as a dict shows them."""
        return repr(dict(self))

    def __reduce__(self) -> tuple[type[Meta], tuple[dict[str, Any]]]:
        """Return what pickle writes: all entries as they are."""
        return Meta, (dict(self),)


class Description:
    """What gsplat's meta has of each Gaussian before each camera.

    Args:
        splats: [..., C, N, SPLAT_FIELDS], without gradients.
        scene: the Gaussians.
        cameras: that see them.
        screen: of the drawing.
        packed: whether the Gaussians that are drawn stand one after the other.
        full: gives what is not packed its dimensions of a batch.
    """

    def __init__(
        self,
        splats: Tensor,
        scene: Gaussians,
        cameras: Cameras,
        screen: Screen,
        packed: bool,
        full: Callable[[Tensor], Tensor],
    ) -> None:
        self._splats, self._cameras, self._screen, self._packed, self._full = splats, cameras, screen, packed, full
        self._means, self._opacities = scene.means.detach(), scene.opacities.detach()

    def entries(self) -> dict[str, Later]:
        """Return the entries."""
        shown = {
            "radii": lambda: self._radii.ceil().to(torch.int32)[..., None].expand(*self._radii.shape, 2),
            "depths": self._depths,
            "conics": lambda: splat_conics(self._splats),
            "opacities": lambda: self._opacities[..., None, :].expand_as(self._radii),
            "tiles_per_gauss": self._tiles,
        }
        ids = ("batch_ids", "camera_ids", "gaussian_ids")
        found: dict[str, Callable[[], Any]] = {name: partial(self._id, name) for name in ids}
        found |= {name: partial(self._chosen, make) for name, make in shown.items()}
        return {name: Later(make) for name, make in found.items()} | {"means2d": Later(self._means2d)}

    @cached_property
    def _radii(self) -> Tensor:
        return splat_radii(self._splats)

    @cached_property
    def _drawn(self) -> Tensor:
        return self._radii > 0

    @cached_property
    def _places(self) -> tuple[Tensor, ...]:
        return self._drawn.nonzero().unbind(-1)

    def _id(self, name: str) -> Tensor | None:
        if not self._packed:
            return None
        *batch, camera, gaussian = self._places
        if name == "batch_ids":
            return batch[0] if batch else torch.zeros_like(gaussian)
        return camera if name == "camera_ids" else gaussian

    def _depths(self) -> Tensor:
        poses = self._cameras.world_to_camera.detach().to(self._means)
        return (poses[..., 2, :3] @ self._means.mT) + poses[..., 2, 3:]

    def _tiles(self) -> Tensor:
        size = self._cameras.width_px, self._cameras.height_px
        return splat_tiles(self._splats, *cast(tuple[int, int], size)) * self._drawn

    def _means2d(self) -> Tensor:
        return self._screen.show(splat_means(self._splats), self._drawn if self._packed else None, self._full)

    def _chosen(self, make: Callable[[], Tensor]) -> Tensor:
        value = make()
        return value[self._places] if self._packed else self._full(value)
