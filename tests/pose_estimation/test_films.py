"""Films and bursts become photographs with poses: one of each step of parallax, and none that is blurred."""

import sys
from pathlib import Path

import numpy as np
import pytest
from capture_scene import said
from command_line import run
from film_scene import HEIGHT, WIDTH, arc, photographs, shaken, wall, write_film
from heic_maker import heic
from PIL import Image

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.pose_estimation.exif import lens_key
from lightfield_gs.pose_estimation.films import choose_pictures, write_film_frames
from lightfield_gs.pose_estimation.gather import gather_photographs
from lightfield_gs.pose_estimation.options import PoseOptions

STILL = range(12, 20)  # the camera stands
BLURRED = (3, 9, 24, 25)
ANGLES_DEG = np.interp(np.arange(32), [0, 11, 20, 31], [-10, -1, -1, 10])


@pytest.fixture(scope="module")
def pictures() -> np.ndarray:
    """A walk of 32 pictures over 20 degrees, which rests on its way; four are blurred."""
    frames = photographs(wall(0.2), arc(ANGLES_DEG)).copy()
    for index in BLURRED:
        frames[index] = shaken(frames[index], 11)
    return frames


@pytest.fixture(scope="module")
def film(pictures, tmp_path_factory) -> Path:
    pytest.importorskip("av")
    return write_film(tmp_path_factory.mktemp("film") / "walk.mp4", pictures)


def test_one_sharp_picture_of_each_step_of_parallax(pictures):
    pytest.importorskip("cv2")
    chosen = choose_pictures(pictures, 100, False)
    assert chosen.blurred == len(BLURRED) and not set(BLURRED) & set(chosen.indices)
    assert len(set(STILL) & set(chosen.indices)) <= 2  # the step before it may end there, and the next begin
    gaps = np.diff(ANGLES_DEG[chosen.indices])
    assert gaps.max() < 4  # of 20 degrees: no part of the way is missing
    few = choose_pictures(pictures, 8, False)
    assert len(few.indices) == 8 and not set(BLURRED) & set(few.indices)
    assert set(BLURRED) & set(choose_pictures(pictures, 100, True).indices)


def test_a_turn_on_the_spot_shows_no_parallax(pictures, tmp_path):
    """The picture moves, but near and far alike: a step begins where the view is another one, far more rarely."""
    pytest.importorskip("cv2")
    turn = np.stack([np.roll(pictures[0], 2 * index, 1)[:, 60:-60] for index in range(30)])
    assert choose_pictures(turn, 100, False).steps < choose_pictures(pictures[:30, :, 60:-60], 100, False).steps / 2
    still = write_film(tmp_path / "still.mp4", np.repeat(pictures[:1], 10, 0))
    with pytest.raises(InputError, match="expected a film of a camera that moves .* whose 10 frames show no parallax"):
        write_film_frames(still, tmp_path, 100, False, lambda words: None)


@pytest.mark.slow
@pytest.mark.not_sanitized
def test_a_film_becomes_a_scene(film, tmp_path, capsys):
    """The poses agree with those that the film was made by, up to a similarity."""
    pytest.importorskip("pycolmap")
    options = "--frames 12 --steps 2 --gaussians 500 --longest-px 64 --device cpu"
    out = run(capsys, f"fit {film} --sfm -o {tmp_path / 's.ply'} {options}")
    assert "12 of 32 frames are taken, the sharpest of each step of parallax (--frames N" in out
    assert "4 frames are blurred and left out (--keep-blurred" in out
    capture, _ = said(tmp_path / "s.fit/sfm")
    indices = [int(name.removeprefix("frame-").removesuffix(".jpg")) for name in capture.names]
    assert len(indices) >= 11 and not set(BLURRED) & set(indices)
    truth = arc(ANGLES_DEG[indices])
    centres = -(truth[:, :3, :3].swapaxes(1, 2) @ truth[:, :3, 3:])[..., 0]
    assert _distance_by_similarity(capture.centres, centres) < 0.02 * np.ptp(centres[:, 0])


def _distance_by_similarity(points: np.ndarray, truth: np.ndarray) -> float:
    """The root of the mean squared distance of points [N,3] after the best similarity (Umeyama, 1991)."""
    a, b = points - points.mean(0), truth - truth.mean(0)
    left, values, right = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(left @ right))])
    rotation, scale = left * sign @ right, (values * sign).sum() / (a**2).sum()
    return float(np.sqrt(((scale * a @ rotation.T - b) ** 2).sum(1).mean()))


