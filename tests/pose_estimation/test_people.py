"""People who walk by are masked: by rembg, or by a module that stands in for it."""

import sys
import types
from pathlib import Path

import numpy as np
import pytest
from capture_scene import HEIGHT, WIDTH, said, write_capture
from command_line import complaint, run
from PIL import Image
from pycolmap_stand_in import Model, stand_in

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.pose_estimation.people import write_people_masks

PERSON = (slice(30, 60), slice(50, 62))  # rows and columns, upright


@pytest.fixture
def rembg(monkeypatch) -> types.ModuleType:
    """Takes what is pure red as people."""
    module = types.ModuleType("rembg")
    module.new_session = lambda name: {"model": name}
    module.remove = lambda data, session, only_mask: np.where((data == (255, 0, 0)).all(2), 255, 0).astype(np.uint8)
    monkeypatch.setitem(sys.modules, "rembg", module)
    return module


def _photograph(path: Path, person: bool, turned: bool = False) -> Path:
    """A photograph of somebody in red, or of nobody; turned: stored on its side, with the Exif that says so."""
    picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    if person:
        picture[PERSON] = 255, 0, 0
    exif = Image.Exif()
    exif[0x0112] = 6 if turned else 1  # to be turned clockwise by a quarter
    Image.fromarray(np.rot90(picture) if turned else picture).save(path, exif=exif)
    return path


def test_masks_are_black_on_people_and_lie_as_the_photographs_are_stored(rembg, tmp_path):
    kinds = {"a.png": (True, False), "b.png": (True, True), "c.png": (False, False)}
    names = {name: _photograph(tmp_path / name, *kind) for name, kind in kinds.items()}
    with pytest.warns(Assumption, match="2 of 3 photographs show people, who do not count: 5% of their pixels"):
        assert write_people_masks(names, tmp_path / "masks", lambda words: None)
    a, b, c = (np.asarray(Image.open(tmp_path / f"masks/{name}.png")) for name in names)
    assert (c == 255).all() and (np.rot90(a) == b).all()
    rows, columns = np.nonzero(a == 0)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (30, 59, 50, 61)  # widened by 0.96 pixels: none


def test_nobody_leaves_no_masks(rembg, tmp_path):
    with pytest.warns(Assumption, match="there are no people in the photographs"):
        assert not write_people_masks(
            {"c.png": _photograph(tmp_path / "c.png", False)}, tmp_path / "m", lambda words: 0
        )
    assert not (tmp_path / "m").exists()


def test_people_are_neither_matched_nor_fitted(rembg, tmp_path, capsys, monkeypatch):
    write_capture(tmp_path / "c", count=3)
    for index in range(3):
        _photograph(tmp_path / f"c/images/{index:03d}.png", True)
    monkeypatch.setitem(sys.modules, "pycolmap", pycolmap := stand_in({0: Model(3)}))
    command = f"fit {tmp_path / 'c/images'} -o {tmp_path / 's.ply'} --sfm --steps 1 --gaussians 3"
    out = run(capsys, f"{command} --mask-people")
    masks = tmp_path / "s.fit/sfm/masks"
    assert "3 of 3 photographs show people" in out and pycolmap.given.masks == {str(masks)}
    capture, _ = said(tmp_path / "s.fit/sfm", images=tmp_path / "c/images")
    assert (capture.mask(0)[PERSON] == 0).all() and capture.mask(0)[:20].min() == 255
    again = run(capsys, f"{command} --mask-people")  # goes on with the masks that are there
    assert f"the masks of {masks} counts" in again


def test_people_beside_other_masks_and_without_rembg_are_refused(rembg, tmp_path, capsys, monkeypatch):
    write_capture(tmp_path / "c", count=3)
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in({0: Model(3)}))
    command = f"fit {tmp_path / 'c/images'} -o {tmp_path / 's.ply'} --sfm --mask-people --steps 1 --gaussians 3"
    assert "--mask-people takes no --masks alpha" in complaint(capsys, f"{command} --masks alpha")
    assert "--mask-people takes --sfm" in complaint(capsys, command.replace("--sfm ", ""))
    assert "--mask-people makes the masks" in complaint(capsys, f"{command} --mask-folder masks")
    monkeypatch.setitem(sys.modules, "rembg", None)
    assert "rembg, which finds people, " in (words := _refused(capsys, command))
    assert "pip install 'lightfield-gs[photo]'; or paint masks" in words
    assert not (tmp_path / "s.fit/sfm/masks").exists()


def _refused(capsys, command: str) -> str:
    from lightfield_gs import cli

    assert cli.main(command.split()) == 2
    return capsys.readouterr().err
