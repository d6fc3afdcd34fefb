"""The depth map of a photo (of a file, beside it, inside its file, or estimated), and the camera of that photo."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.app.photo_pair import pair_of
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device
from lightfield_gs.photo.side_by_side import is_rgbd_name

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from lightfield_gs.io.images import Picture
    from lightfield_gs.photo.depth import DepthMap, DepthNumbers
    from lightfield_gs.photo.depth_models.model import Pixels
    from lightfield_gs.photo.photo import Photo
    from lightfield_gs.photo.steady_depth import PictureEstimate

# Default meaning of a depth map beside its photo: bright is near, as in Looking Glass' files
_BESIDE_KIND, _BESIDE_LIMITS = "disparity", (1.0, 1.6)
_OFF_CENTRE = 0.1  # a principal point that is farther off the middle, in sides of the photo, may be another photo's
# Usual angles of the longer side, and those beyond which intrinsics must be in other units
_USUAL_ANGLES_DEG, _ANGLES_DEG = (10.0, 130.0), (1.0, 175.0)


def depth_by_network(
    options: PhotoOptions, photo: Photo, device: str, estimate: PictureEstimate | None = None
) -> DepthMap:
    """Estimate the depth map of --depth auto, or take an estimate that was made before. Raises InputError."""
    from lightfield_gs.photo.depth_network import depth_of_estimate, estimated_depth

    model, on = options.depth_network, _network_device(device)
    wanted: dict[str, Any] = dict(kind=options.depth_kind, limits=options.depth_range)
    if estimate is not None:
        return depth_of_estimate(photo.floats(), estimate, model, on, **wanted)
    depth = estimated_depth(photo.floats(), model, on, **wanted, say=lambda words: print(words, flush=True))
    if depth.focal_px is not None:  # of the photo as its file has it
        depth.focal_px *= photo.size[1] / photo.pixels.shape[1]
    return depth


def steady_estimates(
    photos: Iterable[tuple[int, Photo]], options: PhotoOptions, device: str, ahead: int | None = None
) -> Iterator[tuple[int, PictureEstimate]]:
    """Yield the network's numbers for photos in a row, each averaged with its neighbours.

    Args:
        photos: Their numbers, and they.
        options: Of all of them.
        device: Where the network works.
        ahead: See `steadied`.

    Raises:
        InputError: As `estimate_pictures`; a network of many pictures at once is for films, not for ahead=0.
    """
    from lightfield_gs.photo.depth_network import estimate_pictures, is_metric, refuse_windows
    from lightfield_gs.photo.steady_depth import steadied

    model, on = options.depth_network, _network_device(device)
    if ahead == 0:
        refuse_windows(model, on, options.depth_kind)
    images = ((number, photo.floats()) for number, photo in photos)
    estimates = estimate_pictures(images, model, on, kind=options.depth_kind)
    return steadied(estimates, is_metric(model, on, options.depth_kind), ahead=ahead)


def network_picture(pixels: np.ndarray | Tensor, options: PhotoOptions, device: str, shorter_px: int | None) -> Pixels:
    """Return a picture as the network of --depth auto sees it, for `steady_pictures`. Raises InputError.

    Args:
        pixels: The picture. A tensor on CUDA, uint8 [H, W, 3], stays there.
        options: Of all pictures.
        device: Where the network works.
        shorter_px: Shorter side at most. None: the network's own.
    """
    from lightfield_gs.photo.depth_network import shrink_picture

    return shrink_picture(pixels, options.depth_network, _network_device(device), options.depth_kind, shorter_px)


def steady_pictures(
    pictures: Iterable[tuple[int, Pixels]], options: PhotoOptions, device: str
) -> Iterator[tuple[int, Callable[[Tensor], Tensor]]]:
    """Yield for pictures in a row what gives their z, each averaged with those before it; none waits for the next.

    Args:
        pictures: Their numbers, and they, of `network_picture`.
        options: Of all of them.
        device: Where the network works.

    Yields:
        The number, and a function from the whole picture, [H, W, 3] in 0..1 on the device, to z [H, W].

    Raises:
        InputError: As `steady_estimates`.
    """
    from lightfield_gs.photo.depth_network import estimate_shrunk, is_metric, refuse_windows, z_of_estimate
    from lightfield_gs.photo.steady_depth import steadied

    model, on, kind = options.depth_network, _network_device(device), options.depth_kind
    refuse_windows(model, on, kind)
    has_distances = is_metric(model, on, kind)
    for number, estimate in steadied(estimate_shrunk(pictures, model, on, kind=kind), has_distances, ahead=0):
        yield number, partial(z_of_estimate, estimate, has_distances, options.depth_range)


def _network_device(device: str) -> Device:
    return "cuda" if device == "cuda" else "cpu"


def has_depth(path: Path, options: PhotoOptions) -> bool:
    """Return whether a photo has depths: in a file, beside it, inside its file, or estimated."""
    if options.depth is not None or options.rgbd is not None or is_rgbd_name(path):
        return True
    return pair_of(path, options) is not None or is_depth_inside(path, options)


def is_depth_inside(path: Path, options: PhotoOptions) -> bool:
    """Return whether to take the depth map inside a photo's file: no option names another, or asks for an object."""
    others = (options.depth, options.rgbd, options.mask, options.checkpoint, options.detail, options.detail_budget)
    if is_rgbd_name(path) or options.remove_background or any(value is not None for value in others):
        return False
    from lightfield_gs.photo.embedded_depth import find_embedded_depth

    return find_embedded_depth(path) is not None


