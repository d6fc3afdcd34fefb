"""Structure from motion by pycolmap.

A stand-in checks its input and the use of its output. Where pycolmap is installed, it poses photographs that need
other settings than COLMAP's own.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_scene import HEIGHT, WIDTH, dots, said, write_capture
from command_line import run
from film_scene import arc, photographs, wall
from PIL import Image
from pycolmap_stand_in import Model, stand_in

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.pose_estimation.sfm import structure_from_motion


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_the_largest_model_is_kept_and_what_did_not_pose_is_said(tmp_path, monkeypatch):
    write_capture(tmp_path / "c", count=6)
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in({0: Model(2), 1: Model(4)}))
    told: list[str] = []
    model = structure_from_motion(tmp_path / "c/images", tmp_path / "new", told.append)
    assert model == tmp_path / "new/sparse/0" and told[-1] == "posed 4 of 6 photographs, 1 points"
    assert "posed 4 photographs" in told
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["sparse"]
    capture, assumed = said(tmp_path / "new", images=tmp_path / "c/images")
    assert len(capture.names) == 4
    assert assumed.count("004.png") == 1 and "2 photographs are not in the model" in assumed


def test_masks_of_any_name_are_found_below_the_photographs(tmp_path, monkeypatch, capsys):
    """The folder of masks is looked for where the photographs are, and what lies in it is not posed."""
    write_capture(tmp_path / "c", count=4)
    for index in range(4):
        (tmp_path / "c/images/cut").mkdir(exist_ok=True)
        Image.fromarray(np.full((HEIGHT, WIDTH), 255, np.uint8)).save(tmp_path / f"c/images/cut/{index:03d}.png")
    monkeypatch.setitem(sys.modules, "pycolmap", pycolmap := stand_in({0: Model(4)}))
    command = f"fit {tmp_path / 'c/images'} -o {tmp_path / 's.ply'} --sfm --mask-folder cut --steps 1 --gaussians 3"
    assumed = run(capsys, command)
    assert pycolmap.given.groups == [["000.png", "001.png", "002.png", "003.png"]]
    assert "what is white in the masks of" in assumed and "not in the model" not in assumed


def test_tries_go_on_until_nearly_all_pose_and_the_best_is_kept(tmp_path, monkeypatch):
    write_capture(tmp_path / "c", count=6)
    monkeypatch.setitem(sys.modules, "pycolmap", pycolmap := stand_in({0: Model(2)}, {}, {0: Model(6)}))
    told: list[str] = []
    with pytest.warns(
        Assumption, match="directions hardly differ: poses are from .* 4 degrees .* 0.75 x the longer side"
    ):
        structure_from_motion(tmp_path / "c/images", tmp_path / "new", told.append)
    tries = [line for line in told if line.startswith("poses, try")]
    assert tries[0] == "poses, try 1, by COLMAP's own settings: 2 of 6 photographs"
    assert "try 2, from photographs 4 degrees apart or more" in tries[1] and tries[1].endswith("none posed")
    assert tries[2].endswith("6 of 6 photographs") and len(tries) == 3
    assert pycolmap.given.focal_px == [1.0, 1.2 * WIDTH, 0.75 * WIDTH]
    assert len(read_capture(tmp_path / "new", images=tmp_path / "c/images").names) == 6


def test_a_focal_length_that_ran_away_is_not_the_last_word(tmp_path, monkeypatch):
    """COLMAP begins with 1.2 x the longer side, and photographs whose directions hardly differ do not hold it there."""
    write_capture(tmp_path / "c", count=6)
    away = {0: Model(6, 2.9 * WIDTH)}
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in(away, {0: Model(5)}, {}))
    told: list[str] = []
    structure_from_motion(tmp_path / "c/images", tmp_path / "new", told.append)
    assert told[-1].startswith("posed 5 of 6 photographs")
    assert any(line.endswith("6 of 6 photographs, a focal length of 278 px, 2.9 x the longer side") for line in told)
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in(away, {0: Model(2)}, {}))
    with pytest.warns(Assumption, match="COLMAP finds a focal length of 278 px, .* which the photographs hardly deter"):
        structure_from_motion(tmp_path / "c/images", tmp_path / "other")
    assert len(read_capture(tmp_path / "other", images=tmp_path / "c/images").names) == 6


def _photographs(folder: Path, focal_mm: dict[str, int | None]) -> Path:
    """Photographs of one size, with these focal lengths in Exif, of 35 mm film."""
    for name, length in focal_mm.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        exif = Image.Exif()
        if length is not None:
            exif.get_ifd(0x8769)[0xA405] = length
        exif[0x0112] = 6
        Image.fromarray(dots([(20, 20)])).save(path, exif=exif)
    return folder


def test_photographs_of_each_lens_have_a_camera(tmp_path, monkeypatch):
    """Phones have several lenses, whose photographs are of one size."""
    lengths = {"000.jpg": 26, "001.jpg": 47, "002.jpg": 26, "003.jpg": None, "004.jpg": 47}
    folder = _photographs(tmp_path / "c", lengths)
    monkeypatch.setitem(sys.modules, "pycolmap", pycolmap := stand_in({0: Model(5)}))
    with pytest.warns(
        Assumption, match=r"5 photographs are of 3 cameras, by size and Exif: 2 of 96 x 72 at 26 mm \(35 mm"
    ):
        structure_from_motion(folder, tmp_path / "new")
    assert pycolmap.given.groups == [["000.jpg", "002.jpg"], ["001.jpg", "004.jpg"], ["003.jpg"]]


def test_what_colmap_does_not_read_is_given_as_jpeg(tmp_path, monkeypatch):
    folder = _photographs(tmp_path / "c", {"a/000.webp": 26, "a/001.jpg": 26, "002.png": 26, "003.webp": 26})
    monkeypatch.setitem(sys.modules, "pycolmap", pycolmap := stand_in({0: Model(4)}))
    with pytest.warns(Assumption, match="COLMAP reads 2 of 4 photographs as JPEG files, for it knows no .webp"):
        structure_from_motion(folder, tmp_path / "new")
    assert pycolmap.given.start == {
        **dict.fromkeys(("a/000.webp", "a/001.jpg", "003.webp"), b"\xff\xd8\xff"),
        "002.png": b"\x89PN",
    }
    assert len(pycolmap.given.groups) == 1 and (folder / "003.webp").read_bytes()[:4] == b"RIFF"


def test_masks_and_hidden_files_are_not_posed(tmp_path, monkeypatch):
    names = [f"images/00{index}.jpg" for index in range(3)]
    folder = _photographs(tmp_path / "c", dict.fromkeys((*names, "masks/000.png", "images/001_mask.png"), None))
    (folder / "images/._000.jpg").write_bytes(b"\0\5\x16\7")
    monkeypatch.setitem(sys.modules, "pycolmap", pycolmap := stand_in({0: Model(3)}))
    with pytest.warns(Assumption, match="2 of 5 pictures are masks by their names or folder: not posed"):
        structure_from_motion(folder, tmp_path / "new")
    assert pycolmap.given.groups == [names]


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_what_does_not_pose_leaves_nothing(tmp_path, monkeypatch):
    write_capture(tmp_path / "c", count=3)
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in({}))
    with pytest.raises(InputError, match="the 3 photographs did not pose in 4 tries: expected sharp ones"):
        structure_from_motion(tmp_path / "c/images", tmp_path / "new")
    assert not list((tmp_path / "new").iterdir())
    with pytest.raises(InputError, match="there is a model already"):
        structure_from_motion(tmp_path / "c/images", tmp_path / "c")
    (tmp_path / "c/images/002.png").unlink()
    with pytest.raises(InputError, match="expected 3 photographs or more, got 2"):
        structure_from_motion(tmp_path / "c/images", tmp_path / "new")


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
@pytest.mark.parametrize(
    "has_cuda, gpu, device, used",
    [
        (True, True, "auto", "cuda"),
        (True, True, "cpu", "cpu"),
        (True, False, "auto", "cpu"),
        (False, True, "auto", "cpu"),
    ],
)
def test_matching_is_on_the_gpu_where_there_is_one(tmp_path, monkeypatch, has_cuda, gpu, device, used):
    """And pycolmap is built for it."""
    write_capture(tmp_path / "c", count=3)
    monkeypatch.setitem(sys.modules, "pycolmap", pycolmap := stand_in({0: Model(3)}, has_cuda=has_cuda))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    told: list[str] = []
    structure_from_motion(tmp_path / "c/images", tmp_path / "new", told.append, device=device)
    assert pycolmap.given.devices == {used} and ("features of 3 photographs on the GPU" in told) == (used == "cuda")


def test_without_pycolmap(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install lightfield-gs\[sfm\]"):
        structure_from_motion(tmp_path, tmp_path / "new")


@pytest.mark.slow
@pytest.mark.not_sanitized
@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_photographs_whose_directions_hardly_differ_pose(tmp_path):
    """Six within 3 degrees, without Exif: COLMAP's own settings begin with photographs 16 degrees apart."""
    pytest.importorskip("pycolmap")
    images = photographs(wall(), arc(np.linspace(-1.5, 1.5, 6)))
    (tmp_path / "c").mkdir()
    for index, image in enumerate(images):
        Image.fromarray(image).save(tmp_path / f"c/{index}.png")
    told: list[str] = []
    structure_from_motion(tmp_path / "c", tmp_path / "new", told.append)
    assert int(told[-1].split()[1]) >= 5, told  # COLMAP's threads draw random numbers in another order each time
    directions = read_capture(tmp_path / "new", images=tmp_path / "c").world_to_camera[:, 2, :3]
    assert np.degrees(np.arccos((directions[0] @ directions[-1]).clip(-1, 1))) == pytest.approx(3, abs=1.5)
