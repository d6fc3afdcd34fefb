"""The lens of a panel as the native code takes it: two lists of numbers, which operators carry, and what they make."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.cells import cell_table

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel

_SIZES = (8, 8 + 2 * _core.CELL_SUBPIXELS)  # of the first list: of stripes, of cells


def lens_lists(
    panel: Panel, continuous: bool = False, offset_start: float = 0.0, offset_step: float = 0.0
) -> tuple[list[int], list[float]]:
    """lens and lens_shape as torch.ops.lightfield_gs.render_lens takes them; see there."""
    start, across, down = panel.phase_steps()
    phase, cells = panel.phase, []
    if panel.subpixel_cells:
        table = cell_table(panel)
        start, phase = start + table.shift, phase + table.shift_subpixels
        cells = [*table.phases.reshape(-1).tolist(), *table.channels.reshape(-1).tolist()]
    numbers = [
        panel.width_px,
        panel.height_px,
        panel.views,
        *map(_signed, (start, across, down)),
        int(panel.subpixel_order == "BGR"),
        int(continuous),
        *map(_signed, cells),
    ]
    return numbers, [float(v) for v in (panel.line_number, panel.slant_tan, phase, offset_start, offset_step)]


def slow_way(panel: Panel, lattices_on_cuda: bool) -> str | None:
    """What `direct` cannot do for a panel because of its sub-pixel cells, and hence takes longer; None: nothing.

    lattices_on_cuda: whether a frame with lattices is to be drawn on CUDA.
    """
    if not panel.subpixel_cells:
        return None
    lens = native_lens(*lens_lists(panel))
    if not (lens.stands_in_order() and lens.has_one_order()):
        return (
            f"the sub-pixel cells of panel {panel.name} have no one order along the lens: it is drawn by slower "
            "ways, on the CPU a sub-pixel at a time, on CUDA by tiles of pixels, and without lattices"
        )
    if lattices_on_cuda:
        return "panels with sub-pixel cells are drawn without lattices on CUDA: this quality saves little time"
    return None


def _signed(phase: int) -> int:
    """A 64-bit pattern as the signed integer that operators carry."""
    phase %= 1 << 64
    return phase - (1 << 64) if phase >= 1 << 63 else phase


def native_lens(lens: list[int], lens_shape: list[float]) -> Any:
    """The core's Lens from the two lists. Raises InputError for what they cannot be."""
    if len(lens) not in _SIZES or len(lens_shape) != 5:
        raise InputError(
            f"lens must be {_SIZES[0]} or {_SIZES[1]} integers and lens_shape 5 numbers, got {len(lens)} "
            f"and {len(lens_shape)}"
        )
    width, height, views, *phases, bgr, continuous = lens[:8]
    line_number, slant_tan, phase, offset_start, offset_step = lens_shape
    if not (1 <= width <= 65536 and 1 <= height <= 65536 and 1 <= views <= 65536 and line_number > 0):
        raise InputError(
            f"a lens needs sizes and views of 1..65536 and a line number > 0, got {lens[:3]} and {line_number}"
        )
    cell_phases, channels = lens[8 : 8 + _core.CELL_SUBPIXELS], lens[8 + _core.CELL_SUBPIXELS :]
    if any(sorted(channels[m : m + 3]) != [0, 1, 2] for m in range(0, len(channels), 3)):
        raise InputError(f"lens: every pixel of the cells must have the channels 0, 1 and 2 once, got {channels}")
    phase0, phase_x, phase_y = (p % 2**64 for p in phases)
    return _core.Lens(
        width_px=width,
        height_px=height,
        views=views,
        phase0=phase0,
        phase_x=phase_x,
        phase_y=phase_y,
        line_number=line_number,
        slant_tan=slant_tan,
        phase=phase,
        bgr=bool(bgr),
        continuous=bool(continuous),
        offset_start=offset_start,
        offset_step=offset_step,
        cell_phases=[p % 2**64 for p in cell_phases],
        cell_channels=channels,
    )