def flat_depth(photo: Photo) -> DepthMap:
    """Return the depth map of a plane."""
    import numpy as np

    from lightfield_gs.photo.depth import DepthMap

    return DepthMap(np.ones(photo.pixels.shape[:2], np.float32), None, "flat, in the panel's plane", [])


def depth_from_file(path: Path, options: PhotoOptions, photo: Photo) -> DepthMap:
    """Read the depth map of --depth, at the photo's size. Raises InputError."""
    from lightfield_gs.photo.depth import read_numbers

    numbers = read_numbers(path)
    turn = _turn_with(options, photo, options.map_orientation)
    depth = _map_numbers(path, options, numbers, options.depth_kind, options.depth_range, photo.size, turn)
    return _resize_to_photo(str(path), replace(depth, description=f"depth by {path.name}: {depth.description}"), photo)


def depth_beside(path: Path, options: PhotoOptions, picture: Picture, side: str, photo: Photo) -> DepthMap:
    """Read the depth map in the half `side` of a picture. The defaults are Looking Glass's. Raises InputError."""
    from lightfield_gs.photo.depth import nearness
    from lightfield_gs.photo.side_by_side import read_depth_half

    numbers = read_depth_half(path, picture.pixels, side)
    limits = _limits_or(options, _BESIDE_LIMITS)
    # A reversed range means that bright is near
    is_plain = limits is not None and limits[0] <= limits[1]
    kind = options.depth_kind or (_BESIDE_KIND if is_plain else None)
    depth = _map_numbers(path, options, numbers, kind, limits, numbers.values.shape[:2])
    assumed = [
        name
        for name, is_assumed in (
            ("--depth-kind", options.depth_kind is None and is_plain),
            ("--depth-range", options.depth_range is None),
            ("--rgbd", options.rgbd is None),
        )
        if is_assumed and options.depth_scale is None
    ]
    near = f", {nearness(kind, limits)}" if kind is not None and is_plain else ""
    description = f"depth by its {side} half: {depth.description}{near}" + (
        f" (assumed; {', '.join(assumed)})" if assumed else ""
    )
    depth = replace(depth, description=description)
    return depth if photo.full_size is None else _resize_to_photo(str(path), depth, photo)


