"""Training images as premultiplied RGBA of the object, which is found in the same way in all views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.captures.objects import ObjectImages
from lightfield_gs.io.captures.photograph import read_mask
from lightfield_gs.io.captures.undistortion import brown_source_positions, undistort
from lightfield_gs.io.images import read_image, read_info
from training.data.background import Background, Choice, find_background, premultiplied, read_border


@dataclass(frozen=True)
class Cutout:
    """The source of the mask of an object's views.

    Attributes:
        background: The background, if the mask comes from it.
    """

    by: Literal["masks", "alpha", "background", "nothing"]
    background: Background | None = None

    def __str__(self) -> str:
        return {
            "masks": "cut out by masks",
            "alpha": "cut out by alpha",
            "nothing": "whole pictures are the subject",
            "background": f"cut out by the background, {self.background}",
        }[self.by]


def find_cutout(views: ObjectImages, background: Choice = "auto") -> Cutout:
    """Choose how an object is cut out of its views: by masks, else by alpha if a view has any, else by its background.

    Views that cannot be read do not count.

    Args:
        background: of views without masks and alpha: "auto" finds its colour, "white" and "black" name it. With "none"
            the whole picture is the subject, as in rooms.

    Raises:
        InputError: no view has such a background.
    """
    if views.mask_paths is not None:
        return Cutout("masks")
    borders = []
    for path in views.image_paths:
        try:
            pixels = _stored(views, path)
        except InputError:
            continue  # named by whoever reads this view
        if pixels.shape[2] == 4 and pixels[..., 3].min() < 255:
            return Cutout("alpha")
        borders.append(read_border(pixels[..., :3], _is_lossy(path)))
    found = find_background(borders, background)
    if found and background != "auto" and not any((view.pixels == found.colour).all(-1).any() for view in borders):
        raise InputError(
            f"{views.image_paths[0].parent}: expected a {background} background, but no view has a "
            "pixel of it at its border: give another, or auto"
        )
    return Cutout("background", found) if found else Cutout("nothing")


def read_view(views: ObjectImages, index: int, cutout: Cutout | None = None) -> np.ndarray:
    """Return one view of an object as premultiplied uint8 [H,W,4], free of lens distortion.

    Args:
        cutout: As find_cutout finds it; None finds it.

    Raises:
        InputError: an image or mask is unreadable, an image's size differs from the intrinsics' size, or an image shows
            no object.
    """
    return _straightened(views, index, _cut_out(views, index, cutout or find_cutout(views)))


def read_colours(views: ObjectImages, index: int) -> np.ndarray:
    """The colours of a view, object or not, uint8 [H,W,3], free of lens distortion. Raises InputError as read_view."""
    return _straightened(views, index, _stored(views, views.image_paths[index])[..., :3])


def _straightened(views: ObjectImages, index: int, image: np.ndarray) -> np.ndarray:
    """A stored picture [H,W,C] without its lens distortion."""
    if views.distortion is None or not views.distortion[index].any():
        return image
    places = brown_source_positions(views.intrinsics[index], views.distortion[index], views.width_px, views.height_px)
    return undistort(image, places)


def _cut_out(views: ObjectImages, index: int, cutout: Cutout) -> np.ndarray:
    """A view as it is stored, as premultiplied uint8 [H,W,4]."""
    path = views.image_paths[index]
    pixels = _stored(views, path)
    rgb, alpha = pixels[..., :3], np.full(pixels.shape[:2], 255, np.uint8) if pixels.shape[2] == 3 else pixels[..., 3]
    why = "every pixel is transparent"
    if cutout.by == "masks":
        mask = read_mask(views.mask_paths[index], views.width_px, views.height_px)
        alpha, why = np.minimum(alpha, mask), f"nothing is white in {views.mask_paths[index]}"
    frame = premultiplied(rgb, alpha)
    if cutout.background is not None:
        frame, why = cutout.background.cut(rgb), f"every pixel is of the background, {cutout.background}"
    if not frame[..., 3].any():
        raise InputError(f"{path}: empty image: expected an object, {why}")
    return frame


def _stored(views: ObjectImages, path: Path) -> np.ndarray:
    """The pixels uint8 [H,W,3 or 4] of a view as they are stored: its pose is of these, whatever Exif says."""
    with named("unreadable image"):
        pixels = read_image(path, as_stored=True, turn=False)
    if pixels.dtype != np.uint8 or pixels.shape[2] not in (3, 4):
        raise InputError(f"{path}: expected 8-bit RGB or RGBA, got {pixels.shape[2]} channels of {pixels.dtype}")
    if pixels.shape[:2] != (views.height_px, views.width_px):
        raise InputError(
            f"{path}: bad intrinsics: {views.size_field}: they say {views.width_px} x {views.height_px} "
            f"pixels, the image has {pixels.shape[1]} x {pixels.shape[0]}{_way_out(views, path, pixels)}"
        )
    return pixels


def _way_out(views: ObjectImages, path: Path, pixels: np.ndarray) -> str:
    """Return the remedy for an image of another size than its camera."""
    orientation = read_info(path).orientation
    if pixels.shape[:2] != (views.width_px, views.height_px):
        return ": give the camera of the images as they are stored, or resize them"
    if orientation < 5:
        return ": width and height are exchanged"
    return (
        f" as stored, with Exif orientation {orientation}: the cameras seem to be of the turned images, poses are "
        "of the stored ones: store the images turned (ImageMagick: mogrify -auto-orient), or find the cameras "
        "again with the orientation left alone"
    )


def _is_lossy(path: Path) -> bool:
    """Whether the format of an image alters its pixels: JPEG, and WebP but for its lossless kind."""
    if path.suffix.lower() != ".webp":
        return path.suffix.lower() in (".jpg", ".jpeg")
    with path.open("rb") as file:
        return b"VP8L" not in file.read(1 << 16)  # RFC 9649, section 2.6: after 12 bytes, or chunks of metadata
