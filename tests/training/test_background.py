"""The object in pictures without alpha, by the background, which is found once for all views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from srn_scene import write_object

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.objects import ObjectImages
from training.data import validate
from training.data.images import find_cutout, read_view
from training.data.objects import read_object

SIDE = 96


def _disc(x: float, y: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    return np.hypot(columns - x, rows - y) < radius


def _views(folder: Path, pictures: list[np.ndarray], suffix: str = ".png") -> ObjectImages:
    """An object whose views are these pictures [S,S,3 or 4]."""
    write_object(folder, angles=[(4 * index, 0) for index in range(len(pictures))])
    for path in (folder / "rgb").iterdir():
        path.unlink()
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"rgb/{index:06d}{suffix}", quality=95)
    (folder / "intrinsics.txt").write_text(f"90 {SIDE / 2} {SIDE / 2} 0\n0 0 0\n1\n{SIDE} {SIDE}\n")
    return read_object(folder)


def _painted(background: object, *discs: tuple[np.ndarray, object]) -> np.ndarray:
    picture = np.empty((SIDE, SIDE, 3), np.uint8)
    picture[:] = background
    for where, colour in discs:
        picture[where] = np.broadcast_to(colour, picture.shape)[where]
    return picture


@pytest.mark.parametrize("colour", [(255, 255, 255), (0, 0, 0), (90, 120, 90)])
def test_nothing_is_eaten_from_bodies_of_nearly_the_backgrounds_colour(tmp_path, colour):
    """A pale ball that fades into the background, and a hole; a faint thin ring, as of resizing, is not object."""
    body, pale, hole = _disc(40, 55, 22), _disc(64, 40, 16), _disc(40, 55, 8)
    ring = _disc(40, 55, 26) & ~_disc(40, 55, 25)
    sign = -1 if max(colour) > 128 else 1
    fading = (np.array(colour) + sign * np.linspace(12, 1, SIDE).round()[:, None, None]).astype(np.uint8)
    picture = _painted(
        colour, (ring, np.array(colour) + sign * 3), (body, (200, 40, 60)), (hole, colour), (pale, fading)
    )
    views = _views(tmp_path / "a", [picture] * 3)
    alpha = read_view(views, 0)[..., 3]
    np.testing.assert_array_equal(alpha == 255, body & ~hole | pale)
    assert (alpha[~(body & ~hole | pale)] == 0).all()
    assert str(find_cutout(views)) == f"cut out by the background, exactly #{bytes(colour).hex()}"


def test_outlines_are_parted_into_object_and_background(tmp_path):
    """Of an antialiased render: its true opacity and colour, and over white the picture that it was."""
    rows, columns = (np.mgrid[: 8 * SIDE, : 8 * SIDE] + 0.5) / 8
    fine = np.hypot(columns - 50, rows - 45) < 30
    coverage = fine.reshape(SIDE, 8, SIDE, 8).mean((1, 3))
    colour = np.array([180.0, 40, 90])
    picture = (coverage[..., None] * colour + (1 - coverage[..., None]) * 255).round().astype(np.uint8)
    frame = read_view(_views(tmp_path / "a", [picture] * 2), 0).astype(int)
    assert np.abs(frame[..., 3] - 255 * coverage).max() < 3
    assert np.abs(frame[..., :3] - coverage[..., None] * colour).max() < 3
    assert np.abs(frame[..., :3] + 255 - frame[..., 3:] - picture).max() <= 1


def test_clipped_highlight_is_no_hole(tmp_path):
    """A part that fades to the background's colour is bright; a part with a sharp edge is open."""
    distance = np.hypot(*(np.mgrid[:SIDE, :SIDE] + 0.5 - 48))
    shaded = np.clip(270 - 3 * distance, 0, 255).astype(np.uint8)[..., None].repeat(3, 2)
    picture = _painted(255, (_disc(48, 48, 40), shaded))
    assert (picture[46:50, 46:50] == 255).all()
    alpha = read_view(_views(tmp_path / "a", [picture] * 2), 0)[..., 3]
    np.testing.assert_array_equal(alpha == 255, _disc(48, 48, 40))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_close_ups_are_cut_out_by_the_background_of_all_views(tmp_path, suffix):
    """The object reaches all four sides; one view shows nothing else."""
    close = _disc(48, 48, 50)
    pictures = [_painted(255, (close, (40, 60, 200)))] * 3 + [_painted((40, 60, 200))]
    views = _views(tmp_path / "a", pictures, suffix)
    alpha = read_view(views, 0)[..., 3]
    np.testing.assert_array_equal(alpha[0, [0, -1]], 0)
    assert ((alpha > 127) != close).mean() < 0.01
    assert (read_view(views, 3)[..., 3] == 255).all()