def depth_within(path: Path, options: PhotoOptions, photo: Photo) -> DepthMap:
    """Read the depth map inside the photo's file. The defaults depend on its format. Raises InputError."""
    from lightfield_gs.photo.depth import nearness
    from lightfield_gs.photo.embedded_depth import find_embedded_depth

    inside = find_embedded_depth(path)
    assert inside is not None
    limits = _limits_or(options, (inside.near, inside.far) if inside.near and inside.far else _BESIDE_LIMITS)
    kind = options.depth_kind
    if kind is None and options.depth_scale is None:
        kind = "disparity" if inside.is_inverse else "distance"
        if inside.is_inverse and not inside.is_bright_near and limits is not None:
            limits = limits[::-1]
    turn = _turn_with(options, photo, options.map_orientation or "stored")
    depth = _map_numbers(path, options, inside.numbers(path), kind, limits, photo.size, turn)
    description = f"depth inside it ({inside.name}): {depth.description}"
    if options.depth_kind is None and limits is not None:
        near = nearness(str(kind), limits)
        description += "" if near in description else f", {near}"
        if options.depth_range is None:
            description += " by its format (--depth-range FAR,NEAR where it is not)"
            description += "" if inside.near else ", near and far assumed (--depth-range)"
    return _resize_to_photo(f"{path}: the depth map inside it", replace(depth, description=description), photo)


def _limits_or(options: PhotoOptions, own: tuple[float, float]) -> tuple[float, float] | None:
    """Return the limits of the options, or the map's own where they give neither limits nor a scale."""
    return own if options.depth_range is None and options.depth_scale is None else options.depth_range


def _map_numbers(
    path: Path,
    options: PhotoOptions,
    numbers: DepthNumbers,
    kind: str | None,
    limits: tuple[float, float] | None,
    size: tuple[int, int],
    turn: Callable[[DepthNumbers], tuple[np.ndarray, bool]] | None = None,
) -> DepthMap:
    """Return the depth map of these numbers.

    Args:
        size: Height and width of the photo.

    Raises:
        InputError: the numbers are no depth map.
    """
    from lightfield_gs.photo.depth import depth_map

    return depth_map(
        path,
        numbers,
        kind,
        scale=options.depth_scale,
        limits=limits,
        invalid=options.depth_invalid or "far",
        turn=turn,
        rays=_ray_lengths(options, size, numbers.focal_px),
    )


def _turn_with(
    options: PhotoOptions, photo: Photo, choice: str | None
) -> Callable[[DepthNumbers], tuple[np.ndarray, bool]]:
    """Return the function that turns a map's numbers as the photo was turned.

    Args:
        choice: The value of --map-orientation.
    """
    from lightfield_gs.photo.map_orientation import turn_with_photo

    return lambda numbers: turn_with_photo(
        str(options.depth),
        numbers.values,
        numbers.orientation,
        photo.pixels.shape[:2],
        photo.orientation,
        choice,
        any_size=True,
    )


def _ray_lengths(
    options: PhotoOptions, size: tuple[int, int], focal_px: float | None
) -> Callable[[tuple[int, int]], np.ndarray]:
    """Return the function that gives the ray lengths of a map, by its shape.

    Args:
        options: they may name the camera.
        size: height and width of the photo.
        focal_px: the focal length in the map's file.
    """
    from lightfield_gs.photo.depth import ray_lengths
    from lightfield_gs.photo.rgbd import known_camera

    def rays(shape: tuple[int, int]) -> np.ndarray:
        focal, centre, _, _ = depth_camera(options, *size, focal_px)
        return ray_lengths(shape, size, *known_camera(focal, centre, *size))

    return rays


def _resize_to_photo(name: str, depth: DepthMap, photo: Photo) -> DepthMap:
    """Return the map at the photo's size. Raises InputError where it has another shape."""
    from lightfield_gs.photo.joint_upsampling import resize_to_photo
    from lightfield_gs.photo.map_orientation import has_same_shape

    shape, size = depth.z.shape, photo.pixels.shape[:2]
    if shape == size:
        return depth
    if not has_same_shape(shape, size):
        raise InputError(
            f"{name}: expected a depth map of the photo's size {size[1]} x {size[0]}, or of its shape, got {shape[1]} "
            f"x {shape[0]}; crop one of them, so that both show the same"
        )
    way = "along the photo's edges" if math.prod(shape) <= math.prod(size) else "pixel by pixel"
    description = f"{depth.description}, of {shape[1]} x {shape[0]}, fitted to the photo {way}"
    return replace(depth, z=resize_to_photo(depth.z, photo.floats()), description=description)


