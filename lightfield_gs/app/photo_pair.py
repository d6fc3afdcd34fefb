"""A stereo pair as a photo with a depth map: the left eye's picture, and depths by matching it with the right one's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.stereo_names import PairLayout, layout_in_name

if TYPE_CHECKING:
    import numpy as np

    from lightfield_gs.io.images import Picture
    from lightfield_gs.photo.depth import DepthMap
    from lightfield_gs.photo.photo import Photo
    from lightfield_gs.photo.second_eye import SecondEye
    from lightfield_gs.photo.stereo_matching import Parallax
    from lightfield_gs.photo.stereo_pair import Pair, PairCamera
    from lightfield_gs.video.sequence import ImageSequence

# Options that ask for another way to a scene than by both eyes
_OTHER_WAYS = ("depth", "rgbd", "mask", "checkpoint", "detail", "detail_budget")


class MatchedPair(NamedTuple):
    """The eyes' pictures, matched.

    Attributes:
        layout: Where they were in the file.
        camera: Their cameras, where the file has them.
        found: Their parallax.
    """

    layout: PairLayout
    camera: PairCamera | None
    found: Parallax


class PairPhoto(NamedTuple):
    """The left eye's picture with its depths.

    Attributes:
        options: With the intrinsics of the left camera, where they are known.
        photo: The picture.
        matched: It and the right eye's.
    """

    options: PhotoOptions
    photo: Photo
    matched: MatchedPair


def pair_of(path: Path, options: PhotoOptions) -> PairLayout | None:
    """Return the layout of a stereo pair whose depth is to come of both eyes; None for other photos.

    Without OpenCV only --stereo-in makes a pair: one eye of others is taken as a photo. Raises InputError.
    """
    if options.stereo_in == "none" or has_other_way(options):
        return None
    from lightfield_gs.photo.stereo_pair import can_match, find_pair

    if options.stereo_in is not None:
        return PairLayout(options.stereo_in, options.swap_eyes, "--stereo-in")
    if not path.is_file() or not can_match():
        return None
    found = options.pair or find_pair(path)
    if found is None or not options.swap_eyes:
        return found
    return replace(found, is_swapped=not found.is_swapped, source=f"{found.source} and --swap-eyes")


def guessed_pair(options: PhotoOptions, picture: Picture) -> PairLayout | None:
    """Return the layout of a picture whose halves look like two eyes', unless an option names another way."""
    from lightfield_gs.photo.side_by_side import stereo_layout
    from lightfield_gs.photo.stereo_pair import can_match

    if options.stereo_in is not None or has_other_way(options) or not can_match():
        return None
    words = stereo_layout(picture.pixels)
    if words is None:
        return None
    kind = "sbs" if words == "side by side" else "tab"
    return PairLayout(kind, options.swap_eyes, "its two like halves (a guess; else: --stereo-in none)", None)


def with_video_pair(options: PhotoOptions, pictures: ImageSequence) -> PhotoOptions:
    """Return the options with the layout that a video's metadata states, unless they name one or another way.

    Where its name says that the halves are squeezed, which metadata cannot, they are.
    """
    from lightfield_gs.photo.stereo_pair import can_match

    pair = pictures.pair
    if pair is None or options.stereo_in is not None or has_other_way(options) or not can_match():
        return options
    named = layout_in_name(pictures.path)
    if named is not None and named.is_squeezed is not None and pair.kind.removeprefix("half-") in named.kind:
        pair = replace(pair, kind=named.kind)
    return replace(options, pair=pair)


def has_other_way(options: PhotoOptions) -> bool:
    """Return whether options ask for an object, or for depths that do not come of two eyes."""
    return options.remove_background or any(getattr(options, name) is not None for name in _OTHER_WAYS)


def check_pair_options(options: PhotoOptions) -> None:
    """Raise InputError where --stereo-in and another way to depths or objects are asked for."""
    if options.stereo_in in (None, "none"):
        return
    for name in (*_OTHER_WAYS, "remove_background"):
        if getattr(options, name) not in (None, False):
            raise InputError(
                f"--{name.replace('_', '-')} takes the place of --stereo-in {options.stereo_in}; leave out one of them"
            )


