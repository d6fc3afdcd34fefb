"""`encode` in a graph of torch.compile: torch.ops.lightfield_gs.encode_direct.

The numbers of panel and rig are arguments of the operator, and the camera is made of them whenever the graph runs. So
other numbers need no other graph. A compiler could not trace the exact arithmetic of lens phases.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CELL_ROWS, CELL_RULES, SUBPIXEL_ORDERS
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, lenticular_camera
from lightfield_gs.rasterizer.direct import (
    DrawnImage,
    SceneArguments,
    draw_sub_pixels,
    fake_sub_pixel_gradients,
    sub_pixel_gradients,
)
from lightfield_gs.rasterizer.operators import operator_schema, register_operator


class EncodeArguments(NamedTuple):
    """The arguments of encode_direct behind those of the scene.

    Attributes:
        world_to_camera: [4, 4] float64, of the rig, on the CPU.
        numbers: [11] float64 on the CPU: the panel's line_number, slant_tan, phase and cone_deg, the rig's focal_px,
            principal_point_px, zero_depth and cone_deg (NaN: the panel's), and view_filter.
        width_px, height_px, views, subpixel_order, invert_views, cell_pattern, cell_rule, cell_rows: Of the panel;
            words by their places in base/options.py.
        cells: Its subpixel_cells, one number after the other.
        continuous: Whether views are.
        antialiased: See encode.
    """

    world_to_camera: Tensor
    numbers: Tensor
    width_px: int
    height_px: int
    views: int
    subpixel_order: int
    invert_views: bool
    cell_pattern: int
    cell_rule: int
    cell_rows: int
    cells: list[float]
    continuous: bool
    antialiased: bool

    def for_render_direct(self) -> tuple[Any, ...]:
        """Return the arguments of render_direct behind those of the scene.

        Raises:
            InputError: no panel or rig has these values.
        """
        line_number, slant_tan, phase, panel_cone, fx, fy, cx, cy, depth, cone, view_filter = self.numbers.tolist()
        rows = iter(self.cells)
        points = list(zip(rows, rows))
        panel = Panel(
            self.width_px,
            self.height_px,
            self.views,
            line_number,
            slant_tan,
            phase,
            SUBPIXEL_ORDERS[self.subpixel_order],
            self.invert_views,
            panel_cone,
            subpixel_cells=tuple((points[k], points[k + 1], points[k + 2]) for k in range(0, len(points), 3)),
            cell_pattern=self.cell_pattern,
            cell_rule=CELL_RULES[self.cell_rule],
            cell_rows=CELL_ROWS[self.cell_rows],
        )
        own_cone = None if math.isnan(cone) else cone
        rig = Rig(self.world_to_camera.numpy(), (fx, fy), (cx, cy), depth, own_cone)
        return (*lenticular_camera(panel, rig, self.continuous, view_filter).numbers(), self.antialiased)


_SCENE = len(SceneArguments._fields)
_COUNT = _SCENE + len(EncodeArguments._fields)


def _for_render_direct(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the arguments of render_direct, and what follows those of encode_direct."""
    lens = EncodeArguments(*arguments[_SCENE:_COUNT]).for_render_direct()
    return (*arguments[:_SCENE], *lens, *arguments[_COUNT:])


def _draw(*arguments: Any) -> Tensor:
    return draw_sub_pixels(*_for_render_direct(arguments))


def _fake(*arguments):
    given = EncodeArguments(*arguments[_SCENE:])
    return arguments[0].new_empty((given.height_px, given.width_px, 3))


def _gradients(*arguments: Any) -> tuple[Tensor, ...]:
    """Return the gradients of the first six arguments. arguments: also the image, and the gradient of that."""
    return sub_pixel_gradients(*_for_render_direct(arguments))


_encode_direct_backward = register_operator(
    "encode_direct_backward",
    operator_schema(SceneArguments, EncodeArguments, DrawnImage, outputs=6),
    _gradients,
    fake_sub_pixel_gradients,
    batches=False,
)


def _setup_context(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:8], output)
    ctx.options = inputs[8:]


def _backward(ctx, grad):
    *tensors, image = ctx.saved_tensors
    found = _encode_direct_backward(*tensors, *ctx.options, image, grad)
    return (*found, *(None for _ in range(_COUNT - len(found))))


_encode_direct = register_operator(
    "encode_direct",
    operator_schema(SceneArguments, EncodeArguments, outputs=1),
    _draw,
    _fake,
    _setup_context,
    _backward,
    batches=False,
)


def encode_in_graph(
    fields: tuple[Tensor, ...],
    background: Tensor,
    panel: Panel,
    rig: Rig,
    continuous: bool,
    view_filter: float,
    antialiased: bool,
) -> Tensor:
    """Return the image [H, W, 3] of render_direct, in one call of an operator that a compiler can trace.

    Args:
        fields: means, quaternions, scales, opacities and sh of one scene.
        background: [3].
        panel: see encode, also for the others.

    Raises:
        InputError: in a strict torch.export, which makes the array of the rig a constant of zeros.
    """
    # The compiler of torch 2.11 takes is_exporting() for True everywhere
    if torch.compiler.is_dynamo_compiling() and torch.compiler._is_exporting_flag:
        raise InputError("encode: expected a torch.export with strict=False, its default; got a strict one")
    cone = math.nan if rig.cone_deg is None else rig.cone_deg
    of_panel = panel.line_number, panel.slant_tan, panel.phase, panel.cone_deg
    numbers = [*of_panel, *rig.focal_px, *rig.principal_point_px, rig.zero_depth, cone, view_filter]
    return _encode_direct(
        *fields,
        background,
        torch.from_numpy(rig.world_to_camera),
        torch.tensor(numbers, dtype=torch.float64),
        panel.width_px,
        panel.height_px,
        panel.views,
        SUBPIXEL_ORDERS.index(panel.subpixel_order),
        panel.invert_views,
        panel.cell_pattern,
        CELL_RULES.index(panel.cell_rule),
        CELL_ROWS.index(panel.cell_rows),
        [number for cell in panel.subpixel_cells for point in cell for number in point],
        continuous,
        antialiased,
    )
