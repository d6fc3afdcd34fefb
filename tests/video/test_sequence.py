"""Pictures in a row, from folders and from videos, whole ones and others."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from lightfield_gs import InputError
from lightfield_gs.io.images import read_image, write_image
from lightfield_gs.video.sequence import is_sequence, open_sequence
from lightfield_gs.video.video_file import VideoFile


def pictures(count: int = 6) -> list[np.ndarray]:
    r = np.random.default_rng(1)
    return [r.integers(0, 256, (24, 32, 3), dtype=np.uint8) for _ in range(count)]


@pytest.fixture
def video(tmp_path) -> Path:
    pytest.importorskip("av", reason="videos need the extra `video`")
    with VideoFile(tmp_path / "a.mp4", 6, (32, 24), Fraction(30000, 1001), "h264-rgb") as sink:
        for number, picture in enumerate(pictures()):
            sink.put(number, picture)
    return tmp_path / "a.mp4"


def test_files_are_in_the_order_of_their_numbers(tmp_path):
    for name in ("f10.png", "f9.png", "f1.png", ".f2.png", "notes.txt"):
        if name.endswith("png"):
            write_image(tmp_path / name, pictures(1)[0])
        else:
            (tmp_path / name).write_text("no picture")
    sequence = open_sequence(tmp_path)
    assert [path.name for path in sequence.files] == ["f1.png", "f9.png", "f10.png"] and sequence.fps is None
    assert [(n, path.name) for n, path in sequence.pictures([0, 2], tmp_path)] == [(0, "f1.png"), (2, "f10.png")]
    digest = sequence.digest()
    write_image(tmp_path / "f9.png", 255 - pictures(1)[0])
    assert open_sequence(tmp_path).digest() != digest
    assert is_sequence(tmp_path) and not is_sequence(tmp_path / "f9.png")


def test_frames_of_a_video(tmp_path, video):
    sequence = open_sequence(video)
    assert sequence.count == 6 and sequence.fps == Fraction(30000, 1001) and is_sequence(video)
    for number, path in sequence.pictures([1, 4], tmp_path):
        assert (read_image(path, as_stored=True) == pictures()[number]).all()


def test_a_video_that_was_filmed_upright_is_turned(tmp_path, video):
    """The matrix of the track header (ISO 14496-12, 8.3.2) as telephones write it: a quarter to the right."""
    data = bytearray(video.read_bytes())
    at = data.index(b"tkhd") + 44
    quarter = np.array([0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30], ">i4").tobytes()
    assert data[at : at + 4] == (1 << 16).to_bytes(4, "big")
    data[at : at + 36] = quarter
    video.write_bytes(data)
    _, path = next(open_sequence(video).pictures([0], tmp_path))
    assert (read_image(path, as_stored=True) == np.rot90(pictures()[0], -1)).all()


def test_hostile_videos(tmp_path, video):
    """Cut and damaged anywhere: frames or one line, and no crash."""
    whole = video.read_bytes()
    r = np.random.default_rng(2)
    said = 0
    for trial in range(60):
        data = bytearray(whole)
        if trial % 2:
            data = data[: r.integers(0, len(data))]
        else:
            for place in r.integers(0, len(data), 8):
                data[place] = r.integers(0, 256)
        video.write_bytes(data)
        try:
            sequence = open_sequence(video)
            for _, path in sequence.pictures(list(range(sequence.count)), tmp_path):
                assert read_image(path).ndim == 3
        except InputError as error:
            said += 1
            assert str(video) in str(error) and "\n" not in str(error)
    assert said > 10


def test_no_pictures(tmp_path):
    with pytest.raises(InputError, match="expected a folder of pictures"):
        open_sequence(tmp_path)
    with pytest.raises(InputError, match="cannot read"):
        open_sequence(tmp_path / "no.mp4")
