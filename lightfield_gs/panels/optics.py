"""The numbers of a panel and of its rig as tensors, for gradients through encode and simulate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, is_row, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.cells import cell_numbers, subpixel_offsets
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, edge_slopes

LENS = ("line_number", "slant_tan", "phase", "subpixel_cells")  # what decides the view of a sub-pixel
_OF_PANEL = (*LENS, "cone_deg")
_OF_RIG = ("world_to_camera", "focal_px", "principal_point_px", "zero_depth")
_SHAPES: dict[str, tuple[int, ...]] = {"world_to_camera": (4, 4), "focal_px": (2,), "principal_point_px": (2,)}


@dataclass(frozen=True, eq=False)
class Optics:
    """Numbers of a panel and its rig as tensors, each in place of the field of the same name. None: the field counts.

    Attributes:
        line_number: [], see Panel.
        slant_tan: [], see Panel.
        phase: [], sub-pixels, see Panel.
        subpixel_cells: [K, 3, 2], see Panel; only for a panel that has cells.
        cone_deg: [], degrees: of the rig's fan and of the panel.
        world_to_camera: [4, 4], see Rig.
        focal_px: [2], see Rig.
        principal_point_px: [2], see Rig.
        zero_depth: [], scene units, see Rig.

    Raises:
        InputError: A tensor has another shape, or no floating point numbers.
    """

    line_number: Tensor | None = None
    slant_tan: Tensor | None = None
    phase: Tensor | None = None
    subpixel_cells: Tensor | None = None
    cone_deg: Tensor | None = None
    world_to_camera: Tensor | None = None
    focal_px: Tensor | None = None
    principal_point_px: Tensor | None = None
    zero_depth: Tensor | None = None

    def __post_init__(self) -> None:
        for name, tensor in self.given().items():
            expect(f"optics: {name}", tensor, Tensor)
            shape = (len(tensor), 3, 2) if name == "subpixel_cells" and tensor.dim() else _SHAPES.get(name, ())
            if tuple(tensor.shape) != shape or not tensor.is_floating_point():
                raise InputError(
                    f"optics: {name} must be floating point numbers {list(shape)}, got {tensor.dtype} "
                    f"{list(tensor.shape)}"
                )

    @staticmethod
    def of(panel: Panel, rig: Rig | None = None, names: Sequence[str] | None = None) -> Optics:
        """Return these numbers of a panel and a rig as float64 tensors that ask for gradients.

        Args:
            panel: The panel.
            rig: Its rig; None: only the panel's numbers.
            names: Which; None: all that there are.

        Raises:
            InputError: A name is none of a number that there is.
        """
        expect("panel", panel, Panel)
        expect("rig", rig, Rig, type(None))
        known = {name: getattr(panel, name) for name in _OF_PANEL}
        if not panel.subpixel_cells:
            del known["subpixel_cells"]
        if rig is not None:
            known |= {name: getattr(rig, name) for name in _OF_RIG}
            known["cone_deg"] = panel.cone_deg if rig.cone_deg is None else rig.cone_deg
        if names is not None and not (is_row(names) and all(isinstance(name, str) for name in names)):
            raise InputError(f"optics: names: expected some of {', '.join(known)}, got {shown(names)}")
        names = tuple(known) if names is None else tuple(names)
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"optics: {', '.join(unknown)}: expected names of {', '.join(known)}")
        values = {name: torch.from_numpy(np.array(known[name], np.float64)) for name in names}
        return Optics(**{name: value.requires_grad_() for name, value in values.items()})

    def given(self) -> dict[str, Tensor]:
        """Return the tensors that are given, by name."""
        named = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    def panel(self, panel: Panel) -> Panel:
        """Return the panel with these values, without gradients. Raises InputError where one is out of its range."""
        values: dict[str, Any] = {name: tensor.tolist() for name, tensor in self.given().items() if name in _OF_PANEL}
        if "subpixel_cells" in values and not panel.subpixel_cells:
            raise InputError(f"optics: subpixel_cells are given, and panel {panel.name} has stripes: leave them out")
        return replace(panel, **values) if values else panel

    def rig(self, rig: Rig) -> Rig:
        """Return the rig with these values, without gradients. Raises InputError where one is out of its range."""
        names = (*_OF_RIG, "cone_deg")
        values: dict[str, Any] = {name: tensor.tolist() for name, tensor in self.given().items() if name in names}
        return replace(rig, **values) if values else rig

    # The same numbers as the rasterizer takes them

    def lens_numbers(self, panel: Panel) -> LensNumbers:
        """Return the lens of the panel, float64 on the CPU, differentiable."""
        line_number, slant, phase = (self._number(name, panel) for name in LENS[:3])
        if not panel.subpixel_cells:
            stripes = torch.from_numpy(subpixel_offsets(panel).astype(np.float64))
            return LensNumbers(line_number, slant, phase, stripes)
        x, y = self._number("subpixel_cells", panel).unbind(-1)
        kinds = cell_numbers(panel.cell_pattern, panel.cell_rule, panel.cell_rows, panel.height_px)
        return LensNumbers(line_number, slant, phase, (3 * x - 3 * slant * y)[torch.from_numpy(kinds)])

    def rig_numbers(self, panel: Panel, rig: Rig, view_filter: float) -> Tensor:
        """Return world_to_camera and the optics of the rig, [16 + RIG_OPTICS], float64 on the CPU, differentiable.

        csrc/math/projection.h lists the optics. view_filter: see encode.
        """
        pose, focal, centre, depth = (self._number(name, rig) for name in _OF_RIG)
        half_width = depth * self.half_cone_tan(panel if rig.cone_deg is None else rig)
        limits = edge_slopes(focal, centre, (panel.width_px, panel.height_px), half_width / depth)
        aperture = view_filter * (2 * half_width / panel.views) / math.sqrt(12)
        rest = *limits, torch.zeros_like(depth), half_width, 1 / depth, aperture
        return torch.cat([pose.reshape(-1), focal, centre, torch.stack(rest)])

    def half_cone_tan(self, of: Panel | Rig) -> Tensor:
        """Return the tangent of half the cone, float64, differentiable; of: whose cone counts where none is given."""
        return torch.tan(torch.deg2rad(self._number("cone_deg", of)) / 2)

    def _number(self, name: str, otherwise: Panel | Rig) -> Tensor:
        """Return a number as float64 on the CPU: the given one, or the field of `otherwise`."""
        tensor = getattr(self, name)
        if tensor is None:
            return torch.from_numpy(np.array(getattr(otherwise, name), np.float64))
        return tensor.to("cpu", torch.float64)


class LensNumbers(NamedTuple):
    """A lens, in sub-pixels.

    Attributes:
        line_number: [].
        slant_tan: [].
        phase: [].
        offsets: [PERIOD, PERIOD, 3], D of sub-pixels from D of their pixel, by row and column modulo PERIOD, and
            channel.
    """

    line_number: Tensor
    slant_tan: Tensor
    phase: Tensor
    offsets: Tensor