def without_holes(depth: DepthMap, options: PhotoOptions, photo: Photo) -> tuple[DepthMap, list[str]]:
    """Return a depth map whose holes are filled unless --depth-invalid is "hole", and a line on them."""
    import numpy as np

    from lightfield_gs.photo.depth_holes import fill_holes

    part = 1 - float(np.isfinite(depth.z).mean())
    if options.depth_invalid == "hole" or not 0 < part < 1:
        return depth, []
    words = f"depth: {part:.1%} was not measured; the surfaces beside go on there (holes: --depth-invalid hole)"
    return replace(depth, z=fill_holes(depth.z, photo.floats())), [words]


def depth_camera(options: PhotoOptions, height: int, width: int, focal_px: float | None) -> tuple:
    """Return the camera of a photo by --intrinsics, --fov, or the file of its depth map.

    Args:
        options: the options of the photo.
        height: of the photo, pixels.
        width: of the photo, pixels.
        focal_px: focal length in the file of the depth map.

    Returns:
        Focal lengths and principal point for `from_depth` (None: its defaults), words on them, and notes.

    Raises:
        InputError: the intrinsics cannot be this photo's.
    """
    from lightfield_gs.photo.rgbd import FIELD_OF_VIEW_DEG, focal_length_px

    if options.intrinsics is not None:
        return options.intrinsics[:2], options.intrinsics[2:], *_check_intrinsics(options.intrinsics, height, width)
    # Angles refer to the photo as it is seen, with the height of its pixels
    wide = options.pixel_aspect or 1.0
    squeezed = "" if options.pixel_aspect is None else f", its pixels {wide:g} times as wide as high"
    if options.fov is not None:
        focal = focal_length_px(options.fov, height, width * wide)
        return (focal / wide, focal), None, f"field of view {options.fov:g} degrees{squeezed}", []
    if focal_px is not None:
        focals = focal_px / wide, focal_px
        _, notes = _check_intrinsics((*focals, width / 2, height / 2), height, width)
        if options.is_estimated:
            angle = field_of_view_deg(focals, height, width)
            return focals, None, f"field of view {angle:.3g} degrees, estimated too (--fov){squeezed}", notes
        name = "its file" if options.depth is None else options.depth.name
        return focals, None, f"focal length {focal_px:.5g} px, of {name}{squeezed}", notes
    description = f"field of view {FIELD_OF_VIEW_DEG:g} degrees (assumed; --fov){squeezed}"
    if options.pixel_aspect is None:
        return None, None, description, []
    focal = focal_length_px(FIELD_OF_VIEW_DEG, height, width * wide)
    return (focal / wide, focal), None, description, []


def field_of_view_deg(focal_px: tuple[float, float], height: int, width: int) -> float:
    """Return the angle of a photo's longer side."""
    return 2 * math.degrees(math.atan(max(width / focal_px[0], height / focal_px[1]) / 2))


def _check_intrinsics(intrinsics: tuple[float, ...], height: int, width: int) -> tuple[str, list[str]]:
    """Return words on intrinsics, and notes on unusual values. Raises InputError where they cannot be the photo's."""
    fx, fy, cx, cy = intrinsics
    angle = field_of_view_deg((fx, fy), height, width)
    off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    at = f"{fx:g},{fy:g},{cx:g},{cy:g} of a photo of {width} x {height}"
    if off > 0.5 or not _ANGLES_DEG[0] <= angle <= _ANGLES_DEG[1]:
        why = (
            f"the principal point {cx:g},{cy:g} is outside it"
            if off > 0.5
            else f"the longer side would take {angle:.4g} degrees"
        )
        raise InputError(
            f"--intrinsics: {why} ({at}); expected pixels of this photo, upright: scale them with its "
            "size, or give --fov DEG"
        )
    notes = []
    if off > _OFF_CENTRE:
        notes.append(
            f"--intrinsics {at}: the principal point is far off its middle; are they of another size, or of "
            "the photo before it was turned?"
        )
    if not _USUAL_ANGLES_DEG[0] <= angle <= _USUAL_ANGLES_DEG[1] or not 0.5 <= fx / fy <= 2:
        notes.append(
            f"--intrinsics {at}: the longer side takes {angle:.4g} degrees, fx / fy is {fx / fy:.3g}; are "
            "they of another size?"
        )
    return f"focal lengths {fx:g},{fy:g} px", notes
