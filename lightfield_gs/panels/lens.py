"""The lens of a panel, and the cameras of a rig behind it, as values of the rasterizer."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lightfield_gs.panels.panel import LENS_WIDTH, Panel, subpixel_offsets, subpixel_phases
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.image_render import PINHOLE, Aperture
from lightfield_gs.rasterizer.lenticular_camera import Lens, LenticularCamera


class CellTable(NamedTuple):
    """Phases and channels of the sub-pixels of a panel with cells, as the native lens takes them.

    Each array is [PERIOD, PERIOD, 3], by row, column and rank k, left to right in D.

    Attributes:
        phases: uint64, 2^-64 lens widths, beyond the phases of stripe k of a lens that begins `shift` later.
        channels: int64, the image channel at k.
        shift: 2^-64 lens widths, the middle of the sub-pixels' shifts.
        shift_subpixels: The same in sub-pixels.
    """

    phases: np.ndarray
    channels: np.ndarray
    shift: int
    shift_subpixels: float


@lru_cache(maxsize=64)
def cell_table(panel: Panel) -> CellTable:
    """Return the cell table of a panel with cells."""
    offsets = subpixel_offsets(panel)
    channels = np.argsort(offsets.astype(np.float64), axis=-1, kind="stable")
    beyond = np.take_along_axis(offsets, channels, -1) - np.arange(3)  # the stripe of the same rank
    shift = (beyond.min() + beyond.max()) / 2
    whole = round(shift * LENS_WIDTH / Fraction(panel.line_number)) % LENS_WIDTH
    step = panel.phase_steps()[1]
    stripes = np.array([(k * step + whole) % LENS_WIDTH for k in range(3)], np.uint64)
    phases = np.take_along_axis(subpixel_phases(panel), channels, -1) - stripes
    return CellTable(phases, channels, whole, float(shift))


def panel_lens(panel: Panel, continuous: bool = False, offset_start: float = 0.0, offset_step: float = 0.0) -> Lens:
    """Return the panel's lens before a row of cameras.

    Args:
        panel: The panel.
        continuous: Whether sub-pixels see the view at x itself, not the nearest integer view.
        offset_start: Offset of the camera of view 0, scene units.
        offset_step: Offset from view to view, scene units.
    """
    start, across, down = panel.phase_steps()
    phase, phases, channels = panel.phase, (), ()
    if panel.subpixel_cells:
        table = cell_table(panel)
        start, phase = start + table.shift, phase + table.shift_subpixels
        phases, channels = (tuple(part.reshape(-1).tolist()) for part in (table.phases, table.channels))
    return Lens(
        panel.width_px,
        panel.height_px,
        panel.views,
        (start % LENS_WIDTH, across, down),
        float(panel.line_number),
        float(panel.slant_tan),
        float(phase),
        panel.subpixel_order == "BGR",
        continuous,
        float(offset_start),
        float(offset_step),
        phases,
        channels,
    )


def view_aperture(panel: Panel, rig: Rig, view_filter: float) -> Aperture:
    """Return the aperture of each camera of a rig for encode's view_filter: a box of that many views."""
    step = 2 * rig.half_width(panel) / panel.views
    return Aperture(view_filter * step / math.sqrt(12), float(rig.zero_depth)) if view_filter > 0 else PINHOLE


def lenticular_camera(panel: Panel, rig: Rig, continuous: bool = False, view_filter: float = 0.0) -> LenticularCamera:
    """Return the cameras and the lens by which the sub-pixels of a panel see a scene.

    Args:
        panel: The panel.
        rig: Its rig.
        continuous: See panel_lens.
        view_filter: See encode.
    """
    start, end = float(rig.offset(0, panel)), float(rig.offset(panel.views, panel))
    pose = np.asarray(rig.world_to_camera, np.float64).reshape(-1).tolist()
    optics = (float(v) for v in (*rig.focal_px, *rig.principal_point_px))
    limits = (*(float(v) for v in rig.jacobian_limits(panel)), 0.0)
    lens = panel_lens(panel, continuous, start, (end - start) / panel.views)
    aperture = view_aperture(panel, rig, view_filter).deviation
    return LenticularCamera(tuple(pose), tuple(optics), limits, float(rig.zero_depth), lens, aperture)


def slow_reason(panel: Panel, lattices_on_cuda: bool) -> str | None:
    """Return why `direct` takes longer for a panel with sub-pixel cells; None where it does not.

    Args:
        panel: The panel.
        lattices_on_cuda: Whether a frame with lattices is drawn on CUDA.
    """
    if not panel.subpixel_cells:
        return None
    lens = panel_lens(panel).native()
    if not (lens.stands_in_order() and lens.has_one_order()):
        return (
            f"the sub-pixel cells of panel {panel.name} have no one order along the lens: it is drawn by slower "
            "ways, on the CPU a sub-pixel at a time, on CUDA by tiles of pixels, and without lattices"
        )
    if lattices_on_cuda:
        return "panels with sub-pixel cells are drawn without lattices on CUDA: this quality saves little time"
    return None
