"""Frames of videos as they are seen, whatever the file does with time, pixels and colours."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from lightfield_gs.video.decoding import decode, timeline

av = pytest.importorskip("av", reason="videos need the extra `video`")
SIZE = (24, 32)


def write(
    path: Path,
    frames: Sequence[np.ndarray],
    codec: str = "ffv1",
    pixels: str = "bgr0",
    given: str = "rgb24",
    times: Sequence[int] | None = None,
    options: dict[str, str] | None = None,
    **context,
) -> Path:
    """A video of ten frames a second, or with frames at these tenths of a second; context: of its encoder."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options or {})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.codec_context.time_base = pixels, Fraction(1, 10)
        for name, value in context.items():
            setattr(stream.codec_context, name, value)
        for number, array in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(array, format=given)
            frame.pts, frame.time_base = number if times is None else times[number], Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def greys(count: int) -> list[np.ndarray]:
    return [np.full((*SIZE, 3), 20 * number, np.uint8) for number in range(count)]


def shown(path: Path) -> list[int]:
    """The first number of each picture in its order."""
    pictures = [int(frame[0, 0, 0]) for frame in decode(path)]
    return [pictures[index] for index in timeline(path).order]


def test_a_pause_repeats_the_frame_before_it(tmp_path):
    path = write(tmp_path / "a.mkv", greys(4), times=[0, 1, 5, 6])
    assert shown(path) == [0, 20, 20, 20, 20, 40, 60]
    found = timeline(path)
    assert found.fps == 10 and "4 frames come at unequal times: repeated to 7 at 10 a second" in found.notes[0]
    even = timeline(write(tmp_path / "b.mkv", greys(4)))
    assert even.order == (0, 1, 2, 3) and not even.notes


def test_what_an_edit_list_leaves_out_is_not_counted(tmp_path):
    """The entry of a trim (ISO 14496-12, 8.6.6): its media time is moved by four frames."""
    path = write(tmp_path / "a.mp4", greys(12), "libx264rgb", "rgb24", options={"qp": "0", "bf": "0"})
    data = bytearray(path.read_bytes())
    at = data.index(b"elst") + 16
    start = int.from_bytes(data[at : at + 4], "big", signed=True) + 4 * 1024
    data[at : at + 4] = start.to_bytes(4, "big")
    path.write_bytes(data)
    assert shown(path) == list(range(80, 240, 20))


def test_pixels_are_made_square(tmp_path):
    path = write(tmp_path / "a.mp4", greys(1), "libx264rgb", "rgb24", sample_aspect_ratio=Fraction(4, 3))
    assert next(decode(path)).shape == (24, 43, 3) and "pixels of 4:3 are made square" in timeline(path).notes[0]
    tall = write(tmp_path / "b.mp4", greys(1), "libx264rgb", "rgb24", sample_aspect_ratio=Fraction(1, 2))
    assert next(decode(tall)).shape == (48, 32, 3)


def test_depths_of_sixteen_bits_are_kept(tmp_path):
    depths = np.arange(24 * 32, dtype=np.uint16).reshape(SIZE) * 80
    path = write(tmp_path / "a.mkv", [depths], pixels="gray16le", given="gray16le")
    (found,) = decode(path, maps=True)
    assert found.dtype == np.uint16 and (found[..., 0] == depths).all()


@pytest.mark.parametrize("curve, code", [(18, 0.75), (16, 0.5807)])
def test_white_of_hdr_is_white(tmp_path, curve, code):
    """Diffuse white of HLG and PQ (ITU-R BT.2408), and its half; a red of BT.2020 that sRGB has not is cut."""
    half = {18: 0.6075, 16: 0.5100}[curve]
    rows = np.zeros((*SIZE, 3))
    rows[:8], rows[8:16], rows[16:, :, 0] = code, half, code
    planes = np.round(rows * 65535).astype(np.uint16)
    path = write(tmp_path / "a.mkv", [planes], pixels="gbrp16le", given="rgb48le", color_trc=curve, color_primaries=9)
    (found,) = decode(path)
    assert abs(found[4, 4].astype(int) - 255).max() <= 1 and abs(found[12, 4].astype(int) - 188).max() <= 2
    assert found[20, 4].tolist() == [255, 0, 0] and "converted to sRGB" in timeline(path).notes[0]


def test_fields_become_frames(tmp_path):
    """A bar that moves between the fields of a frame is combed before, and is not afterwards."""
    frames = []
    for number in range(6):
        frame = np.full((64, 64, 3), 230, np.uint8)
        for field in (0, 1):
            left = 8 * number + 4 * field
            frame[field::2, left : left + 12] = 20
        frames.append(frame)
    path = write(tmp_path / "a.mkv", frames, "libx264", "yuv420p", options={"x264-params": "tff=1:qp=0"})
    with av.open(str(path)) as container:
        assert next(container.decode(video=0)).interlaced_frame

    def combed(frame: np.ndarray) -> float:
        rows = frame[..., 0].astype(int)
        return float(np.abs(rows[1:-1] - (rows[:-2] + rows[2:]) / 2).mean())

    assert len(list(decode(path))) == 6
    assert combed(list(decode(path))[3]) < 0.3 * combed(frames[3]) and "interlaced" in timeline(path).notes[0]


def test_alpha_is_taken(tmp_path):
    cut_out = np.zeros((*SIZE, 4), np.uint8)
    cut_out[4:20, 8:24] = (200, 40, 40, 255)
    path = write(tmp_path / "a.webm", [cut_out] * 2, "libvpx-vp9", "yuva420p", "rgba", options={"lossless": "1"})
    found = next(decode(path))
    assert found.shape == (24, 32, 4) and (found[..., 3] == cut_out[..., 3]).all()


@pytest.mark.parametrize("matrix, like", [((-1, 0, 0, 1), np.fliplr), ((0, 1, 1, 0), np.transpose)])
def test_mirrored_videos_are_turned_back(tmp_path, matrix, like):
    """The matrix of the track header (ISO 14496-12, 8.3.2), as front cameras write it."""
    picture = np.random.default_rng(1).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    path = write(tmp_path / "a.mp4", [picture], "libx264rgb", "rgb24", options={"qp": "0"})
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 44
    a, b, c, d = (part << 16 for part in matrix)
    data[at : at + 36] = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()
    path.write_bytes(data)
    turned = like(picture) if like is np.fliplr else picture.transpose(1, 0, 2)
    assert (next(decode(path)) == turned).all()
