"""Decode videos: in time, upright, with square pixels, and in the colours of sRGB."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from lightfield_gs.base.arrays import decode_srgb, encode_srgb
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.images import MAX_PIXELS
from lightfield_gs.io.stereo_names import PairLayout

# Numbers of ITU-T H.273
_BT2020, _P3 = 9, 12  # primaries
_PQ, _HLG = 16, 18  # transfer characteristics
_NAMES = {_BT2020: "BT.2020", _P3: "Display P3", _PQ: "PQ", _HLG: "HLG"}
# Linear light of these primaries to BT.709's, which are sRGB's, all with the white D65 (ITU-R BT.2087, SMPTE EG 432)
_TO_BT709 = {
    _BT2020: np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]),
    _P3: np.array([[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]]),
}
_WHITE_NITS = 203.0  # of diffuse white in PQ (ITU-R BT.2408); in HLG it has the code 0.75
_PAUSE = 1.5  # typical steps between two frames, from which on the first is repeated
_MOST_REPEATS = 100  # of a frame on average: more means that the times are wrong
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}  # FFmpeg's own decoders drop alpha
_PAIRS = {1: "sbs", 2: "tab"}  # by AVStereo3DType
_OTHER_PAIRS = {3: "frames of both eyes in turn", 4: "a checkerboard of both eyes", 5: "a checkerboard of both eyes"}
_OTHER_PAIRS |= {6: "rows of both eyes in turn", 7: "columns of both eyes in turn", 8: "two eyes as in MV-HEVC"}


def av_library(purpose: str) -> ModuleType:
    """Import PyAV, an optional extra, which brings FFmpeg's libraries along.

    The wheels of PyAV hold x264 and x265, which are under the GPL; only videos need them.

    Args:
        purpose: The feature that needs it, for the message.

    Raises:
        InputError: PyAV is not installed.
    """
    try:
        import av
    except ImportError:
        raise InputError(f"{purpose} needs PyAV, which is not installed: pip install 'lightfield-gs[video]'") from None
    return av


@dataclass(frozen=True)
class Scaling:
    """How large pictures are reduced.

    Attributes:
        most_pixels: Number up to which a picture stays as it is.
        is_nearest: Whether each pixel is one of the picture, as depths need it, not an average.
    """

    most_pixels: int
    is_nearest: bool = False

    def size(self, height: int, width: int) -> tuple[int, int]:
        """Return the reduced height and width: multiples of four, so that halves of a picture stay halves."""
        scale = math.sqrt(self.most_pixels / (height * width))
        if scale >= 1:
            return height, width
        return max(4, int(height * scale) // 4 * 4), max(4, int(width * scale) // 4 * 4)


@dataclass(frozen=True)
class Timeline:
    """The displayed frames of a video.

    Attributes:
        order: index of the decoded frame that each displayed frame shows.
        fps: frames a second; None where the file does not tell.
        notes: lines about conversions.
    """

    order: tuple[int, ...]
    fps: Fraction | None
    notes: tuple[str, ...]
    pair: PairLayout | None = None


@contextmanager
def open_video(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open PyAV's container and the first video stream of a file. Raises InputError for every error of FFmpeg."""
    with reading(path):
        path.open("rb").close()
    with open_input(str(path), str(path)) as opened:
        yield opened


@contextmanager
def open_input(
    address: str,
    name: str,
    format: str | None = None,
    options: dict[str, str] | None = None,
    timeout: tuple[float, float] | None = None,
) -> Iterator[tuple[Any, Any]]:
    """Open PyAV's container and its first video stream.

    Args:
        address: A path, an address of a stream, or a device's name.
        name: Its name in messages.
        format: FFmpeg's name of a format or a device. None: FFmpeg finds it.
        options: Of the format.
        timeout: Seconds to open, and to read. None: without end.

    Raises:
        InputError: For every error of FFmpeg, also within the block.
    """
    av = av_library(f"{name}: a video")
    try:
        with av.open(
            address, format=format, options=options or {}, timeout=timeout, metadata_errors="replace"
        ) as container:
            if not container.streams.video:
                raise InputError(f"{name}: expected a video, got a file without pictures")
            stream = container.streams.video[0]
            if stream.width * stream.height > MAX_PIXELS:
                raise InputError(f"{name}: {stream.width} x {stream.height} pixels; expected at most {MAX_PIXELS}")
            stream.thread_type = "AUTO"
            yield container, stream
    except av.FFmpegError as error:
        raise InputError(f"{name} is not a video that can be read: {error.strerror or error}") from error


