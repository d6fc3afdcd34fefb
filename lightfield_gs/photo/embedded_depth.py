"""Depth maps and further pictures in the file of a photo.

Sources: Depthmap Metadata (Google, 2014), whose namespace is usually GDepth, with the map in base64; Dynamic Depth 1.0
(Google, 2019), with the map behind the picture. In both a number d of 0..1 is the distance near + d (far - near), or
with the format RangeInverse far near / (far - d (far - near)): dark is near. A telephone's HEIC holds disparities as an
auxiliary picture: bright is near.
"""

from __future__ import annotations

import base64
import binascii
import functools
import mmap
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.images import apply_orientation, read_layer
from lightfield_gs.io.pillow_images import HeifDepth, count_pictures, decode_picture, is_heif, read_heif_depth
from lightfield_gs.io.xmp import jpeg_xmp
from lightfield_gs.photo.depth import DepthNumbers, depth_channel, grey_numbers

_NAMESPACES = {
    "http://ns.google.com/photos/1.0/depthmap/": "GDepth",
    "http://ns.google.com/photos/dd/1.0/depthmap/": "Dynamic Depth",
}
_GIMAGE = "http://ns.google.com/photos/1.0/image/"
# Names in the boxes of HEIC and AVIF, in the XMP of an auxiliary JPEG, and in the trailer of Samsung's files
_HEIF_DEPTH = (b"urn:mpeg:hevc:2015:auxid:2", b"urn:mpeg:mpegB:cicp:systems:auxiliary:depth")
_APPLE_DEPTH = re.compile(rb"AuxiliaryImageType(=\"|>)(disparity|depth)", re.IGNORECASE)
_SAMSUNG_DEPTH = b"DualShot_DepthMap"
_UNIFORM_Z = 2  # depth representation type of a HEIC: the others are inverse distances or disparities
_FARTHEST_RATIO = 50  # far / near of a HEIC, at most: disparities that reach 0 state no far distance
# An item of a container, with attributes or with elements; where the first picture ends, and others begin
_ITEM = re.compile(r"<\w+:Item\b([^>]*?)(?:/>|>(.*?)</\w+:Item>)", re.DOTALL)
_PICTURE_STARTS = (b"\xff\xd8\xff", b"\x89PNG")
_BEHIND_PICTURE = re.compile(rb"\xff\xd9\x00*(?=\xff\xd8\xff|\x89PNG)")
_BOXES_BYTES, _TRAILER_BYTES = 1 << 20, 4096


@dataclass(frozen=True)
class EmbeddedDepth:
    """A depth map in the file of a photo.

    Attributes:
        name: Its format, for people.
        data: A PNG or JPEG, or pixels [H, W, C].
        is_inverse: Whether its numbers are linear in 1/z.
        near: Distance at one end; None where the file has no valid one.
        far: Distance at the other end; None where the file has no valid one.
        is_along_ray: See DepthNumbers.
        is_bright_near: Whether large numbers are near.
    """

    name: str
    data: bytes | np.ndarray
    is_inverse: bool
    near: float | None
    far: float | None
    is_along_ray: bool = False
    is_bright_near: bool = False

    def numbers(self, path: str | Path) -> DepthNumbers:
        """Return the numbers of the map; raise InputError."""
        name = f"{path}: the depth map inside it"
        pixels = decode_picture(name, self.data) if isinstance(self.data, bytes) else self.data
        return replace(grey_numbers(name, pixels), is_along_ray=self.is_along_ray)


def find_embedded_depth(path: str | Path) -> EmbeddedDepth | None:
    """Return the depth map in a photo's XMP, behind its picture, or in a box; None without a readable map.

    Raises:
        InputError: The file cannot be read.
    """
    path = Path(path)
    with reading(path):
        if not path.is_file():
            return None
        state = path.stat()
        return _read_embedded_depth(path, state.st_mtime_ns, state.st_size) if state.st_size else None