def test_pale_parts_that_a_lossy_format_hides_are_noted(tmp_path, capsys):
    """Between noise and a body of nearly the background's colour nothing decides: a person is told."""
    pictures = [_painted(255, (_disc(40, 50, 24), (200, 40, 60)), (_disc(64, 40, 16), value)) for value in (90, 240)]
    for name, picture in zip(("dark", "pale"), pictures):
        _views(tmp_path / "set" / name, [picture] * 2, ".jpg")
    assert validate.main([str(tmp_path / "set")]) == 0
    (note,) = capsys.readouterr().err.splitlines()
    assert note.startswith("note: pale: up to ") and "is lost to the background" in note and "2 of 2 views" in note


def test_the_background_may_be_said(tmp_path):
    picture = _painted(255, (_disc(48, 48, 60), (200, 40, 60)))  # corners alone show it, and one has something else
    picture[:24, :24], picture[-24:, -24:] = (0, 200, 0), (0, 0, 200)
    views = _views(tmp_path / "a", [picture] * 2)
    assert str(find_cutout(views)) == "whole pictures are the subject"
    white = find_cutout(views, "white")
    assert read_view(views, 0, white)[0, -1, 3] == 0 and read_view(views, 0, white)[0, 0, 3] == 255
    assert find_cutout(views, "none").by == "nothing"
    with pytest.raises(InputError, match="expected a black background"):
        find_cutout(views, "black")


def test_rooms_have_no_background_though_some_views_show_a_wall(tmp_path):
    rng = np.random.default_rng(0)
    wall = _painted(rng.integers(96, 100, (SIDE, SIDE, 3)), (_disc(40, 40, 9), (200, 40, 60)))
    room = [rng.integers(0, 255, (SIDE, SIDE, 3), np.uint8) for _ in range(2)]
    views = _views(tmp_path / "a", [wall, wall, *room])
    assert all((read_view(views, index)[..., 3] == 255).all() for index in range(4))
    assert str(find_cutout(_views(tmp_path / "b", [wall] * 4))).startswith("cut out by the background, about #6")


def test_view_of_nothing_but_background_is_named(tmp_path):
    views = _views(tmp_path / "a", [_painted(255, (_disc(48, 48, 20), (9, 9, 9))), _painted(255)])
    with pytest.raises(InputError, match="000001.png: empty image: .* of the background, exactly #ffffff"):
        read_view(views, 1)


def test_transparency_of_one_view_speaks_for_all(tmp_path):
    """A close-up without a transparent pixel among views with alpha is object as a whole."""
    clear = np.dstack([_painted(255, (_disc(48, 48, 20), (9, 9, 9))), 255 * _disc(48, 48, 20).astype(np.uint8)])
    full = np.dstack([_painted(255, (_disc(48, 48, 40), (9, 9, 9))), np.full((SIDE, SIDE), 255, np.uint8)])
    views = _views(tmp_path / "a", [full, clear])
    assert find_cutout(views).by == "alpha" and (read_view(views, 0)[..., 3] == 255).all()
