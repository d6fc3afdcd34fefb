"""The camera of a panel: a fan of cameras, and the lens that chooses one for each sub-pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError

CELL_PERIOD = math.isqrt(_core.CELL_SUBPIXELS // 3)  # rows and columns after which the places of sub-pixels repeat
_LENS_WIDTH = 1 << 64  # phases are whole numbers of 2^-64 lens widths, modulo one lens


class Aperture(NamedTuple):
    """The camera positions that an image is averaged over, along the camera's x-axis; scene units.

    Attributes:
        deviation: Standard deviation of the positions.
        zero_depth: Depth at which the average leaves points unmoved.
    """

    deviation: float
    zero_depth: float


PINHOLE = Aperture(0.0, math.inf)


class NativeCamera(NamedTuple):
    """A LenticularCamera as the native code takes it."""

    rig: _core.Rig
    lens: _core.Lens


@dataclass(frozen=True)
class Lens:
    """The lens of a panel, in the numbers of csrc/scene/lens.h.

    Attributes:
        width_px, height_px, views: 1..65536.
        phases: The phase of the first sub-pixel, and its steps from sub-pixel to sub-pixel and from row to row. All are
            integers in units of 2^-64 lens widths, modulo 2^64.
        line_number: Width of a lens along a row, sub-pixels, > 0.
        slant_tan, phase: As of a Panel, phase in sub-pixels.
        bgr: Whether blue is the left-most sub-pixel.
        continuous: Whether cameras stand at x itself in place of floor(x) + 1/2.
        offset_start, offset_step: The camera of view coordinate x stands at offset_start + offset_step * x, scene
            units.
        cell_phases, cell_channels: Sub-pixel cells by row mod 4, column mod 4 and index within the pixel: phases
            relative to stripes, and image channels. (): stripes.

    Raises:
        InputError: no lens has these values.
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
        """Return the core's Lens; the only place that makes one."""
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


class CameraNumbers(NamedTuple):
    """A LenticularCamera as arguments of a torch operator, whose schema knows neither structs nor unsigned integers.

    The fields are the fields of LenticularCamera and of its Lens. Phases are the signed integers of the same 64 bits.
    """

    world_to_camera: list[float]
    intrinsics: list[float]
    limits: list[float]
    zero_depth: float
    aperture: float
    width_px: int
    height_px: int
    views: int
    phases: list[int]
    line_number: float
    slant_tan: float
    phase: float
    bgr: bool
    continuous: bool
    offset_start: float
    offset_step: float
    cell_phases: list[int]
    cell_channels: list[int]


@dataclass(frozen=True)
class LenticularCamera:
    """A rig's cameras behind a lens.

    Attributes:
        world_to_camera: 16 numbers of the centre camera, by rows.
        intrinsics: fx, fy, cx and cy in pixels of the panel.
        limits: Five numbers of the projection's Jacobian, see Cameras.limits.
        zero_depth: Depth of the plane without parallax, scene units.
        aperture: Standard deviation of the camera offsets that each sub-pixel's colour is averaged over, scene units;
            0: pinholes.
    """

    world_to_camera: tuple[float, ...]
    intrinsics: tuple[float, ...]
    limits: tuple[float, ...]
    zero_depth: float
    lens: Lens
    aperture: float = 0.0

    def native(self, antialiased: bool = False) -> NativeCamera:
        """Return the camera for the native code.

        Args:
            antialiased: See encoding.encode.
        """
        lens = self.lens.native()
        rig = _core.Rig(
            world_to_camera=self.world_to_camera,
            intrinsics=self.intrinsics,
            limits=self.limits,
            zero_depth=self.zero_depth,
            lens=lens,
            antialiased=antialiased,
            aperture=self.aperture,
        )
        return NativeCamera(rig, lens)

    def numbers(self) -> CameraNumbers:
        """Return the camera as arguments of an operator."""
        lens = self.lens
        return CameraNumbers(
            world_to_camera=list(self.world_to_camera),
            intrinsics=list(self.intrinsics),
            limits=list(self.limits),
            zero_depth=self.zero_depth,
            aperture=self.aperture,
            width_px=lens.width_px,
            height_px=lens.height_px,
            views=lens.views,
            phases=[_signed(phase) for phase in lens.phases],
            line_number=lens.line_number,
            slant_tan=lens.slant_tan,
            phase=lens.phase,
            bgr=lens.bgr,
            continuous=lens.continuous,
            offset_start=lens.offset_start,
            offset_step=lens.offset_step,
            cell_phases=[_signed(phase) for phase in lens.cell_phases],
            cell_channels=list(lens.cell_channels),
        )

    @staticmethod
    def from_numbers(numbers: CameraNumbers) -> LenticularCamera:
        """Return the camera of the arguments of an operator. Raises InputError for values that no camera has."""
        cells = (0, _core.CELL_SUBPIXELS)
        for name, sizes in (
            ("world_to_camera", (16,)),
            ("intrinsics", (4,)),
            ("limits", (5,)),
            ("phases", (3,)),
            ("cell_phases", cells),
            ("cell_channels", cells),
        ):
            if (size := len(getattr(numbers, name))) not in sizes:
                raise InputError(f"{name} must be {' or '.join(map(str, sizes))} numbers, got {size}")
        if not 0 <= numbers.aperture < math.inf:
            raise InputError(f"aperture must be 0 or more, got {numbers.aperture}")
        phase0, phase_x, phase_y = (phase % _LENS_WIDTH for phase in numbers.phases)
        lens = Lens(
            width_px=numbers.width_px,
            height_px=numbers.height_px,
            views=numbers.views,
            phases=(phase0, phase_x, phase_y),
            line_number=numbers.line_number,
            slant_tan=numbers.slant_tan,
            phase=numbers.phase,
            bgr=numbers.bgr,
            continuous=numbers.continuous,
            offset_start=numbers.offset_start,
            offset_step=numbers.offset_step,
            cell_phases=tuple(phase % _LENS_WIDTH for phase in numbers.cell_phases),
            cell_channels=tuple(numbers.cell_channels),
        )
        return LenticularCamera(
            world_to_camera=tuple(numbers.world_to_camera),
            intrinsics=tuple(numbers.intrinsics),
            limits=tuple(numbers.limits),
            zero_depth=numbers.zero_depth,
            lens=lens,
            aperture=numbers.aperture,
        )


def _signed(phase: int) -> int:
    """Return the signed integer of a 64-bit pattern."""
    return phase - _LENS_WIDTH if phase >= _LENS_WIDTH // 2 else phase