def embedded_notes(path: str | Path, is_depth_used: bool) -> list[str]:
    """Return notes on unused content of a photo's file; raise InputError where it cannot be read."""
    path = Path(path)
    notes = []
    with reading(path):
        if not is_depth_used and (words := _describe_unused_depth(path)):
            notes.append(f"{path}: {words}")
        count, are_eyes = count_pictures(path)
        if are_eyes or f'"{_GIMAGE}"' in jpeg_xmp(path) and not find_embedded_depth(path):
            notes.append(
                f"{path}: it is a stereo photo, and the first of its two pictures is taken, one eye's; the other is "
                "left out"
            )
        elif count > 1:
            notes.append(
                f"{path}: it holds {count} pictures, and the first is taken; for all, as a sequence, save them as a "
                "video or as files in a folder for `lightfield-gs video`"
            )
    return notes


def embedded_facts(path: str | Path) -> list[tuple[str, str]]:
    """Return the content of a photo's file beside its picture, by name, for people; raise InputError."""
    path = Path(path)
    facts = []
    with reading(path):
        if (embedded := find_embedded_depth(path)) is not None:
            height, width = embedded.numbers(path).values.shape
            facts.append(
                ("depth inside", f"{width} x {height}, {embedded.name}, near {embedded.near}, far {embedded.far}")
            )
        elif words := _describe_unused_depth(path):
            facts.append(("depth inside", words))
        count, are_eyes = count_pictures(path)
        if count > 1:
            facts.append(("pictures", f"{count}" + (", of two eyes" if are_eyes else "")))
    return facts


@functools.lru_cache(maxsize=8)
def _read_embedded_depth(path: Path, changed: int, size: int) -> EmbeddedDepth | None:
    """Read the depth map; changed, size: of the file, so that another file of the same name is read again."""
    if is_heif(path):
        found = read_heif_depth(path)
        return None if found is None else _with_limits(found)
    xmp = jpeg_xmp(path)
    for (namespace, name), find in zip(_NAMESPACES.items(), (_decode_base64, _read_container_item)):
        if f'"{namespace}"' not in xmp:
            continue
        values = _properties(xmp, namespace)
        data = find(path, xmp, values)
        if data:
            near, far = _ordered(_number(values.get("Near")), _number(values.get("Far")))
            words = f"{name} {values.get('Format') or 'without a format'}"
            is_inverse = values.get("Format", "").lower() == "rangeinverse"
            is_along_ray = values.get("MeasureType", "").lower() == "opticray"
            return EmbeddedDepth(words, data, is_inverse, near, far, is_along_ray)
    return None


def _with_limits(depth: HeifDepth) -> EmbeddedDepth:
    """Return the depth map of a HEIC with its limits, upright."""
    pixels, facts = np.ascontiguousarray(apply_orientation(depth.pixels, depth.orientation)), depth.facts
    near, far = facts.get("z_near"), facts.get("z_far")
    if facts.get("representation_type") == _UNIFORM_Z:
        return EmbeddedDepth("HEIC distance", pixels, False, *_ordered(near, far))
    low, high = facts.get("d_min"), facts.get("d_max")
    if low is not None and high is not None and low < high and high > 0:
        least = max(low, high / _FARTHEST_RATIO)
        if low < least and pixels.dtype.kind == "u":
            fraction = low + pixels.astype(np.float32) / np.iinfo(pixels.dtype).max * (high - low)
            fraction = ((fraction - least) / (high - least)).clip(0, 1)
            pixels = np.rint(fraction * np.iinfo(np.uint16).max).astype(np.uint16)
        near, far = round(1 / high, 6), round(1 / least, 6)
    return EmbeddedDepth("HEIC disparity", pixels, True, *_ordered(near, far), is_bright_near=True)


def _ordered(near: float | None, far: float | None) -> tuple[float | None, float | None]:
    """Return the limits of a map; None for both where they are not valid."""
    return (near, far) if near is not None and far is not None and 0 < near < far else (None, None)


