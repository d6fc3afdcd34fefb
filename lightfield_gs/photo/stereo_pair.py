"""Stereo pairs in the files of photos: where the two eyes' pictures are, by metadata or name, and how they were taken.

Sources: PNG extensions (chunk sTER), JPS (segment APP3, see io/jpeg_pairs.py), MPO (CIPA DC-007), HEIC with a group
'ster' and the item properties 'cmin' and 'cmex' of its cameras (ISO/IEC 23008-12).
"""

from __future__ import annotations

import base64
import binascii
import functools
import importlib.util
import json
import re
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.images import Picture, apply_orientation, read_info, read_picture
from lightfield_gs.io.jpeg_pairs import JPS_LEFT_FIRST, JPS_NAME
from lightfield_gs.io.pillow_images import (
    decode_picture,
    heif_pair_cameras,
    is_heif,
    read_further_picture,
    second_eye_number,
)
from lightfield_gs.io.stereo_names import PairLayout, layout_in_name
from lightfield_gs.io.xmp import jpeg_xmp

_GIMAGE = "http://ns.google.com/photos/1.0/image/"
_GDEPTH = "http://ns.google.com/photos/1.0/depthmap/"
_HEAD_BYTES = 1 << 16
_NO_PAIR = PairLayout("one", False, "its segment of JPS")  # one picture, whatever the name
_RECORD = {"layout", "focal_px", "principal_point_px", "width_px", "baseline", "zero_depth"}


@dataclass(frozen=True)
class PairCamera:
    """The cameras of a pair. Lengths in pixels are of the left picture as it was taken.

    Attributes:
        focal_px: fx and fy.
        principal_point_px: cx and cy of the left picture.
        width_px: Width of that picture.
        baseline: Distance between the cameras, scene units.
        inverse_zero_depth: 1/z of what both pictures show at the same place: 0 where the cameras are parallel.
        words: What they are known by.
    """

    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    width_px: float
    baseline: float
    inverse_zero_depth: float
    words: str


@dataclass
class Pair:
    """The pictures of two eyes.

    Attributes:
        left: With pixels [H, W, C], upright.
        right: Of the same size.
        camera: Their cameras, where the file has them.
        layout: Where they were found.
    """

    left: Picture
    right: Picture
    camera: PairCamera | None
    layout: PairLayout


def can_match() -> bool:
    """Return whether OpenCV, which matches the pictures, is installed."""
    try:
        return importlib.util.find_spec("cv2") is not None
    except ValueError:  # of a stand-in without a specification
        return False


def find_pair(path: Path) -> PairLayout | None:
    """Return where the two pictures are, as the file's metadata or its name says; None for other photos.

    Raises:
        InputError: The file cannot be read.
    """
    with reading(path):
        state = path.stat()
        return _find_pair(path, state.st_mtime_ns, state.st_size) if state.st_size and path.is_file() else None


