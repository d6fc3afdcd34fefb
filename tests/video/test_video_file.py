"""Videos: lossless ones come back to the byte, others nearly, and a native one is never sub-sampled."""

import shutil
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from lightfield_gs import InputError
from lightfield_gs.video.video_file import VideoFile, choose_codec

av = pytest.importorskip("av", reason="videos need the extra `video`")


def noise(width: int, height: int) -> list[np.ndarray]:
    r = np.random.default_rng(0)
    return [r.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(9)]


def write(path: Path, frames: list[np.ndarray], codec, **options) -> None:
    height, width = frames[0].shape[:2]
    with VideoFile(path, len(frames), (width, height), Fraction(24), codec, **options) as sink:
        for number in sink.missing:
            sink.put(number, frames[number])


def read(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == 24
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("name, codec", [("a.mkv", "ffv1"), ("a.mkv", "h264-rgb"), ("a.mp4", "h264-rgb")])
@pytest.mark.parametrize("size", [(64, 48), (61, 37)])
def test_lossless_to_the_byte(tmp_path, name, codec, size):
    frames = noise(*size)
    write(tmp_path / name, frames, codec)
    back = read(tmp_path / name)
    assert len(back) == len(frames) and all((a == b).all() for a, b in zip(back, frames))
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_sub_sampled_videos_keep_the_colours(tmp_path, codec):
    """Plain colours, so that only the matrix of the colours counts."""
    colours = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (200, 100, 50), (255, 255, 255), (0, 0, 0)]
    frames = [np.full((64, 96, 3), colour, np.uint8) for colour in colours]
    write(tmp_path / "a.mp4", frames, codec, crf=4)
    for frame, expected in zip(read(tmp_path / "a.mp4"), frames):
        assert np.abs(frame.astype(int) - expected).max() <= 6
    with av.open(str(tmp_path / "a.mp4")) as container:
        context = container.streams.video[0].codec_context
        assert (context.pix_fmt, context.colorspace, context.color_primaries) == ("yuv420p", 1, 1)


def test_native_videos_are_never_sub_sampled(tmp_path):
    for codec in ("h264", "hevc"):
        with pytest.raises(InputError, match="4:2:0.* mixes sub-pixels of different views"):
            choose_codec(tmp_path / "a.mp4", "native", codec)
    assert choose_codec(tmp_path / "a.mp4", "native", None) == "h264-rgb"
    assert choose_codec(tmp_path / "a.mkv", "native", None) == "ffv1"
    assert choose_codec(tmp_path / "a.mkv", "quilt", None) == "h264"
    with pytest.raises(InputError, match="ffv1 goes into .mkv"):
        choose_codec(tmp_path / "a.mp4", "native", "ffv1")
    with pytest.raises(InputError, match="expected .mp4, .mkv, .mov"):
        choose_codec(tmp_path / "a.webm", "native", None)


def test_odd_sizes_cannot_be_sub_sampled(tmp_path):
    with pytest.raises(InputError, match="takes even sizes, got 61 x 48"):
        VideoFile(tmp_path / "a.mp4", 1, (61, 48), Fraction(24), "h264")


def test_nothing_half_written_is_left(tmp_path):
    frames = noise(64, 48)
    with pytest.raises(KeyboardInterrupt):
        with VideoFile(tmp_path / "a.mp4", 9, (64, 48), Fraction(24), "h264") as sink:
            sink.put(0, frames[0])
            raise KeyboardInterrupt
    with pytest.raises(InputError, match="cannot write"):  # FFmpeg says no to a frame of another kind
        with VideoFile(tmp_path / "a.mp4", 99, (64, 48), Fraction(24), "h264") as sink:
            for _ in range(99):
                sink.put(0, frames[0][..., :1])
    assert list(tmp_path.iterdir()) == []


def test_what_fails_at_the_very_end_is_said(tmp_path):
    frames = noise(64, 48)
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot write .*No such file"):
        with VideoFile(tmp_path / "folder" / "a.mkv", 9, (64, 48), Fraction(24), "ffv1") as sink:
            sink.put(0, frames[0])
            time.sleep(0.3)
            shutil.rmtree(tmp_path / "folder")
