"""What every sub-pixel of a panel sees, as one value: the fan of cameras, and the lens that chooses among them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError

_LENS_WIDTH = 1 << 64  # phases are whole numbers of 2^-64 lens widths, modulo one lens
_LENS_SIZES = (8, 8 + 2 * _core.CELL_SUBPIXELS)  # how long the operators' list `lens` is, of stripes and of cells
_RIG_SIZE, _SHAPE_SIZE = 27, 5  # how long `rig` and `lens_shape` are; `rig` also without its last number


class NativeView(NamedTuple):
    """A LensView as the native code takes it."""

    rig: _core.Rig
    lens: _core.Lens


@dataclass(frozen=True)
class Lens:
    """The lens of a panel, in the numbers of csrc/scene/lens.h. Raises InputError for values that no lens has.

    width_px, height_px, views: 1..65536. line_number: width of a lens along a row, sub-pixels, > 0. slant_tan, phase:
    as of a Panel, phase in sub-pixels.
    phases: the phase of the first sub-pixel, and what it grows by from one sub-pixel to the next and from one row to
    the next; whole numbers of 2^-64 lens widths, modulo 2^64.
    bgr: blue is the left-most sub-pixel. continuous: cameras at x itself in place of floor(x) + 1/2.
    offset_start, offset_step: the camera of view coordinate x stands at offset_start + offset_step * x, scene units.
    cell_phases, cell_channels: of a panel with sub-pixel cells, by row mod 4, column mod 4 and place: what its
    sub-pixels have beyond the phases of stripes, and their image channels. (): stripes.
    """

    width_px: int
    height_px: int
    views: int
    phases: tuple[int, int, int]
    line_number: float
    slant_tan: float
    phase: float
    bgr: bool
    continuous: bool
    offset_start: float = 0.0
    offset_step: float = 0.0
    cell_phases: tuple[int, ...] = ()
    cell_channels: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        sizes = [self.width_px, self.height_px, self.views]
        if not (all(1 <= size <= 65536 for size in sizes) and self.line_number > 0):
            raise InputError(
                f"a lens needs sizes and views of 1..65536 and a line number > 0, got {sizes} and {self.line_number}"
            )
        channels = list(self.cell_channels)
        if any(sorted(channels[m : m + 3]) != [0, 1, 2] for m in range(0, len(channels), 3)):
            raise InputError(f"lens: every pixel of the cells must have the channels 0, 1 and 2 once, got {channels}")

    def native(self) -> _core.Lens:
        """The core's Lens; the only place that makes one."""
        phase0, phase_x, phase_y = self.phases
        return _core.Lens(
            width_px=self.width_px,
            height_px=self.height_px,
            views=self.views,
            phase0=phase0,
            phase_x=phase_x,
            phase_y=phase_y,
            line_number=self.line_number,
            slant_tan=self.slant_tan,
            phase=self.phase,
            bgr=self.bgr,
            continuous=self.continuous,
            offset_start=self.offset_start,
            offset_step=self.offset_step,
            cell_phases=self.cell_phases,
            cell_channels=self.cell_channels,
        )


@dataclass(frozen=True)
class LensView:
    """A rig's cameras behind a lens.

    pose: world_to_camera of the centre camera, 16 numbers by rows. optics: fx, fy, cx, cy in pixels of the panel.
    limits: of the projection's Jacobian, five numbers, see Cameras.limits. zero_depth: of the plane without parallax,
    scene units. aperture: standard deviation of the camera offsets that each sub-pixel's picture is averaged over,
    scene units; 0: pinholes.
    """

    pose: tuple[float, ...]
    optics: tuple[float, ...]
    limits: tuple[float, ...]
    zero_depth: float
    lens: Lens
    aperture: float = 0.0

    def native(self, antialiased: bool = False) -> NativeView:
        """For the native code; antialiased: see encoding.encode."""
        lens = self.lens.native()
        rig = _core.Rig(
            world_to_camera=self.pose,
            intrinsics=self.optics,
            limits=self.limits,
            zero_depth=self.zero_depth,
            lens=lens,
            antialiased=antialiased,
            aperture=self.aperture,
        )
        return NativeView(rig, lens)

    # As lists: the schema of an operator knows no other way to take so many numbers

    def lists(self) -> tuple[list[float], list[int], list[float]]:
        """rig, lens and lens_shape as torch.ops.lightfield_gs.render_lens takes them; see there."""
        lens = self.lens
        sizes = [lens.width_px, lens.height_px, lens.views]
        rest = [int(lens.bgr), int(lens.continuous), *map(_signed, lens.cell_phases), *lens.cell_channels]
        shape = [lens.line_number, lens.slant_tan, lens.phase, lens.offset_start, lens.offset_step]
        return (
            [*self.pose, *self.optics, *self.limits, self.zero_depth, self.aperture],
            [*sizes, *map(_signed, lens.phases), *rest],
            shape,
        )

    @staticmethod
    def of_lists(rig: Sequence[float], lens: Sequence[int], lens_shape: Sequence[float]) -> LensView:
        """From what `lists` makes. Raises InputError for what it cannot have made."""
        if len(lens) not in _LENS_SIZES or len(lens_shape) != _SHAPE_SIZE:
            raise InputError(
                f"lens must be {_LENS_SIZES[0]} or {_LENS_SIZES[1]} integers and lens_shape {_SHAPE_SIZE} numbers, got "
                f"{len(lens)} and {len(lens_shape)}"
            )
        if len(rig) not in (_RIG_SIZE - 1, _RIG_SIZE):
            raise InputError(f"rig must be {_RIG_SIZE} numbers (see render_lens), got {len(rig)}")
        aperture = rig[26] if len(rig) == _RIG_SIZE else 0.0
        if not 0 <= aperture < math.inf:
            raise InputError(f"rig: its aperture must be 0 or more, got {aperture}")
        width, height, views, *phases, bgr, continuous = lens[:8]
        cells, channels = lens[8 : 8 + _core.CELL_SUBPIXELS], lens[8 + _core.CELL_SUBPIXELS :]
        line_number, slant_tan, phase, offset_start, offset_step = lens_shape
        phase0, phase_x, phase_y = (p % _LENS_WIDTH for p in phases)
        made = Lens(
            width,
            height,
            views,
            (phase0, phase_x, phase_y),
            line_number,
            slant_tan,
            phase,
            bool(bgr),
            bool(continuous),
            offset_start,
            offset_step,
            tuple(p % _LENS_WIDTH for p in cells),
            tuple(channels),
        )
        return LensView(tuple(rig[:16]), tuple(rig[16:20]), tuple(rig[20:25]), rig[25], made, aperture)


def _signed(phase: int) -> int:
    """A 64-bit pattern as the signed integer that operators carry."""
    return phase - _LENS_WIDTH if phase >= _LENS_WIDTH // 2 else phase