def _decode_base64(path: Path, xmp: str, values: dict[str, str]) -> bytes:
    try:
        return base64.b64decode(re.sub(r"&#\w+;|\s+", "", values.get("Data", "")))
    except (binascii.Error, ValueError):
        raise InputError(f"{path}: the depth map in its XMP is damaged; give another with depth=FILE") from None


def _read_container_item(path: Path, xmp: str, values: dict[str, str]) -> bytes:
    """Return the depth map among the items behind the picture; empty without one."""
    items = [
        dict(re.findall(r'\w+:(\w+)\s*=\s*"([^"]*)"', match[1]) + re.findall(r"<\w+:(\w+)>([^<]*)</", match[2] or ""))
        for match in _ITEM.finditer(xmp)
    ]
    lengths = [_whole(item.get("Length")) for item in items]
    # Behind the picture, and behind each item, may be bytes without meaning
    sizes = [length + _whole(item.get("Padding")) for item, length in zip(items, lengths)]
    for index, item in enumerate(items):
        is_named = item.get("DataURI") and item.get("DataURI") == values.get("DepthURI")
        if index and (is_named or item.get("Semantic", "").lower() in ("depth", "depthmap")):
            data = path.read_bytes()
            starts = [len(data) - lengths[index] - sum(sizes[index + 1 :]) - _whole(item.get("Padding"))]
            starts += [match.end() + sum(sizes[1:index]) for match in _BEHIND_PICTURE.finditer(data)]
            for start in starts:
                if start > 0 and data.startswith(_PICTURE_STARTS, start):
                    return data[start : start + lengths[index]]
            return b""
    return b""


def _whole(text: str | None) -> int:
    return int(text) if text is not None and text.isdecimal() and len(text) < 12 else 0


def _properties(xmp: str, namespace: str) -> dict[str, str]:
    """Return the properties of a namespace, written as attributes or as elements; of several the first."""
    found: dict[str, str] = {}
    for prefix in re.findall(rf'xmlns:(\w+)\s*=\s*"{re.escape(namespace)}"', xmp):
        for pattern in (rf'\b{prefix}:(\w+)\s*=\s*"([^"]*)"', rf"<{prefix}:(\w+)>([^<]*)</"):
            for name, value in re.findall(pattern, xmp):
                found.setdefault(name, value)
    return found


def _number(text: str | None) -> float | None:
    try:
        return float(text or "")
    except ValueError:
        return None


def _describe_unused_depth(path: Path) -> str:
    """Return a line on a depth map in the file that is not read, with the remedy; "" without one."""
    if (embedded := find_embedded_depth(path)) is not None:
        return f"a depth map is in it ({embedded.name}) and is not used, as options ask for another way"
    way = "and is not read; save it as a picture of its own, for depth=FILE"
    with open(path, "rb") as file:
        start = file.read(_BOXES_BYTES)
    if is_heif(path):
        is_there = any(word in start for word in _HEIF_DEPTH)
        return f"a depth map is in it (an auxiliary picture), {way}" if is_there else ""
    if start.startswith(b"\x76\x2f\x31\x01"):  # EXR
        layer = read_layer(path, depth_channel)
        return "" if layer is None else f"its channel {layer.name} holds distances: give the file as depth= too"
    for namespace, name in _NAMESPACES.items():
        if f'"{namespace}"' in jpeg_xmp(path):
            return f"a depth map should be in it ({name}), and is not found; give one with depth=FILE"
    if not start.startswith(b"\xff\xd8"):
        return ""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if _APPLE_DEPTH.search(data):
            return f"a depth map is in it (Apple's auxiliary picture), {way}"
        if data.rfind(_SAMSUNG_DEPTH, max(0, len(data) - _TRAILER_BYTES)) >= 0:
            return f"a depth map is in it (Samsung's), {way}"
    return ""
