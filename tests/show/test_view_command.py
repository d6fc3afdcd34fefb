"""The command `view`: its folder of pictures, and the command line that it gives for what it shows."""

import io
import json
import shlex
from urllib.parse import urlencode

import numpy as np
import pytest
from command_line import PANEL, complaint, scene
from PIL import Image
from test_page import get, serving

from lightfield_gs import cli
from lightfield_gs.commands import view as command
from lightfield_gs.io.scenes.files import write_scene


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder: a panel, and an album of scenes and a photo with its depths."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    PANEL.to_yaml("p.yaml")
    (tmp_path / "album").mkdir()
    write_scene(scene(), "album/a scene.ply")
    photo = np.random.default_rng(0).integers(0, 256, (8, 12, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    Image.fromarray(photo).save("album/photo.png")
    np.save("album/photo_depth.npy", np.linspace(1, 2, 96, dtype=np.float32)[None].repeat(64, 0))
    return tmp_path


def view(monkeypatch, words: list[str], look) -> None:
    """Run `view`, and call look(server) where it would wait for Ctrl-C."""

    def serve(_, routes, *start):
        with serving(routes) as server:
            look(server)

    monkeypatch.setattr(command, "serve", serve)
    assert cli.main(["view", *words, "--panel", "p.yaml", "--device", "cpu"]) == 0


def ask(server, address: str, **values) -> bytes:
    status, body, _ = get(server, f"/{address}?{urlencode(values)}")
    assert status == 200, body
    return body


def picture(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


@pytest.mark.parametrize(
    "options, controls",
    [
        ("", {}),
        ("--zoom 1.3 --pan 0.1,0 --background #204060", {"zoom": 1.2, "pan_x": -0.05, "pan_y": 0.02}),
        ("--cone 20 --depth-amount 0.5 --turn 15", {"depth_amount": 1.4, "background": "#ff8000"}),
        ("--focus 3.6 --antialiased", {"focus": 3.9, "cone_deg": 25, "quality": "high"}),
        ("--zoom 1.1 --tilt 5", {"yaw_deg": 20, "pitch_deg": -10, "zoom": 1.5}),
    ],
    ids=["opened", "zoom", "depth", "focus", "turned"],
)
def test_the_command_of_the_page_makes_its_picture(folder, monkeypatch, options, controls):
    def look(server):
        words = shlex.split(json.loads(ask(server, "command.json", **controls))["words"])
        assert words[:5] == ["lightfield-gs", "encode", "album/a scene.ply", "-o", "a scene-3d.png"]
        if "yaw_deg" in controls:
            (folder / "a scene.rig.yaml").write_bytes(ask(server, "export/rig.yaml", **controls))
        assert cli.main(words[1:]) == 0
        shown = picture(ask(server, "export/native.png", **controls))
        made = picture((folder / "a scene-3d.png").read_bytes())
        assert np.abs(made - shown).max() <= 1 and np.ptp(made) > 100  # numbers of the line have six digits

    view(monkeypatch, ["album/a scene.ply", *options.split()], look)


def test_a_folder_opens_its_pictures_one_by_one(folder, monkeypatch, capsys):
    (folder / "album" / "broken.ply").write_bytes(b"ply\nno")

    def look(server):
        strip = json.loads(ask(server, "gallery.json"))
        assert [item["name"] for item in strip["items"]] == ["a scene.ply", "broken.ply", "photo.png"]
        token = json.loads(ask(server, "scene.json"))["token"]
        assert get(server, "/open", "POST", "item=1", X_Token=token)[0] == 400
        assert get(server, "/open", "POST", "item=2", X_Token=token)[0] == 200
        assert json.loads(ask(server, "scene.json"))["name"] == "photo.png"
        line = json.loads(ask(server, "command.json"))["words"]
        assert "album/photo.png" in line and "--depth=album/photo_depth.npy" in line

    view(monkeypatch, ["album"], look)
    assert "broken.ply" in capsys.readouterr().err


def test_a_folder_without_pictures_is_refused(folder, capsys):
    (folder / "empty").mkdir()
    assert "a folder without photos and scenes" in complaint(capsys, "view empty --panel p.yaml")
