"""The native module, for editors and type checkers. Its functions are bound in csrc/bind; what they do with buffers is
said in csrc/stages and, for CUDA, in csrc/cuda. Python owns every buffer and checks every argument before it
hands an address over; errors of the module are ValueErrors. In truth float32, float64 and cuda are submodules: here
they are classes, which a stub in one file can name.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias, overload

Address: TypeAlias = int  # of a buffer, as Tensor.data_ptr() gives it, or 0; a stream of CUDA likewise

version: str
BAND_ROWS: int
LOG2_MIN_ALPHA: float
SPLAT_FIELDS: int
SPLAT_REACH_INDEX: int
SPLAT_SHAPE_INDICES: tuple[int, int, int, int]
PRUNED: int
NEAR_DEPTH: float
COLOUR_STRIDE: int
CELL_SUBPIXELS: int
COMPENSATION_FIELDS: int
SUBPIXEL_BLOCK: int
STEP_COLUMNS: int
NOISE_PURPOSE: int
DROPOUT_PURPOSE: int
MOST_LOG_SCALE: float
MOST_LOGIT: float

class Lens:
    def __init__(
        self,
        *,
        width_px: int,
        height_px: int,
        views: int,
        phase0: int,
        phase_x: int,
        phase_y: int,
        line_number: float,
        slant_tan: float,
        phase: float,
        bgr: bool,
        continuous: bool,
        offset_start: float,
        offset_step: float,
        cell_phases: Sequence[int] = ...,
        cell_channels: Sequence[int] = ...,
    ) -> None: ...
    def reach(self) -> float: ...
    def subpixel_of(self, row: int, column: int, channel: int) -> int: ...
    def stands_in_order(self) -> bool: ...
    def has_one_order(self) -> bool: ...
    def view_at(self, row: int, subpixel: int) -> int: ...

class Rig:
    def __init__(
        self,
        *,
        world_to_camera: Sequence[float],
        intrinsics: Sequence[float],
        limits: Sequence[float],
        zero_depth: float,
        lens: Lens,
        antialiased: bool = ...,
        aperture: float = ...,
    ) -> None: ...

class Quality:
    def __init__(
        self, *, opacity_cut: float, transmittance_stop: float, lattice: float, contribution: float, evaluation: float
    ) -> None: ...

class Bins:
    def __init__(self, band_offsets: Address, band_splats: Address) -> None: ...

class Counters:
    @property
    def pairs(self) -> int: ...
    @property
    def evaluations(self) -> int: ...
    @property
    def scratch_bytes(self) -> int: ...
    @property
    def tiles(self) -> int: ...
    @property
    def empty_tiles(self) -> int: ...
    @property
    def stopped_samples(self) -> int: ...
    @property
    def lattice_tiles(self) -> int: ...
    @property
    def lattices(self) -> int: ...
    @property
    def split_lattices(self) -> int: ...
    @property
    def refused_lattices(self) -> int: ...

class SubpixelTile:
    def __init__(self, width_px: int, row_bits: int) -> None: ...
    @property
    def width_px(self) -> int: ...
    @property
    def height_px(self) -> int: ...
    def count(self, image_width_px: int, image_height_px: int) -> int: ...

class ViewMap:
    @overload
    def __init__(self, lens: Lens) -> None: ...
    @overload
    def __init__(self, width_px: int, height_px: int, views: int, table: Address) -> None: ...

class SubpixelLists:
    def __init__(self, tile: SubpixelTile, starts: Address, codes: Address) -> None: ...

class SheetLook:
    def __init__(
        self,
        *,
        deviation: float,
        thickness: float,
        blur: float,
        opacity: float,
        most_opaque: float,
        most_of_sheet: float,
        sharper_colour: float,
        sharper_outline: float,
        haze: float,
        object: float,
        same_surface: float,
        steepest: float,
    ) -> None: ...

class Sheet:
    def __init__(
        self,
        *,
        height: int,
        width: int,
        factor: int,
        disparity: Address,
        harmonics: Address,
        photo: Address,
        intrinsics: Address,
        look: SheetLook,
        soft: Address,
        surface: Address,
        out: _Stages.Gaussians,
    ) -> None: ...

class SurfaceLook:
    def __init__(self, *, averaged: float, softness: float) -> None: ...

class Surface:
    def __init__(
        self,
        *,
        height: int,
        width: int,
        layers: int,
        cloud: _Stages.Gaussians,
        mask: Address,
        intrinsics: Address,
        look: SurfaceLook,
        planes: Address,
        disparity: Address,
        harmonics: Address,
    ) -> None: ...

def surface(job: Surface, threads: int) -> None: ...
def sheet(job: Sheet, threads: int) -> None: ...

class WeaveWindow:
    def __init__(
        self,
        *,
        left: float,
        top: float,
        width: float,
        height: float,
        low_x: float,
        low_y: float,
        high_x: float,
        high_y: float,
        shift: float,
    ) -> None: ...

class WeaveFan:
    def __init__(
        self, map: ViewMap, places: Address, continuous: bool, inverted: bool, views: int, box: float
    ) -> None: ...

def band_count(height_px: int) -> int: ...
def pair_gradient_size(colour_order: int, compensated: bool = ...) -> int: ...
def dense_pair_gradient_size(absolute: bool) -> int: ...
def simd_targets() -> list[str]: ...
def set_simd_target(name: str) -> None: ...
def photo_loss_partials(views: int, height_px: int, width_px: int) -> int: ...
def philox4x32(counter: Sequence[int], key: Sequence[int]) -> list[int]: ...
def uniforms(seed: int, step: int, purpose: int, count: int, out: Address, threads: int) -> None: ...
def plan_sorted_count(
    map: ViewMap, tile: SubpixelTile, places: Address, views: int, counts: Address, threads: int
) -> None: ...
def plan_sorted_fill(
    map: ViewMap, tile: SubpixelTile, places: Address, views: int, starts: Address, codes: Address, threads: int
) -> None: ...
def weave_uint8(
    pixels: Address,
    first: int,
    own: int,
    held: int,
    height_px: int,
    width_px: int,
    window: WeaveWindow,
    fan: WeaveFan,
    out: Address,
    threads: int,
) -> None: ...
def weave_uint16(
    pixels: Address,
    first: int,
    own: int,
    held: int,
    height_px: int,
    width_px: int,
    window: WeaveWindow,
    fan: WeaveFan,
    out: Address,
    threads: int,
) -> None: ...
def weave_float32(
    pixels: Address,
    first: int,
    own: int,
    held: int,
    height_px: int,
    width_px: int,
    window: WeaveWindow,
    fan: WeaveFan,
    out: Address,
    threads: int,
) -> None: ...

# --- the stages of the CPU, in float and in double: float32 and float64 are alike

class _Stages:
    class Gaussians:
        def __init__(
            self,
            count: int,
            sh_degree: int,
            means: Address,
            quaternions: Address,
            scales: Address,
            opacities: Address,
            sh: Address,
        ) -> None: ...

    class Cameras:
        def __init__(
            self,
            scenes: int,
            per_scene: int,
            width_px: int,
            height_px: int,
            world_to_camera: Address,
            intrinsics: Address,
            limits: Address,
            antialiased: bool = ...,
            aperture: float = ...,
            zero_depth: float = ...,
        ) -> None: ...

    class Splats:
        def __init__(
            self,
            images: int,
            count: int,
            colour_order: int,
            splats: Address,
            colours: Address,
            orders: Address,
            compensations: Address = ...,
        ) -> None: ...

    class DenseImages:
        def __init__(self, image: Address, alpha: Address, depth: Address) -> None: ...

    class PhotoLoss:
        def __init__(
            self,
            *,
            views: int,
            height_px: int,
            width_px: int,
            image: Address,
            photo: Address,
            photo_bytes: Address,
            weights: Address,
            ssim_share: float,
            derivatives: Address,
            partials: Address,
            loss: Address,
            gradient: Address,
        ) -> None: ...

    class Fields:
        def __init__(
            self, means: Address, log_scales: Address, quaternions: Address, logits: Address, sh: Address
        ) -> None: ...

    class Update:
        def __init__(
            self,
            *,
            gradients: _Stages.Gaussians,
            fields: _Stages.Fields,
            first: _Stages.Fields,
            second: _Stages.Fields,
            scales: Address,
            opacities: Address,
            seen: Address,
            table: Address,
            rows: int,
            step: Address,
            skipped: Address,
            beta1: float,
            beta2: float,
            epsilon: float,
            seed: int,
        ) -> None: ...

    class Dropout:
        def __init__(
            self, *, shares: Address, rows: int, step: Address, seed: int, count: int, factors: Address
        ) -> None: ...

    @staticmethod
    def project_dense(
        gaussians: _Stages.Gaussians, cameras: _Stages.Cameras, out: _Stages.Splats, threads: int
    ) -> None: ...
    @staticmethod
    def project_dense_backward(
        gaussians: _Stages.Gaussians,
        cameras: _Stages.Cameras,
        splats: _Stages.Splats,
        first_pair: Address,
        pair_gradients: Address,
        out: _Stages.Gaussians,
        screen: Address,
        absolute: bool,
        g_world_to_camera: Address,
        threads: int,
    ) -> None: ...
    @staticmethod
    def project_lens(
        gaussians: _Stages.Gaussians,
        rig: Rig,
        lens: Lens,
        quality: Quality,
        tolerance: float,
        out: _Stages.Splats,
        threads: int,
    ) -> float: ...
    @staticmethod
    def project_lens_backward(
        gaussians: _Stages.Gaussians,
        rig: Rig,
        lens: Lens,
        splats: _Stages.Splats,
        first_pair: Address,
        pair_gradients: Address,
        out: _Stages.Gaussians,
        threads: int,
    ) -> None: ...
    @staticmethod
    def order(splats: _Stages.Splats, order: Address, drawn: Address, threads: int) -> None: ...
    @staticmethod
    def bin_count(
        splats: _Stages.Splats, order: Address, drawn: Address, height_px: int, bins: Bins, threads: int
    ) -> int: ...
    @staticmethod
    def bin_fill(
        splats: _Stages.Splats, order: Address, drawn: Address, height_px: int, bins: Bins, threads: int
    ) -> None: ...
    @staticmethod
    def first_pairs(splats: _Stages.Splats, height_px: int, bins: Bins, first_pair: Address, threads: int) -> None: ...
    @staticmethod
    def composite_dense(
        splats: _Stages.Splats,
        bins: Bins,
        cameras: _Stages.Cameras,
        background: Address,
        out: _Stages.DenseImages,
        threads: int,
    ) -> Counters: ...
    @staticmethod
    def composite_dense_backward(
        splats: _Stages.Splats,
        bins: Bins,
        cameras: _Stages.Cameras,
        background: Address,
        images: _Stages.DenseImages,
        gradients: _Stages.DenseImages,
        absolute: bool,
        first_pair: Address,
        pair_gradients: Address,
        band_background: Address,
        threads: int,
    ) -> Counters: ...
    @staticmethod
    def composite_lens(
        splats: _Stages.Splats,
        bins: Bins,
        lens: Lens,
        quality: Quality,
        background: Address,
        out: Address,
        out8: Address,
        threads: int,
    ) -> Counters: ...
    @staticmethod
    def composite_lens_backward(
        splats: _Stages.Splats,
        bins: Bins,
        lens: Lens,
        background: Address,
        image: Address,
        gradient: Address,
        first_pair: Address,
        pair_gradients: Address,
        band_background: Address,
        threads: int,
    ) -> Counters: ...
    @staticmethod
    def composite_sorted(
        splats: _Stages.Splats,
        bins: Bins,
        cameras: _Stages.Cameras,
        lists: SubpixelLists,
        background: Address,
        out: Address,
        out8: Address,
        threads: int,
    ) -> Counters: ...
    @staticmethod
    def photo_loss(job: _Stages.PhotoLoss, threads: int) -> None: ...
    @staticmethod
    def update(job: _Stages.Update, threads: int) -> None: ...
    @staticmethod
    def normals(seed: int, step: int, purpose: int, count: int, out: Address, threads: int) -> None: ...
    @staticmethod
    def dropout(job: _Stages.Dropout, threads: int) -> None: ...

float32: type[_Stages]
float64: type[_Stages]

# --- the stages of a CUDA device, where the module was built with them: hasattr(_core, "cuda")

class _Cuda:
    architectures: list[int]
    ABSOLUTE_DENSE_SUMS: int
    DENSE_SUMS: int
    SPLAT_SUMS: int
    LENS_SUMS: int
    FRAME_STATE_BYTES: int
    FRAME_KERNELS: list[str]
    SORTED_STATE_BYTES: int
    class Image:
        def __init__(self, count: int, width_px: int, height_px: int, lens: bool) -> None: ...
        def tiles(self) -> int: ...

    class Pairs:
        def __init__(
            self,
            count: int,
            tiles: Address,
            sorted_tiles: Address,
            slots: Address,
            sorted_slots: Address,
            slot_splats: Address,
            sorted_splats: Address,
            total: Address = ...,
        ) -> None: ...

    class SortedChunk:
        def __init__(
            self, *, views: int, gaussians: int, width_px: int, height_px: int, tile: SubpixelTile
        ) -> None: ...
        def bytes(self) -> int: ...
        def place(self, work: Address) -> int: ...
        def place_ids(self, ids: Address) -> None: ...

    class LensFrame:
        def __init__(
            self,
            *,
            gaussians: int,
            sh_degree: int,
            colour_order: int,
            rig: Rig,
            lens: Lens,
            capacity: int,
            quality: Quality,
            colour_error: float,
            left_out: float,
            shared_memory: int,
        ) -> None: ...
        def bytes(self) -> int: ...
        def place(self, work: Address) -> int: ...
        def state_address(self) -> Address: ...
        def force(self, kernel: int) -> None: ...
        @property
        def ordinal_layout(self) -> str: ...

    @staticmethod
    def project_dense(
        gaussians: _Stages.Gaussians, cameras: _Stages.Cameras, out: _Stages.Splats, keys: Address, stream: Address
    ) -> None: ...
    @staticmethod
    def project_lens(
        gaussians: _Stages.Gaussians,
        rig: Rig,
        lens: Lens,
        tolerance: float,
        out: _Stages.Splats,
        keys: Address,
        error: Address,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def view_blocks(gaussians: int) -> int: ...
    @staticmethod
    def project_dense_backward(
        gaussians: _Stages.Gaussians,
        cameras: _Stages.Cameras,
        sums: Address,
        out: _Stages.Gaussians,
        screen: Address,
        absolute: bool,
        view_partials: Address,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def sum_slots(
        splats: int, slot_ranges: Address, absolute: bool, slot_gradients: Address, sums: Address, stream: Address
    ) -> None: ...
    @staticmethod
    def project_lens_backward(
        gaussians: _Stages.Gaussians,
        rig: Rig,
        splats: _Stages.Splats,
        slot_ranges: Address,
        slot_gradients: Address,
        out: _Stages.Gaussians,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def order_bytes(items: int) -> int: ...
    @staticmethod
    def order(
        items: int,
        images: int,
        keys: Address,
        sorted_keys: Address,
        indices: Address,
        temporary: Address,
        temporary_bytes: int,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def count_bytes(items: int) -> int: ...
    @staticmethod
    def bin_count(
        splats: _Stages.Splats,
        image: _Cuda.Image,
        counts: Address,
        pairs: Address,
        temporary: Address,
        temporary_bytes: int,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def fill_bytes(items: int, pairs: int) -> int: ...
    @staticmethod
    def bin_fill(
        splats: _Stages.Splats,
        image: _Cuda.Image,
        indices: Address,
        counts: Address,
        ends: Address,
        pairs: _Cuda.Pairs,
        ranges: Address,
        slot_ranges: Address,
        temporary: Address,
        temporary_bytes: int,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def composite_dense(
        splats: _Stages.Splats,
        image: _Cuda.Image,
        ranges: Address,
        pairs: _Cuda.Pairs,
        background: Address,
        out: _Stages.DenseImages,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def composite_dense_backward(
        splats: _Stages.Splats,
        image: _Cuda.Image,
        ranges: Address,
        pairs: _Cuda.Pairs,
        images: _Stages.DenseImages,
        gradients: _Stages.DenseImages,
        absolute: bool,
        slot_gradients: Address,
        tile_background: Address,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def composite_lens(
        splats: _Stages.Splats,
        image: _Cuda.Image,
        ranges: Address,
        pairs: _Cuda.Pairs,
        lens: Lens,
        background: Address,
        out: Address,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def composite_lens_backward(
        splats: _Stages.Splats,
        image: _Cuda.Image,
        ranges: Address,
        pairs: _Cuda.Pairs,
        lens: Lens,
        pixels: Address,
        gradient: Address,
        slot_gradients: Address,
        tile_background: Address,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def group_norm_silu(
        images: int,
        pixels: Address,
        channels: int,
        groups: int,
        maps: Address,
        weight: Address,
        bias: Address,
        eps: float,
        out: Address,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def surface(job: Surface, stream: Address) -> None: ...
    @staticmethod
    def sheet(job: Sheet, stream: Address) -> None: ...
    FOUND_NUMBERS: int
    class Photo:
        def __init__(
            self,
            *,
            height: int,
            width: int,
            bytes: Address,
            floats: Address,
            opaque: float,
            margin: float,
            found: Address,
            checks: Address,
        ) -> None: ...

    @staticmethod
    def find_object(photo: _Cuda.Photo, stream: Address) -> None: ...
    @staticmethod
    def crop_object(photo: _Cuda.Photo, size_px: int, narrow: Address, out: Address, stream: Address) -> None: ...
    DEFLATE_FACTS_BYTES: int
    class PngImage:
        def __init__(self, *, height: int, width: int, channels: int, pixels: Address) -> None: ...
        def work_bytes(self) -> int: ...
        def stream_bytes(self) -> int: ...
        def place(self, work: Address, out: Address) -> None: ...

    @staticmethod
    def deflate(image: _Cuda.PngImage, stream: Address) -> None: ...
    @staticmethod
    def frame_state(address: Address) -> dict[str, Any]: ...
    @staticmethod
    def frame_project(
        frame: _Cuda.LensFrame, gaussians: _Stages.Gaussians, keep_lists: bool, stream: Address
    ) -> None: ...
    @staticmethod
    def frame_bin(frame: _Cuda.LensFrame, stream: Address) -> None: ...
    @staticmethod
    def frame_order(frame: _Cuda.LensFrame, stream: Address) -> None: ...
    @staticmethod
    def frame_composite(
        frame: _Cuda.LensFrame, background: Address, out: Address, out8: Address, stream: Address
    ) -> None: ...
    @staticmethod
    def project_sorted(
        chunk: _Cuda.SortedChunk, gaussians: _Stages.Gaussians, cameras: _Stages.Cameras, stream: Address
    ) -> None: ...
    @staticmethod
    def count_sorted(chunk: _Cuda.SortedChunk, stream: Address) -> None: ...
    @staticmethod
    def fill_sorted(chunk: _Cuda.SortedChunk, stream: Address) -> None: ...
    @staticmethod
    def order_sorted(chunk: _Cuda.SortedChunk, stream: Address) -> None: ...
    @staticmethod
    def composite_sorted(
        chunk: _Cuda.SortedChunk,
        lists: SubpixelLists,
        background: Address,
        out: Address,
        out8: Address,
        stream: Address,
    ) -> None: ...
    @staticmethod
    def photo_loss_partials(views: int, height_px: int, width_px: int) -> int: ...
    @staticmethod
    def photo_loss(job: _Stages.PhotoLoss, stream: Address) -> None: ...
    @staticmethod
    def update(job: _Stages.Update, stream: Address) -> None: ...
    @staticmethod
    def uniforms(seed: int, step: int, purpose: int, count: int, out: Address, stream: Address) -> None: ...
    @staticmethod
    def normals(seed: int, step: int, purpose: int, count: int, out: Address, stream: Address) -> None: ...
    @staticmethod
    def dropout(job: _Stages.Dropout, stream: Address) -> None: ...

cuda: type[_Cuda]
