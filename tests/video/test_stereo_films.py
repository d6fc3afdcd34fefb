"""Films of stereo pairs: their layout by the container alone, and depths that neither breathe nor flicker."""

import struct
from pathlib import Path

import numpy as np
import pytest
from rgbd_scene import textured

from lightfield_gs import cli
from lightfield_gs.app.options import PhotoOptions
from lightfield_gs.app.photo import read_photo
from lightfield_gs.app.photo_pair import with_video_pair
from lightfield_gs.app.stereo_film import film_parallax, steady_pairs
from lightfield_gs.video.sequence import open_sequence

av = pytest.importorskip("av", reason="videos need the extra `video`")
BLACK = 1


def film(path: Path, frames: list[np.ndarray], **metadata: str) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=5, options={"crf": "8"})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv444p"
        stream.metadata.update(metadata)
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode())
    return path


def box(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + name + content


def with_boxes(path: Path, boxes: bytes) -> Path:
    """Put boxes at the end of the sample entry of an MP4 whose header comes last."""
    data = bytearray(path.read_bytes())
    header = data.index(b"moov")
    entry = data.index(b"avc1", header) - 4
    end = entry + int.from_bytes(data[entry : entry + 4], "big")
    data[end:end] = boxes
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1"):
        at = data.index(name, header) - 4
        data[at : at + 4] = (int.from_bytes(data[at : at + 4], "big") + len(boxes)).to_bytes(4, "big")
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("mode, kind, is_swapped", [("left_right", "sbs", False), ("bottom_top", "tab", True)])
def test_stereo_mode_of_matroska(tmp_path, mode, kind, is_swapped):
    pair = open_sequence(film(tmp_path / "a.mkv", [np.zeros((64, 96, 3), np.uint8)] * 2, stereo_mode=mode)).pair
    assert (pair.kind, pair.is_swapped) == (kind, is_swapped)


def test_boxes_of_mp4(tmp_path):
    """st3d states the layout; sv3d says that the pictures are panoramas, which a line tells."""
    black = [np.zeros((64, 96, 3), np.uint8)] * 2
    plain = film(tmp_path / "a.mp4", black)
    assert open_sequence(plain).pair is None
    found = open_sequence(with_boxes(plain, box(b"st3d", bytes(4) + b"\1")))
    assert (found.pair.kind, found.notes) == ("tab", ())
    equirectangular = box(b"proj", box(b"prhd", bytes(16)) + box(b"equi", bytes(20)))
    spherical = box(b"sv3d", box(b"svhd", bytes(4) + b"x\0") + equirectangular)
    found = open_sequence(with_boxes(film(tmp_path / "b.mp4", black), box(b"st3d", bytes(4) + b"\2") + spherical))
    assert found.pair.kind == "sbs" and "panoramas" in found.notes[0]


def test_eyes_in_turn_are_told(tmp_path):
    black = [np.zeros((64, 96, 3), np.uint8)] * 2
    found = open_sequence(film(tmp_path / "a.mkv", black, stereo_mode="block_lr"))
    assert found.pair is None and "frames of both eyes in turn" in found.notes[0]


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> Path:
    """A still scene in noise, once with a patch much nearer than all else, and with a black frame."""
    random = np.random.default_rng(0)
    patch = random.random((60, 60, 3))
    frames = []
    for number in range(7):
        left, right = textured()[0].copy(), textured(0.12)[0].copy()
        if number == BLACK:
            left[:], right[:] = 0, 0
        if number > 4:
            left[100:160, 160:220], right[100:160, 125:185] = patch, patch
        pair = np.concatenate([left, right], 1)
        pair = (pair + random.normal(0, 0.02, pair.shape)).clip(0, 1)
        frames.append(np.rint(255 * pair).astype(np.uint8))
    return film(tmp_path_factory.mktemp("film") / "film.mkv", frames, stereo_mode="left_right")


def test_still_things_stay_where_they_are(tmp_path, noisy):
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    pictures = open_sequence(noisy)
    options = with_video_pair(PhotoOptions(), pictures)
    numbers = [number for number in range(pictures.count) if number != BLACK]
    plain = [(number, read_photo(path, options)) for number, path in pictures.pictures(numbers, tmp_path)]
    common = PhotoOptions(pair=options.pair, film_parallax=film_parallax(source for _, source in plain))
    of_film = [(number, read_photo(path, common)) for number, path in pictures.pictures(numbers, tmp_path)]
    still = (slice(40, 90), slice(40, 120))

    def changes(row):
        inverse = [1 / source.depth.z[still] for _, source in row]
        return [float(np.abs(after - before).mean()) for before, after in zip(inverse, inverse[1:])]

    steady = list(steady_pairs(of_film))
    assert [number for number, _ in steady] == numbers
    assert max(changes(plain)) > 0.02  # the patch moves all depths
    assert max(changes(of_film)) < 0.01 and np.mean(changes(steady)) < 0.3 * np.mean(changes(of_film))


def test_frames_that_do_not_match_are_flat_and_told(tmp_path, noisy, monkeypatch, capsys):
    pytest.importorskip("cv2", reason="OpenCV is not installed")
    monkeypatch.chdir(tmp_path)
    assert cli.main(f"video {noisy} -o f --panel toy-8v --kind 2d --frames 3".split()) == 0
    out = capsys.readouterr().out
    assert "by the video's metadata" in out and "the same in all frames" in out
    assert f"1 frames whose eyes' pictures do not match are shown flat: {BLACK}" in out
    assert "next:" not in out