def timeline(path: Path, in_time: bool = True) -> Timeline:
    """Return which decoded frame a video shows when. Only the first frame is decoded.

    Args:
        path: the video.
        in_time: whether frames that are shown longer than others are repeated; else each comes once.

    Raises:
        InputError: for a file that is no video, or has no frames.
    """
    with open_video(path) as (container, stream):
        frame, found, times = None, 0, []
        for packet in container.demux(stream):
            frame = frame or next(iter(packet.decode()), None)
            # The count in the header is often 0 or wrong. Edit lists of trimmed videos discard packets
            if packet.size > 0 and not packet.is_discard:
                found += 1
                times += [] if packet.pts is None else [float(packet.pts * packet.time_base)]
        rate, base = stream.average_rate, stream.base_rate
        pair = None if frame is None else pair_layout(frame)
        notes = [] if frame is None else list(_conversions(stream, frame))
    if not found:
        raise InputError(f"{path}: expected a video, got one without frames")
    order, fps = tuple(range(found)), Fraction(rate) if rate else None
    gaps = np.diff(np.sort(times))
    if in_time and len(times) == found > 2 and (step := float(np.median(gaps))) > 0 and gaps.max() > _PAUSE * step:
        count = round(float(gaps.sum()) / step) + 1
        if count <= _MOST_REPEATS * found:
            fps = Fraction(base) if base and abs(base * step - 1) < 0.05 else Fraction(1 / step).limit_denominator(1001)
            starts = np.concatenate([[0.0], np.cumsum(gaps)])
            shown = np.searchsorted(starts, (np.arange(count) + 0.5) * step) - 1
            order = tuple(shown.tolist())
            notes.append(f"its {found} frames come at unequal times: repeated to {count} at {float(fps):g} a second")
    return Timeline(order, fps, tuple(f"{path.name}: {note}" for note in notes), pair)


def pair_layout(frame: Any) -> PairLayout | None:
    """Return where a frame has two eyes' pictures: by StereoMode of Matroska, st3d of MP4, or the stream's own words.

    FFmpeg gives them all as AVStereo3D, which begins with the layout and with flags.
    """
    for data in frame.side_data:
        if data.type.name == "STEREO3D" and len(bytes(data)) >= 8:
            layout, flags = np.frombuffer(bytes(data)[:8], np.int32)
            if layout in _PAIRS:
                return PairLayout(_PAIRS[int(layout)], bool(flags & 1), "the video's metadata", None)
    return None


def _notes_on_eyes(frame: Any) -> Iterator[str]:
    """Yield lines on stereo that a frame has in a way that is not read, and on films all round."""
    for data in frame.side_data:
        if data.type.name == "SPHERICAL":
            yield "its pictures are panoramas; they are taken as flat ones, and distances far from the middle are off"
        if data.type.name == "STEREO3D" and len(bytes(data)) >= 8:
            layout = int(np.frombuffer(bytes(data)[:4], np.int32)[0])
            if layout in _OTHER_PAIRS:
                yield (
                    f"its metadata states {_OTHER_PAIRS[layout]}; expected both eyes side by side or one above the "
                    f"other, so one film is taken: convert it, as with ffmpeg's filter stereo3d"
                )


def decode(path: Path, maps: bool = False) -> Iterator[np.ndarray]:
    """Yield the frames, uint8 [H, W, 3], or [H, W, 4] where the video has alpha.

    Args:
        path: the video.
        maps: whether it holds depths. Depths of more than 8 bits are uint16 [H, W, 1], as stored where they are grey
            of 16 bits, else scaled to 0..65535. Their colours are not converted.

    Raises:
        InputError: for a file that cannot be decoded.
    """
    with open_video(path) as (container, stream):
        kind = PixelKind.of(stream)
        for frame in frames_of(container, stream):
            yield frame_pixels(frame, kind, maps)


@dataclass(frozen=True)
class PixelKind:
    """The pixels of a stream, as they hold when it is closed: its frames outlive it.

    Attributes:
        aspect: Width over height of one.
        curve: Number of ITU-T H.273 of the transfer characteristics.
        primaries: Likewise of the primaries.
    """

    aspect: Fraction
    curve: int
    primaries: int

    @staticmethod
    def of(stream: Any) -> PixelKind:
        """Return the kind of the pixels of PyAV's stream."""
        context = stream.codec_context
        return PixelKind(_pixel_aspect(stream), int(context.color_trc), int(context.color_primaries))


def frame_pixels(frame: Any, kind: PixelKind, maps: bool = False, scaling: Scaling | None = None) -> np.ndarray:
    """Return the pixels of a frame of PyAV, as `decode` yields them.

    Args:
        frame: The frame.
        kind: Of the pixels of its stream.
        maps: See `decode`.
        scaling: How a large frame is reduced. None: it is not.
    """
    aspect, curve, primaries = kind.aspect, kind.curve, kind.primaries
    if maps and frame.format.components[0].bits > 8:
        pixels = _scale(frame, aspect, "gray16le", scaling)[..., None]
    elif not maps and (curve in (_PQ, _HLG) or primaries in _TO_BT709):
        pixels = _to_srgb(_scale(frame, aspect, "rgb48le", scaling), curve, primaries)
    else:
        has_alpha = any(component.is_alpha for component in frame.format.components)
        pixels = _scale(frame, aspect, "rgba" if has_alpha else "rgb24", scaling)
    return np.ascontiguousarray(_apply_display_matrix(pixels, frame))


