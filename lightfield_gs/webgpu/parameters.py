"""The numbers of a frame as csrc/webgpu/frame.wgsl takes them, and how the panel is cut into boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lightfield_gs import _core
from lightfield_gs.rasterizer.lenticular_camera import Lens, LenticularCamera
from lightfield_gs.rasterizer.quality import OPACITY_CUT, Quality

BOX_ROWS, TILE_WIDTH, BOX_LENSES = 16, 32, 16  # as in csrc/webgpu/footprint.wgsl
ORDINALS = (0, 2, 3, 6)  # tilings in the order of cost_of_splat in csrc/webgpu/project.wgsl; 0: tiles of pixels
LENS_WIDTHS = 6.0, 200.0  # sub-pixels, of lenses that boxes are made of: not less than the ordinals of a box
# In sub-pixels: from a cell's shift to the next one's, and between the least and the most, for boxes of lenses
_LEAST_STEP, _MOST_SPREAD = -0.9, 1.5
_WORD = 0xFFFFFFFF


@dataclass(frozen=True)
class Boxes:
    """How a panel is cut into boxes.

    Attributes:
        ordinals: Sub-pixels of a lens in a box; 0: tiles of pixels.
        across, down, groups: Number of boxes.
        first_lens: Number of the first lens of the first box.
    """

    ordinals: int
    across: int
    down: int
    groups: int
    first_lens: int = 0

    @staticmethod
    def of(lens: Lens, ordinals: int) -> Boxes:
        """Return the boxes of a panel."""
        down = -(-lens.height_px // BOX_ROWS)
        if not ordinals:
            return Boxes(0, -(-lens.width_px // TILE_WIDTH), down, 1)
        shifts = cell_shifts(lens)
        corners = [
            (place + 3 * row * lens.slant_tan + lens.phase + shift) / lens.line_number
            for place in (0, 3 * lens.width_px)
            for row in (0, lens.height_px)
            for shift in (shifts.min(), shifts.max())
        ]
        first = math.floor(min(corners)) - 1
        across = -(-(math.ceil(max(corners)) + 1 - first) // BOX_LENSES)
        most = math.floor(lens.line_number + np.ptp(shifts)) + 1  # sub-pixels of a lens in a row
        return Boxes(ordinals, across, down, -(-most // ordinals), first)


def cell_shifts(lens: Lens) -> np.ndarray:
    """Return how far cells lie beyond their stripes, in sub-pixels, by row mod 4 and sub-pixel mod 12: [4, 12]."""
    if not lens.cell_phases:
        return np.zeros((4, 12))
    turns = [(phase + (1 << 63)) % (1 << 64) - (1 << 63) for phase in lens.cell_phases]
    return np.array(turns, np.float64).reshape(4, 12) * (lens.line_number / 2.0**64)


def tilings(lens: Lens) -> tuple[int, ...]:
    """Return the ordinals of the tilings that a panel allows; boxes of lenses need cells in the order of stripes."""
    shifts = cell_shifts(lens)
    steps = np.roll(shifts, -1, axis=1) - shifts
    ordered = steps.min() > _LEAST_STEP and np.ptp(shifts) <= _MOST_SPREAD
    fit = LENS_WIDTHS[0] <= lens.line_number <= LENS_WIDTHS[1]
    return ORDINALS if fit and ordered else ORDINALS[:1]


def pack_params(
    camera: LenticularCamera,
    antialiased: bool,
    degree: int,
    count: int,
    background: np.ndarray,
    quality: Quality,
    boxes: Boxes,
    rows: tuple[int, int],
    room: tuple[int, int, int, int],
) -> bytes:
    """Return the struct Params of csrc/webgpu/frame.wgsl.

    Args:
        camera: Of the panel.
        antialiased: See encoding.encode.
        degree: Of the harmonics.
        count: Of the Gaussians.
        background: [3], 0..1.
        quality: Its cuts and its error of colours; the rest is exact.
        boxes: Of the panel.
        rows: First row of boxes of this pass, and one behind the last.
        room: For pairs, colours, large splats and chunks of long lists.
    """
    lens = camera.lens
    pose = np.asarray(camera.world_to_camera, np.float64).reshape(4, 4)
    turn = np.zeros((3, 4))
    turn[:, :3] = pose[:3, :3]
    reach = lens.native().reach()
    start, step = (value / reach if reach > 0 else 0.0 for value in (lens.offset_start, lens.offset_step))
    least_light = quality.contribution_cut * lens.width_px * lens.height_px / max(count, 1)
    # The cut chooses patches alone where evaluation may be approximate, as on the CPU
    least_alpha = OPACITY_CUT if quality.is_approximate else quality.opacity_cut
    floats = [
        *turn.ravel(),
        *camera.intrinsics,
        *camera.limits[:4],
        *(reach, 1 / camera.zero_depth, start, step),
        *(*background, 0.0),
        *(lens.line_number, lens.slant_tan, lens.phase, boxes.first_lens),
        *(camera.aperture, float(antialiased), quality.colour_error, camera.limits[4]),
        *(math.log2(quality.opacity_cut), least_light, quality.transmittance_stop, math.log2(least_alpha)),
    ]
    phases = [word for phase in lens.phases for word in _words(phase)]
    words = [
        *(lens.width_px, lens.height_px, lens.views, count),
        *(*phases, int(lens.continuous), degree),
        *(boxes.across, rows[1] - rows[0], boxes.groups, rows[0]),
        *room,
    ]
    cells = np.zeros((_core.CELL_SUBPIXELS, 4), np.uint32)
    for k, (phase, channel) in enumerate(zip(lens.cell_phases, lens.cell_channels)):
        cells[k, :3] = (*_words(phase), channel)
    shifts = cell_shifts(lens)
    cells[:2, 3] = np.array((shifts.min(), shifts.max()), np.float32).view(np.uint32)
    fx, fy, cx, cy = camera.intrinsics
    away = pose[2] / camera.zero_depth - (0, 0, 0, 1)  # times (mean, 1): (Z - Z0) / Z0
    rows_of_pose = np.stack([fx * pose[0] + cx * pose[2], fy * pose[1] + cy * pose[2], pose[2], reach * fx * away])
    arrays = rows_of_pose, np.array(floats, np.float32), np.array(words, np.uint32), cells
    return b"".join(array.tobytes() for array in arrays)


def _words(phase: int) -> tuple[int, int]:
    """Return the low and the high word of 64 bits."""
    return phase & _WORD, phase >> 32
