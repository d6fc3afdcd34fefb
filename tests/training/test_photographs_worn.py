"""Skins of random objects made of photographs, relief, and the sets made of such objects."""

import types

import numpy as np
import pytest
import torch
from PIL import Image

from lightfield_gs import InputError
from training.data import gather_photographs, make_objects
from training.data.images import read_view
from training.data.objects import find_objects, read_object
from training.data.relief import RELIEF, raised
from training.data.textures import PIECE_PX, SKIN, read_photographs, worn


def _row(layout: dict[str, int], **values: list[float]) -> torch.Tensor:
    """[1,1,F]"""
    return torch.tensor([sum((list(values[name]) for name in layout), [])], dtype=torch.float32)[None]


def _noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).integers(256, size=(*shape, 3), dtype=np.uint8)


def test_a_skin_shows_the_photograph_where_it_lies_and_mirrored_beyond():
    """A piece whose red rises to the right and whose green rises downwards tells which place of it is shown."""
    ramp = torch.arange(PIECE_PX, dtype=torch.uint8)
    piece = torch.stack(torch.broadcast_tensors(ramp, ramp[:, None], torch.full_like(ramp, 51)), -1)
    pieces = torch.stack([torch.zeros_like(piece), piece])
    plain = {"piece": [1], "density": [2], "cosine": [0.6], "sine": [0.8], "place": [0.25, 0.5], "tint": [0]}
    skin = _row(SKIN, **plain, order=[0, 1, 2], gamma=[1], weight=[1])
    local = torch.rand(1, 200, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    facing = torch.tensor([0.1, -0.2, -0.9]).expand(1, 200, 3)  # so that x and y run along the surface
    grey = torch.full((1, 200, 3), 0.5)
    found = worn(skin.expand(1, 200, -1), pieces, local, facing, grey, grey)[0]
    x, y = local[0, :, 0], local[0, :, 1]
    for place, shown in ((2 * (0.6 * x - 0.8 * y) + 0.25, found[:, 0]), (2 * (0.8 * x + 0.6 * y) + 0.5, found[:, 1])):
        mirrored = np.abs((place.numpy() + 1) % 2 - 1)
        expected = (mirrored * PIECE_PX - 0.5).clip(0, PIECE_PX - 1) / 255
        np.testing.assert_allclose(shown, expected, atol=1e-3)
    np.testing.assert_allclose(found[:, 2], 0.2, atol=1e-6)
    turned = _row(SKIN, **plain, order=[1, 0, 2], gamma=[2], weight=[1])
    changed = worn(turned.expand(1, 200, -1), pieces, local, facing, grey, grey)[0]
    torch.testing.assert_close(changed, found[:, [1, 0, 2]].square(), atol=1e-5, rtol=0)
    tinted = _row(SKIN, **plain | {"tint": [1]}, order=[0, 1, 2], gamma=[1], weight=[1])
    colours = worn(tinted.expand(1, 200, -1), pieces, local, facing, grey * torch.tensor([1.0, 0.5, 0]), grey * 0)[0]
    assert not colours[:, 2].any() and (colours[:, 0] >= colours[:, 1]).all()


def test_relief_moves_points_along_the_normal_and_tilts_their_cells():
    """On a plane, where the bending of the normal is no matter: against differences of the moved points."""
    waves = [11.0, -4.0, 3.0, 2.0, 15.0, 1.0, -6.0, 7.0, 2.0]
    relief = _row(RELIEF, height=[0.02], waves=waves, phases=[0.1, 1.2, 2.3]).double()
    x, y = torch.rand(2, 1, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    point = torch.stack([x, y, torch.full_like(x, 0.3)], -1)
    along, across = (torch.tensor(side, dtype=torch.float64).expand(1, 50, 3) for side in ((0, 2.0, 0), (3.0, 0, 0)))
    moved, tilted_along, tilted_across = raised(relief, point, along, across)
    torch.testing.assert_close(moved[..., :2], point[..., :2])
    assert 0.01 < (moved - point)[..., 2].abs().max() < 3 * 1.4 * 0.02
    for side, tilted in ((along, tilted_along), (across, tilted_across)):
        ahead, back = (raised(relief, point + sign * 1e-5 * side, along, across)[0] for sign in (1, -1))
        torch.testing.assert_close((ahead - back) / 2e-5, tilted, atol=1e-6, rtol=0)


def test_photographs_are_cut_into_pieces(tmp_path):
    Image.fromarray(_noise(2 * PIECE_PX, 3 * PIECE_PX)).save(tmp_path / "six.png")
    Image.fromarray(_noise(PIECE_PX + 9, PIECE_PX + 3)[..., 0]).save(tmp_path / "grey.png")
    Image.fromarray(np.full((PIECE_PX, PIECE_PX, 3), 200, np.uint8)).save(tmp_path / "plain.png")
    Image.fromarray(np.concatenate([_noise(PIECE_PX, PIECE_PX), _noise(PIECE_PX, PIECE_PX)[..., :1]], -1)).save(
        tmp_path / "clear.png"
    )
    Image.fromarray(_noise(PIECE_PX - 1, 600)).save(tmp_path / "low.png")
    found = read_photographs(tmp_path)
    assert len(found) == 7 and sorted(found.grey.tolist()) == [False] * 6 + [True]
    pieces = found.on(torch.device("cpu"))
    assert pieces.shape == (7, PIECE_PX, PIECE_PX, 3)
    np.testing.assert_array_equal(pieces[-1], _noise(2 * PIECE_PX, 3 * PIECE_PX)[PIECE_PX:, 2 * PIECE_PX :])
    (tmp_path / "none").mkdir()
    for folder, words in (("none", "found 0 files of which none"), ("missing", "no such folder")):
        with pytest.raises(InputError, match=words):
            read_photographs(tmp_path / folder)


def test_a_set_of_clothed_objects_can_be_trained_on(tmp_path, monkeypatch, capsys):
    (tmp_path / "photographs").mkdir()
    Image.fromarray(_noise(PIECE_PX, PIECE_PX)).save(tmp_path / "photographs/noise.png")
    monkeypatch.setattr(make_objects, "SIZE_PX", 48)  # the drawing process is this one
    monkeypatch.setattr(make_objects, "FOCAL_PX", 48 * 262.5 / 256)
    monkeypatch.setattr(make_objects, "ProcessPoolExecutor", _Here)
    output = tmp_path / "set"
    arguments = ["--output", str(output), "--objects", "2", "--photographs", str(tmp_path / "photographs")]
    assert make_objects.main([*arguments, "--device", "cpu"]) == 0
    assert "2 objects" in capsys.readouterr().out
    for path in find_objects(output):
        views = read_object(path)
        assert len(views.image_paths) == 12 and views.width_px == 48
        np.testing.assert_allclose(np.linalg.norm(views.camera_to_world[:, :3, 3], axis=-1), 1.3, atol=1e-6)
        assert 0.01 < (read_view(views, 3)[..., 3] > 127).mean() < 0.9
    first, again = (make_objects.draw_numbered([number], 0, torch.device("cpu"))[0] for number in (0, 0))
    np.testing.assert_array_equal(first, again)
    assert make_objects.main([*arguments, "--device", "cpu"]) == 2


class _Here:
    """Stands for a pool of processes."""

    def __init__(self, *_, initializer, initargs):
        initializer(*initargs)

    def __enter__(self):
        return types.SimpleNamespace(map=map)

    def __exit__(self, *_):
        return None


def test_photographs_are_gathered_with_their_licences(tmp_path, monkeypatch, capsys):
    (tmp_path / "skimage/data").mkdir(parents=True)
    spec = types.SimpleNamespace(origin=str(tmp_path / "skimage/__init__.py"))
    monkeypatch.setattr(gather_photographs.importlib.util, "find_spec", lambda _: spec)
    arguments = ["--output", str(tmp_path / "photographs")]
    assert gather_photographs.main(arguments) == 2
    assert "expected astronaut.png" in capsys.readouterr().err and not (tmp_path / "photographs").exists()
    for name in gather_photographs._OF_SCIKIT_IMAGE:
        (tmp_path / "skimage/data" / name).write_bytes(b"picture")
    assert gather_photographs.main(arguments) == 0
    files = {path.name for path in (tmp_path / "photographs").iterdir()}
    lines = (tmp_path / "photographs/LICENCES.txt").read_text().splitlines()[1:]
    assert {line.split(" | ")[0] for line in lines} == files - {"LICENCES.txt"} and "banana-DSC_0423.jpg" in files
    monkeypatch.setattr(gather_photographs.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(InputError, match="pip install scikit-image"):
        gather_photographs.gather_photographs(tmp_path / "others")