def frames_of(container: Any, stream: Any) -> Iterator[Any]:
    """Yield PyAV's frames, deinterlaced, with alpha where the video has it."""
    av = av_library("a video")
    decoder = _ALPHA_DECODERS.get(stream.codec_context.name)
    if stream.metadata.get("alpha_mode") == "1" and decoder in av.codecs_available:
        context = av.CodecContext.create(decoder, "r")
        packets = container.demux(stream)
        decoded_frames = (frame for packet in packets for frame in context.decode(packet if packet.size else None))
    else:
        decoded_frames = container.decode(stream)
    graph: Any = None
    for number, frame in enumerate(decoded_frames):
        if number == 0 and frame.interlaced_frame:
            graph = av.filter.Graph()
            graph.link_nodes(graph.add_buffer(template=stream), graph.add("yadif"), graph.add("buffersink")).configure()
        if graph is None:
            yield frame
            continue
        graph.vpush(frame)
        yield from _pull(graph)
    if graph is not None:
        graph.vpush(None)
        yield from _pull(graph)


def _pull(graph: Any) -> Iterator[Any]:
    """Yield the frames that a filter graph has ready."""
    av = av_library("a video")
    while True:
        try:
            yield graph.vpull()
        except (av.BlockingIOError, av.EOFError):
            return


def _conversions(stream: Any, frame: Any) -> Iterator[str]:
    """Yield lines about the conversions of a video, by its first frame."""
    yield from _notes_on_eyes(frame)
    aspect = _pixel_aspect(stream)
    if aspect != 1:
        yield f"pixels of {aspect.numerator}:{aspect.denominator} are made square"
    if frame.interlaced_frame:
        yield "interlaced fields are made whole frames (yadif)"
    curve, primaries = stream.codec_context.color_trc, stream.codec_context.color_primaries
    known = [_NAMES[number] for number in (primaries, curve) if number in _NAMES]
    if known:
        yield f"colours of {', '.join(known)} are converted to sRGB, and what is brighter than white is cut"


def _pixel_aspect(stream: Any) -> Fraction:
    """Return width over height of a pixel; 1 where the video does not tell."""
    return Fraction(stream.sample_aspect_ratio or 1)


def _scale(frame: Any, aspect: Fraction, pixel_format: str, scaling: Scaling | None) -> np.ndarray:
    """Scale a frame to square pixels; the shorter side is enlarged."""
    width, height = frame.width, frame.height
    if aspect > 1:
        width = min(round(width * aspect), MAX_PIXELS // height)
    elif aspect < 1:
        height = min(round(height / aspect), MAX_PIXELS // width)
    how: dict[str, str] = {}
    if scaling is not None:
        height, width = scaling.size(height, width)
        how = {"interpolation": "POINT"} if scaling.is_nearest else {"interpolation": "AREA"}
    return frame.reformat(width=width, height=height, format=pixel_format, **how).to_ndarray()


def _apply_display_matrix(pixels: np.ndarray, frame: Any) -> np.ndarray:
    """Turn and mirror a frame by its display matrix (ISO 14496-12, 8.3.2), in quarter turns."""
    entries = [data for data in frame.side_data if data.type.name == "DISPLAYMATRIX"]
    if not entries:
        return pixels
    a, b, _, c, d = np.frombuffer(bytes(entries[0]), np.int32)[:5].astype(np.int64)  # x' = a x + c y, y' = b x + d y
    if abs(b) + abs(c) > abs(a) + abs(d):
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def _to_srgb(codes: np.ndarray, curve: int, primaries: int) -> np.ndarray:
    """Convert RGB codes uint16 [H, W, 3] to sRGB, uint8, white at 1 (ITU-R BT.2100, BT.2408)."""
    values = np.linspace(0.0, 1.0, 65536)
    if curve == _HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(values <= 0.5, values**2 / 3, (np.exp((values - c) / a) + b) / 12)
        light /= (np.exp((0.75 - c) / a) + b) / 12
    elif curve == _PQ:
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        power = values ** (1 / m2)
        light = (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1) * (10000 / _WHITE_NITS)
    else:
        light = decode_srgb(values)
    linear = light.astype(np.float32)[codes]
    if primaries in _TO_BT709:
        linear = linear @ _TO_BT709[primaries].T.astype(np.float32)
    return (encode_srgb(linear.clip(0, 1)) * 255 + 0.5).astype(np.uint8)