def match_pair(path: Path, options: PhotoOptions, pair: Pair, most_pixels: int) -> PairPhoto:
    """Match the pictures of a stereo pair.

    Args:
        path: The file.
        options: Of the photo.
        pair: The two pictures.
        most_pixels: Number up to which they are reduced.

    Raises:
        InputError: The pictures do not match.
    """
    from lightfield_gs.photo.load import cut_out_photo
    from lightfield_gs.photo.photo import reduce_photo
    from lightfield_gs.photo.rgbd import check_photo_size
    from lightfield_gs.photo.stereo_matching import PairMismatch, Parallax, match_eyes

    check_photo_size(str(path), *pair.left.pixels.shape[:2])
    photo, right = (cut_out_photo(path, eye, whole=True) for eye in (pair.left, pair.right))
    for eye in (photo, right):
        reduce_photo(eye, most_pixels)
    try:
        found = match_eyes(str(path), _bytes(photo), _bytes(right))
    except PairMismatch:
        if options.film_parallax is None:
            raise
        found = Parallax.unmatched(_bytes(right))
    if pair.camera is not None and options.intrinsics is None and options.fov is None:
        options = _with_camera(options, pair.camera, photo.size[1])
    return PairPhoto(options, photo, MatchedPair(pair.layout, pair.camera, found))


def pair_depth(options: PhotoOptions, photo: Photo, matched: MatchedPair) -> tuple[DepthMap, SecondEye]:
    """Return the depths of a left picture by its parallaxes, and what the right eye sees. Raises InputError."""
    from lightfield_gs.photo.second_eye import second_eye

    found = matched.found
    depth = _pair_depth(options, found, matched.camera, photo)
    second = second_eye(_bytes(photo), found.right, depth.z, found.shifts, found.right_shifts)
    return replace(depth, description=f"{_words(matched.layout, found)}: {depth.description}"), second


def _bytes(photo: Photo) -> np.ndarray:
    """Return the colours of a photo as uint8 [H, W, 3]."""
    import numpy as np

    colours = photo.pixels[..., :3]
    if colours.dtype != np.uint8:
        colours = np.rint(255 * colours.clip(0, 1)).astype(np.uint8)
    return np.ascontiguousarray(colours)


def _with_camera(options: PhotoOptions, camera: PairCamera, width: int) -> PhotoOptions:
    """Return the options with the intrinsics of the left camera, for a picture of this width."""
    scale = width / camera.width_px
    return replace(options, intrinsics=tuple(scale * value for value in (*camera.focal_px, *camera.principal_point_px)))


def _pair_depth(options: PhotoOptions, found: Parallax, camera: PairCamera | None, photo: Photo) -> DepthMap:
    """Return the depths of parallaxes: by --depth-scale or the cameras, or else between --depth-range's ends."""
    import numpy as np
    import torch

    from lightfield_gs.photo.depth import DepthMap
    from lightfield_gs.photo.joint_upsampling import disparities_to_z
    from lightfield_gs.photo.stereo_pair import pair_to_z

    shrunk = photo.pixels.shape[1] / photo.size[1]
    if options.depth_scale is not None:
        parallax = found.shifts / shrunk
        if not (parallax > 0).any():
            raise InputError(
                "--depth-scale is of parallel cameras, and no parallax is > 0; give --depth-range NEAR,FAR"
            )
        floor = np.median(parallax[parallax > 0]) / 20
        z = (options.depth_scale / np.maximum(parallax, floor)).astype(np.float32)
        return DepthMap(z, None, f"distance = {options.depth_scale:g} / parallax in pixels", [])
    if camera is not None and options.depth_range is None:
        z = pair_to_z(found.shifts, camera, photo.pixels.shape[1] / camera.width_px)
        return DepthMap(z, None, f"distances by {camera.words}", [])
    width, ends = photo.pixels.shape[1], options.film_parallax
    of_film = None if ends is None else (ends[0] * width, ends[1] * width)
    made = disparities_to_z(torch.from_numpy(found.shifts), options.depth_range, of_film)
    words = made.description if ends is None else f"{made.description}, the same in all frames"
    return DepthMap(made.z(made.disparities).numpy(), None, words, made.notes)


def _words(layout: PairLayout, found: Parallax) -> str:
    """Return which picture is taken for which eye's, and how well they match."""
    kind = {"sbs": "side by side", "tab": "one above the other", "two": "two pictures"}[
        layout.kind.removeprefix("half-")
    ]
    if layout.kind.startswith("half"):
        kind += ", squeezed"
    first = {"sbs": "left half", "tab": "upper half", "two": "first picture"}[layout.kind.removeprefix("half-")]
    eye = "right" if layout.is_swapped else "left"
    level = f", {found.raised_px:.1f} px of difference in height taken out" if found.raised_px else ""
    return (
        f"stereo pair by {layout.source}, {kind}, the {first} is the {eye} eye's (else: --swap-eyes), "
        f"{found.matched:.0%} matches{level}; depth by parallax"
    )
