"""HEIC files with a depth map: pictures that PyAV codes, in boxes of the test's choice."""

import io
import math
import struct

import numpy as np
import pytest


def heic(
    photo: np.ndarray,
    depth: np.ndarray | None = None,
    *,
    turn: int = 0,
    depth_turn: int | None = None,
    facts: dict[str, float] | None = None,
    exif: bytes = b"",
    right: np.ndarray | None = None,
    baseline_m: float = 0.02,
) -> bytes:
    """Return a HEIC.

    Args:
        photo: [H, W, 3] uint8, as stored; sides are multiples of 8, and of 16 at least.
        depth: [h, w] uint8, as stored.
        turn: Quarter turns anticlockwise of the photo for display.
        depth_turn: The same for the depth map; None: as the photo.
        facts: z_near, z_far, d_min and d_max; type. None: no representation information.
        exif: A TIFF with metadata of the photo.
        right: The right eye's picture, of the photo's size, in a group of two eyes, with cameras whose focal length is
            .8 of the width.
        baseline_m: The cameras' distance.
    """
    pictures = {1: _code(photo)} if depth is None else {1: _code(photo), 2: _code(depth)}
    if right is not None:
        pictures[2] = _code(right)
    turns = {1: turn, 2: turn if depth_turn is None else depth_turn}
    sizes = {1: photo.shape, 2: photo.shape if depth is None else depth.shape}
    kind = b"urn:mpeg:hevc:2015:auxid:2\0" + (b"" if facts is None else _representation(facts))
    properties, rows = [], b""
    for item, (configuration, _) in pictures.items():
        first = len(properties) + 1
        properties += [configuration, _box(b"ispe", struct.pack(">III", 0, sizes[item][1], sizes[item][0]))]
        properties += [_box(b"irot", bytes([turns[item]]))]
        properties += [_box(b"auxC", bytes(4) + kind)] if item == 2 and depth is not None else []
        if right is not None:
            unit = 1 << 20
            matrix = struct.pack(">Iiii", 20 << 8, round(0.8 * unit), unit // 2, unit // 2)
            place = struct.pack(">Ii", 1, round((item - 1) * baseline_m * 1e6))
            properties += [_box(b"cmin", matrix), _box(b"cmex", place)]
        used = [0x80 | index for index in range(first, len(properties) + 1)]
        rows += struct.pack(">HB", item, len(used)) + bytes(used)
    boxes = _box(b"ipco", b"".join(properties)) + _box(b"ipma", struct.pack(">II", 0, len(pictures)) + rows)
    contents = {item: (b"hvc1", data) for item, (_, data) in pictures.items()}
    references = [_box(b"auxl", struct.pack(">HHH", 2, 1, 1))] if depth is not None else []
    if exif:
        contents[3] = b"Exif", bytes(4) + exif
        references.append(_box(b"cdsc", struct.pack(">HHH", 3, 1, 1)))
    infos = b"".join(
        _box(b"infe", struct.pack(">IHH4sB", 2 << 24, item, 0, name, 0)) for item, (name, _) in contents.items()
    )
    start = _box(b"ftyp", b"heic" + bytes(4) + b"mif1heicmiaf")

    def meta(offset: int) -> bytes:
        extents = b""
        for item, (_, data) in contents.items():
            extents += struct.pack(">HHHII", item, 0, 1, offset, len(data))
            offset += len(data)
        parts = (
            _box(b"hdlr", bytes(8) + b"pict" + bytes(13)),
            _box(b"pitm", bytes(4) + struct.pack(">H", 1)),
            _box(b"iloc", struct.pack(">IBBH", 0, 0x44, 0, len(contents)) + extents),
            _box(b"iinf", struct.pack(">IH", 0, len(contents)) + infos),
            _box(b"iprp", boxes),
            _box(b"iref", bytes(4) + b"".join(references)) if references else b"",
            b"" if right is None else _box(b"grpl", _box(b"ster", struct.pack(">IIIII", 0, 9, 2, 1, 2))),
        )
        return _box(b"meta", bytes(4) + b"".join(parts))

    coded = b"".join(data for _, data in contents.values())
    return start + meta(len(start) + len(meta(0)) + 8) + _box(b"mdat", coded)


def _code(pixels: np.ndarray) -> tuple[bytes, bytes]:
    """Return a picture's box hvcC, and its coded picture."""
    av = pytest.importorskip("av", reason="needs the package av, which codes the HEIC")
    grey = pixels.ndim == 2
    film = io.BytesIO()
    with av.open(film, "w", format="mp4") as container:
        stream = container.add_stream(
            "libx265",
            rate=1,
            options={"x265-params": "log-level=none:info=0:pools=none:frame-threads=1:bframes=0", "crf": "4"},
        )
        stream.height, stream.width = pixels.shape[:2]
        stream.pix_fmt = "gray" if grey else "yuv420p"
        frame = av.VideoFrame.from_ndarray(pixels, format="gray" if grey else "rgb24")
        frame.pts = 0
        container.mux([*stream.encode(frame), *stream.encode()])
    data = film.getvalue()
    at = data.index(b"mdat")
    return _find(data, b"hvcC"), data[at + 4 : at - 4 + int.from_bytes(data[at - 4 : at], "big")]


def _box(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + name + content


def _find(data: bytes, name: bytes) -> bytes:
    at = data.index(name) - 4
    return data[at : at + int.from_bytes(data[at : at + 4], "big")]


def _representation(facts: dict[str, float]) -> bytes:
    """Return the supplemental information on a depth map: H.265, F.14.2.3, in a message of type 177."""
    names = ("z_near", "z_far", "d_min", "d_max")
    bits = "".join(str(int(name in facts)) for name in names) + _unsigned(int(facts.get("type", 1)))
    bits += _unsigned(0) if "d_min" in facts or "d_max" in facts else ""
    for name in names:
        if name in facts:
            mantissa, exponent = math.frexp(facts[name])  # in 0.5..1, or nought
            fraction, power = (round((2 * mantissa - 1) * 2**20), exponent - 1 + 31) if mantissa else (0, 0)
            bits += f"0{power:07b}{19:05b}{fraction:020b}"
    payload = int(bits.ljust(-(-len(bits) // 8) * 8, "0"), 2).to_bytes(-(-len(bits) // 8), "big")
    message = struct.pack(">HBB", 39 << 9 | 1, 177, len(payload)) + payload
    return struct.pack(">II", 4 + len(message), len(message)) + message


def _unsigned(value: int) -> str:
    """Return the bits of an exponential Golomb code."""
    digits = f"{value + 1:b}"
    return "0" * (len(digits) - 1) + digits
