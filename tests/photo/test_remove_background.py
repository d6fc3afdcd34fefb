"""Backgrounds removed by rembg, or by what stands in for it."""

import sys
import types

import numpy as np
from command_line import complaint

import lightfield_gs as lf
from lightfield_gs.io.images import write_image
from lightfield_gs.photo import depth_network


def busy_photo() -> np.ndarray:
    """A bright square before noise; alpha of the square."""
    photo = np.random.default_rng(0).integers(0, 120, (60, 80, 3), np.uint8)
    photo[20:40, 30:50] = 250
    write_image("busy.png", photo)
    return (photo.min(2) == 250).astype(np.float32)


def stand_in(remove) -> types.ModuleType:
    """A module like rembg, as far as it is used here."""
    module = types.ModuleType("rembg")
    module.sessions = []
    module.new_session = lambda name: module.sessions.append(name) or {"model": name}
    module.remove = remove
    return module


def test_background_is_removed_when_asked_for(folder, capsys, monkeypatch):
    alpha = busy_photo()

    def remove(data, session, only_mask):
        assert data.dtype == np.uint8 and data.shape == (60, 80, 3) and session == {"model": "u2net"} and only_mask
        return np.where(data.min(2) == 250, 255, 0).astype(np.uint8)

    monkeypatch.setitem(sys.modules, "rembg", module := stand_in(remove))
    assert np.array_equal(lf.load_photo("busy.png", remove_background=True)[..., 3], alpha)
    lf.load_photo("busy.png", remove_background=True)
    assert module.sessions == ["u2net"]  # one for all photos
    monkeypatch.setattr(depth_network, "is_installed", lambda: False)  # which would show the whole scene
    assert "--remove-background" in complaint(capsys, "encode busy.png -o o.png --panel p.yaml")


def test_rembg_that_is_missing_or_fails(folder, capsys, monkeypatch):
    busy_photo()
    line = "encode busy.png --remove-background -o o.png --panel p.yaml"
    monkeypatch.setitem(sys.modules, "rembg", None)
    assert "pip install 'lightfield-gs[photo]'" in complaint(capsys, line)
    monkeypatch.setitem(sys.modules, "rembg", stand_in(lambda *_, **__: 1 / 0))
    assert "division by zero" in complaint(capsys, line)
    monkeypatch.setitem(sys.modules, "rembg", stand_in(lambda data, **_: np.zeros(data.shape[:2], np.uint8)))
    assert "rembg found no object" in complaint(capsys, line)