def test_a_folder_of_films_and_photographs(pictures, film, tmp_path):
    """Frames and photographs come together; the moving part of a phone's photograph is no film."""
    source = tmp_path / "in"
    source.mkdir()
    for name in ("a.jpg", "live.jpg"):
        Image.fromarray(pictures[0]).save(source / name)
    for name in ("walk.MP4", "live.mp4"):
        (source / name).write_bytes(film.read_bytes())
    with pytest.warns(Assumption, match="live.mp4 is the moving part of the photograph live.jpg"):
        gathered = gather_photographs(source, tmp_path / "out", PoseOptions(frames=6))
    assert gathered.folder == tmp_path / "out/images" and {"a.jpg", "live.jpg"} < set(gathered.names)
    frames = [name for name in gathered.names if name.startswith("walk/frame-")]
    assert len(frames) == 6 and len(gathered.names) == 8
    assert Image.open(gathered.folder / frames[0]).size == (WIDTH, HEIGHT)


def _save_photographs(folder: Path, pictures, seconds) -> Path:
    """Save pictures as photographs that were taken at these times."""
    folder.mkdir()
    for index, (picture, time) in enumerate(zip(pictures, seconds)):
        exif = Image.Exif()
        whole, thousandths = divmod(round(1000 * time), 1000)
        exif.get_ifd(0x8769)[0x9003] = f"2026:07:01 12:{whole // 60:02d}:{whole % 60:02d}"
        exif.get_ifd(0x8769)[0x9291] = f"{thousandths:03d}"
        Image.fromarray(picture).save(folder / f"IMG_{index:02d}.jpg", quality=95, exif=exif)
    return folder


def test_blurred_photographs_are_left_out(pictures, tmp_path):
    folder = _save_photographs(tmp_path / "in", pictures[::2], range(0, 64, 4))
    with pytest.warns(Assumption, match=r"1 of 16 photographs is blurred and left out: IMG_12.jpg \(keep_blurred=T"):
        gathered = gather_photographs(folder, tmp_path / "out")
    assert gathered.folder == folder and len(gathered.names) == 15
    assert len(gather_photographs(folder, tmp_path / "out", PoseOptions(keep_blurred=True)).names) == 16


def test_a_burst_is_a_film(pictures, tmp_path):
    pytest.importorskip("cv2")
    folder = _save_photographs(tmp_path / "in", pictures, [*np.arange(26) / 10, *range(10, 70, 10)])
    with pytest.warns(Assumption, match="of 26 photographs of the burst IMG_00.jpg to IMG_25.jpg are taken, the shar"):
        names = gather_photographs(folder, tmp_path / "out").names
    assert names[-6:] == [f"IMG_{index}.jpg" for index in range(26, 32)]
    assert not {f"IMG_{index:02d}.jpg" for index in BLURRED} & set(names)
    assert len({f"IMG_{index}.jpg" for index in STILL} & set(names)) <= 2


def test_a_burst_of_heic(pictures, tmp_path):
    """The times and the lens are in its Exif too, whatever was opened before."""
    pytest.importorskip("cv2")
    (tmp_path / "in").mkdir()
    for index, picture in enumerate(pictures[:10, :352]):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x9003: "2026:07:01 12:00:05", 0x9291: f"{100 * index:03d}", 0xA405: 26})
        data = heic(picture, exif=exif.tobytes().removeprefix(b"Exif\0\0"))
        (tmp_path / f"in/IMG_{index:02d}.HEIC").write_bytes(data)
    assert lens_key(tmp_path / "in/IMG_00.HEIC")[-1] == 26
    with pytest.warns(Assumption, match="of 10 photographs of the burst IMG_00.HEIC to IMG_09.HEIC are taken"):
        names = gather_photographs(tmp_path / "in", tmp_path / "out").names
    assert 3 <= len(names) < 10 and "IMG_03.HEIC" not in names and "IMG_09.HEIC" not in names


def test_films_name_the_packages_that_they_take(film, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(
        InputError, match=r"OpenCV, which cannot be imported .* pip install 'lightfield-gs\[sfm,video\]"
    ):
        gather_photographs(film, tmp_path / "out")
    assert not (tmp_path / "out/images").exists()
