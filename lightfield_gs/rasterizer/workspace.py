"""The stages of a render, and their buffers, whatever device they are on."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.rasterizer.lens_view import NativeView
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.scene import Scene, State
from lightfield_gs.rasterizer.stats import Stats


class Splats:
    """Projected Gaussians of `images` images: what `project` writes and all later stages read."""

    def __init__(
        self, scene: Scene, images: int, colour_order: int, with_orders: bool, compensated: bool, state: State | None
    ):
        """Memory for them, or what a render left of them in `state`.

        colour_order: highest order of the polynomials that give the colours of a light field over the rig; 0 for one
        colour each. with_orders: whether each Gaussian may have a lower order of its own. compensated: whether they are
        those of an anti-aliased light field, whose opacities change over the rig.
        """
        n, self.colour_order = scene.count, colour_order
        if state is None:
            self.splats, self.colours = (scene.new(*shape) for shape in State.shapes(images, n, colour_order))
        else:
            self.splats, self.colours = state.splats, state.colours
        self.orders = scene.new(images, n if with_orders else 0, dtype=torch.int32)
        self.compensations = scene.new(n, _core.COMPENSATION_FIELDS) if compensated else None
        self.native = scene.core.Splats(
            images,
            n,
            colour_order,
            self.splats.data_ptr(),
            self.colours.data_ptr(),
            self.orders.data_ptr(),
            0 if self.compensations is None else self.compensations.data_ptr(),
        )

    def buffers(self) -> list[Tensor]:
        extra = [] if self.compensations is None else [self.compensations]
        return [self.splats, self.colours, self.orders, *extra]


class Wanted(NamedTuple):
    """Which gradients of ordinary images are asked for beside those of the five fields and of the background.

    screen_numbers: 0; 2 for the places of the splats, in 1 / pixels; 4 for these and the sums of absolute values.
    """

    screen_numbers: int = 0
    cameras: bool = True

    @property
    def absolute(self) -> bool:
        return self.screen_numbers == 4


class DenseGradients(NamedTuple):
    """Gradients of ordinary images: of the five fields; of the background in parts [I * parts, 3]; of the cameras
    [I, 4, 4], or of none; and of the splats' places [I, N, screen_numbers]."""

    fields: list[Tensor]
    background_parts: Tensor
    cameras: Tensor
    screen: Tensor


class Workspace(Protocol):
    """A render in the making: project_dense or project_lens comes first, then order_and_bin, then a composite or its
    reverse.

    The lists of a render hold pairs: a *pair* is a splat and a tile (on the CPU a band of rows) that it may touch.
    """

    stats: Stats
    splats: Splats
    pair_count: int
    pairs_on_device: Tensor

    def state(self) -> State:
        """What a reverse needs."""

    def project_dense(self, cameras: _core.float32.Cameras) -> None:
        """Makes the splats of I images, one for each camera."""

    def project_lens(self, view: NativeView, quality: Quality) -> float:
        """Makes the splats of one light-field image. Returns the largest estimated error of a colour, in 0..1."""

    def order_and_bin(self, admit: Callable[[], bool] = ...) -> bool:
        """Sorts the splats by depth and lists the pairs. admit: asked, once `pair_count` is known and before memory is
        taken for the lists, whether to go on; returns its answer."""

    def composite_dense(self, cameras: _core.float32.Cameras, background: Tensor, out: _core.float32.Images) -> None:
        """background: [I, 3]; out: the core's DenseImages."""

    def composite_lens(self, view: NativeView, quality: Quality, background: Tensor, out: Tensor) -> None:
        """background: [3]; out: [H, W, 3]."""

    def dense_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        wanted: Wanted,
    ) -> DenseGradients:
        """The gradients that follow from those of images."""

    def lens_backward(
        self, view: NativeView, background: Tensor, image: Tensor, g_image: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Gradients of the five fields, and of the background in parts [parts, 3]."""
