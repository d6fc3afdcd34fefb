"""What `rasterization` says about a drawing beside its images: gsplat's meta, and gradients of projected means."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, cast

import torch
from torch import Tensor

from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

TILE = 16  # side of the tiles, pixels


class Screen:
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
    def forward(ctx: Any, leaf: Tensor, screen: Screen) -> Tensor:
        ctx.screen = screen
        return leaf.new_zeros(screen.shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, None]:
        ctx.screen.deliver(gradient)
        return None, None


def describe(
    numbers: dict[str, Tensor],
    scene: Gaussians,
    cameras: Cameras,
    screen: Screen,
    packed: bool,
    full: Callable[[Tensor], Tensor],
) -> dict[str, Any]:
    """Return what gsplat's meta has of each Gaussian before each camera.

    Args:
        numbers: radii, means2d, conics and tiles of `render`.
        scene: the Gaussians.
        cameras: that see them.
        screen: of the drawing.
        packed: whether the Gaussians that are drawn stand one after the other.
        full: gives what is not packed its dimensions of a batch.
    """
    radii = numbers["radii"]
    drawn = radii > 0
    means, opacities = scene.means.detach(), scene.opacities.detach()
    poses = cameras.world_to_camera.detach().to(means)
    depths = (poses[..., 2, :3] @ means.mT) + poses[..., 2, 3:]
    shown = {
        "radii": radii.ceil().to(torch.int32)[..., None].expand(*radii.shape, 2),
        "depths": depths,
        "conics": numbers["conics"],
        "opacities": opacities[..., None, :].expand_as(radii),
        "tiles_per_gauss": numbers["tiles"] * drawn,
    }
    chosen = drawn if packed else None
    ids: dict[str, Any] = {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
    if packed:
        places = drawn.nonzero().unbind(-1)
        ids |= {"camera_ids": places[-2], "gaussian_ids": places[-1]}
        ids["batch_ids"] = places[0] if len(places) == 3 else torch.zeros_like(places[-1])
    found = {name: full(value) if chosen is None else value[chosen] for name, value in shown.items()}
    return {**ids, **found, "means2d": screen.show(numbers["means2d"], chosen, full)}
