"""Structure from motion by pycolmap, as far as it can be told without it: it is no dependency of the tests."""

import sys
from types import SimpleNamespace

import pytest
from capture_scene import CENTRE, HEIGHT, WIDTH, ring, write_capture, write_model

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.captures.sfm import structure_from_motion


class _Model:
    """A reconstruction in which the first `count` photographs are posed."""

    def __init__(self, count: int):
        self.names = [f"{index:03d}.png" for index in range(count)]
        self.images = {index: SimpleNamespace(name=name) for index, name in enumerate(self.names)}
        self.points3D = {1: None}

    def num_reg_images(self) -> int:
        return len(self.names)

    def write(self, folder: str) -> None:
        from pathlib import Path

        images = [(name, 1, *pose) for name, pose in zip(self.names, ring(len(self.names)))]
        camera = (1, "SIMPLE_RADIAL", WIDTH, HEIGHT, [70.0, *CENTRE, 0.0])
        write_model(Path(folder), "bin", [camera], images, [((0, 0, 0), (1, 2, 3))])


def _stand_in(found: dict[int, _Model]) -> SimpleNamespace:
    """What is used of pycolmap, which finds these models."""

    def mapping(database, photographs, models, initial_image_pair_callback, next_image_callback):
        for model in found.values():
            initial_image_pair_callback()
            for _ in model.names[2:]:
                next_image_callback()
        return found

    return SimpleNamespace(
        CameraMode=SimpleNamespace(SINGLE="single", PER_IMAGE="each"),
        Device=SimpleNamespace(cpu="cpu"),
        logging=SimpleNamespace(minloglevel=0),
        set_random_seed=lambda seed: None,
        extract_features=lambda database, photographs, names, camera_mode, device: None,
        match_exhaustive=lambda database, device: None,
        incremental_mapping=mapping,
    )


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_the_largest_model_is_kept_and_what_did_not_pose_is_said(tmp_path, monkeypatch):
    write_capture(tmp_path / "c", count=6)
    monkeypatch.setitem(sys.modules, "pycolmap", _stand_in({0: _Model(2), 1: _Model(4)}))
    told: list[str] = []
    with pytest.warns(Assumption, match="2 of 6 photographs did not pose and are left out: 004.png, 005.png"):
        model = structure_from_motion(tmp_path / "c/images", tmp_path / "new", told.append)
    assert model == tmp_path / "new/sparse/0" and told[-2:] == [
        "posed 4 photographs",
        "posed 4 of 6 photographs, 1 points",
    ]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["sparse"]
    assert len(read_capture(tmp_path / "new", images=tmp_path / "c/images").names) == 4


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
def test_what_does_not_pose_leaves_nothing(tmp_path, monkeypatch):
    write_capture(tmp_path / "c", count=3)
    monkeypatch.setitem(sys.modules, "pycolmap", _stand_in({}))
    with pytest.raises(InputError, match="the 3 photographs did not pose: expected sharp ones"):
        structure_from_motion(tmp_path / "c/images", tmp_path / "new")
    assert not list((tmp_path / "new").iterdir())
    with pytest.raises(InputError, match="there is a model already"):
        structure_from_motion(tmp_path / "c/images", tmp_path / "c")
    (tmp_path / "c/images/002.png").unlink()
    with pytest.raises(InputError, match="expected 3 photographs or more, got 2"):
        structure_from_motion(tmp_path / "c/images", tmp_path / "new")


def test_without_pycolmap(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install lightfield-gs\[sfm\]"):
        structure_from_motion(tmp_path, tmp_path / "new")