@functools.lru_cache(maxsize=8)
def _find_pair(path: Path, changed: int, size: int) -> PairLayout | None:
    """Find the pair; changed, size: of the file, so that another file of the same name is read again."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if (found := _by_segments(path, head)) is not None:
        return None if found is _NO_PAIR else found
    if not head.startswith((b"\x89PNG", b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"BM")) and not is_heif(path):
        return None
    named = layout_in_name(path)
    if is_heif(path):
        if heif_pair_cameras(path) is not None:
            return PairLayout("two", False, "its group of two eyes")
        return named
    if second_eye_number(path) is not None:
        return PairLayout("two", False, "its two pictures")
    if (stated := _own_record(path)) is not None and stated["layout"] in ("sbs", "half-sbs", "tab"):
        return PairLayout(stated["layout"], False, "its metadata")
    return named or (PairLayout("two", False, "its XMP (GImage)") if _second_in_xmp(path) else None)


def _by_segments(path: Path, head: bytes) -> PairLayout | None:
    """Return the layout by a JPEG's segment of JPS or a PNG's chunk sTER."""
    at = head.find(b"sTER")
    if head.startswith(b"\x89PNG") and at > 0 and head[at - 4 : at] == b"\0\0\0\1":
        return PairLayout("sbs", head[at + 4] == 0, "its chunk sTER")
    at = head.find(JPS_NAME)
    if head.startswith(b"\xff\xd8") and at > 0 and len(head) > at + 14:
        words = struct.unpack_from(">4B", head, at + len(JPS_NAME) + 2)
        # The other order of bytes has the kind first, and the separation, usually 0, last
        _, flags, layout, kind = words if words[3] == 1 or words[0] != 1 else words[::-1]
        if kind == 1 and layout not in (2, 3):
            ways = {1: "rows of both eyes in turn", 4: "an anaglyph"}.get(layout, f"layout {layout}")
            raise InputError(
                f"{path}: its segment of JPS states {ways}; expected two pictures side by side or one above the "
                "other: save it so, or give stereo_in=none to take it as one photo"
            )
        if kind == 0:
            return _NO_PAIR
        if kind == 1:
            name = {2: "sbs", 3: "tab"}[layout]
            if flags & (2 if layout == 2 else 1):
                name = f"half-{name}"
            return PairLayout(name, not flags & JPS_LEFT_FIRST, "its segment of JPS")
    return None


def _own_record(path: Path) -> dict[str, Any] | None:
    """Return how this program drew a pair; None for other files."""
    try:
        stored = json.loads(read_info(path).metadata.get("stereo", "null"))
    except (InputError, ValueError):
        return None
    return stored if isinstance(stored, dict) and set(stored) >= _RECORD else None


def _second_in_xmp(path: Path) -> bytes:
    """Return the right eye's picture in a JPEG's XMP; empty without one.

    Both may be panoramas; beside a depth map it is the same picture before it was blurred.
    """
    xmp = jpeg_xmp(path)
    if f'"{_GIMAGE}"' not in xmp or "GPano:ProjectionType" in xmp or f'"{_GDEPTH}"' in xmp:
        return b""
    found = re.search(r'GImage:Data(?:="|>)([^"<]+)', xmp)
    try:
        return base64.b64decode(re.sub(r"&#\w+;|\s+", "", found[1])) if found else b""
    except (binascii.Error, ValueError):
        return b""


def read_pair(path: Path, layout: PairLayout) -> Pair:
    """Read the pictures of both eyes, upright; raise InputError."""
    return replace(split_pair(path, read_picture(path), layout), camera=_camera(path))


def split_pair(path: Path, picture: Picture, layout: PairLayout) -> Pair:
    """Return the pictures of both eyes in a picture; raise InputError. The file is read for a second picture alone."""
    layout = layout.resolved(*picture.pixels.shape[:2])
    if layout.kind == "two":
        left, right = picture.pixels, _second_picture(path, picture)
    else:
        left, right = split_eyes(path, picture.pixels, layout.kind)
    if layout.is_swapped:
        left, right = right, left
    if left.shape[:2] != right.shape[:2]:
        sizes = " and ".join(f"{eye.shape[1]} x {eye.shape[0]}" for eye in (left, right))
        raise InputError(
            f"{path}: expected two pictures of one size, got {sizes}; give stereo_in=none to take the first"
        )
    return Pair(replace(picture, pixels=left), replace(picture, pixels=right), None, layout)


def split_eyes(path: Path, pixels: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the two halves of a picture [H, W, C], those that were squeezed at twice their width or height.

    An odd row or column in the middle is left out. Raises InputError for pictures of less than 32 pixels.
    """
    axis = 1 if kind.endswith("sbs") else 0
    if min(pixels.shape[:2]) < 32:
        raise InputError(f"{path}: {pixels.shape[1]} x {pixels.shape[0]} pixels are too few for a stereo pair")
    half = pixels.shape[axis] // 2
    first, second = (
        np.take(pixels, range(half), axis),
        np.take(pixels, range(pixels.shape[axis] - half, pixels.shape[axis]), axis),
    )
    if kind.startswith("half"):
        first, second = np.repeat(first, 2, axis), np.repeat(second, 2, axis)
    return first, second


def _second_picture(path: Path, picture: Picture) -> np.ndarray:
    """Return the second picture of a file, upright as the first one."""
    if data := _second_in_xmp(path):
        second = decode_picture(f"{path}: the second picture inside it", data)
    else:
        second = read_further_picture(path, 1 if is_heif(path) else second_eye_number(path) or 1)
    return np.ascontiguousarray(second if is_heif(path) else apply_orientation(second, picture.orientation))


def _camera(path: Path) -> PairCamera | None:
    """Return the cameras of a pair by its file."""
    if is_heif(path):
        return _heif_camera(path)
    stored = _own_record(path)
    if stored is None:
        return None
    (fx, fy), (cx, cy) = stored["focal_px"], stored["principal_point_px"]
    return PairCamera(
        (fx, fy), (cx, cy), stored["width_px"], stored["baseline"], 1 / stored["zero_depth"], "its metadata"
    )


def _heif_camera(path: Path) -> PairCamera | None:
    """Return the cameras of a spatial photo: parallel ones, with the baseline in metres."""
    found = heif_pair_cameras(path)
    if found is None or found.focal is None or found.baseline_m is None:
        return None
    info = read_info(path)
    width, height = info.width_px, info.height_px
    focal = found.focal * width
    centre = found.centre[0] * width, found.centre[1] * height
    return PairCamera((focal, focal), centre, width, found.baseline_m, 0.0, "its cameras, in metres")


def pair_to_z(shifts: np.ndarray, camera: PairCamera, scale: float) -> np.ndarray:
    """Return view-space z of parallaxes: 1/z = 1/z_zero + shift/(fx baseline).

    What would lie beyond infinity is put at 20 times the median.

    Args:
        shifts: x_left - x_right, [H, W], in pixels of a picture of another size.
        camera: Of the pair.
        scale: Width of the picture of `shifts`, by that of the camera's.
    """
    inverse = camera.inverse_zero_depth + shifts / (scale * camera.focal_px[0] * camera.baseline)
    positive = inverse[inverse > 0]
    if not positive.size:
        raise InputError("stereo: everything would lie beyond infinity; are the eyes exchanged (swap_eyes=True)?")
    return (1 / np.maximum(inverse, np.median(positive) / 20)).astype(np.float32)
