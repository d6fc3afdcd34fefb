"""`view` of numbered scenes: each picture is of its scene by one rig, and the page plays them."""

import json
import shlex

import numpy as np
import pytest
from command_line import PANEL, complaint
from scene_film_maker import dance, write_dance
from test_page import serving
from test_page_in_browser import REST, browser
from test_view_command import ask, picture, view

from lightfield_gs import Gaussians, cli, encode
from lightfield_gs.io.images import write_image
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.exports import exports
from lightfield_gs.show.page.stage import Controls, Film, Stage, StagedScene
from lightfield_gs.show.page.steering import steering_routes


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    PANEL.to_yaml("p.yaml")
    write_dance(tmp_path / "dance")
    return tmp_path


def test_each_picture_is_of_its_scene_and_all_have_one_rig(desk, monkeypatch, capsys):
    def look(server):
        facts = json.loads(ask(server, "scene.json"))
        assert facts["film"] == {"count": 5, "fps": 24} and facts["name"] == "dance"
        assert json.loads(ask(server, "gallery.json"))["items"] == [{"name": "dance", "is_scene": True}]
        assert json.loads(ask(server, "drawing.json")) is None  # the program draws
        (desk / "rig.yaml").write_bytes(ask(server, "export/rig.yaml"))
        rig = Rig.from_yaml("rig.yaml", PANEL)
        for frame in (0, 3, 4, 9):
            own = Gaussians.load(f"dance/frame_{8 + min(frame, 4)}.ply")
            shown = picture(ask(server, "export/native.png", frame=frame))
            assert np.abs(shown - encode(own, PANEL, rig).numpy()).max() <= 1
        words = shlex.split(json.loads(ask(server, "command.json", frame=3))["words"])
        assert words[:5] == ["lightfield-gs", "encode", "dance/frame_11.ply", "-o", "frame_11-3d.png"]
        (desk / "dance.rig.yaml").write_bytes(ask(server, "export/rig.yaml", frame=3))
        assert cli.main(words[1:]) == 0
        made = picture((desk / "frame_11-3d.png").read_bytes())
        assert np.abs(made - picture(ask(server, "export/native.png", frame=3))).max() <= 1

    view(monkeypatch, ["dance", "--fps", "24"], look)
    assert "scenes: 5 in a row" in capsys.readouterr().out


def test_frames_a_second_are_of_numbered_scenes(desk, capsys):
    assert "--fps is of numbered scenes" in complaint(capsys, "view dance/frame_8.ply --panel p.yaml --fps 24")


@pytest.mark.not_sanitized  # a sanitizer that is loaded before a browser stops it
def test_the_page_plays_scenes_and_goes_to_one(tmp_path):
    scenes = [dance(number) for number in range(5)]
    film = Film(5, 20, scenes.__getitem__)
    stage = Stage(StagedScene(scenes[0], Rig.frame(scenes[2], PANEL), "dance", film=film), PANEL)
    frame = "Number(document.querySelector('#frame').value)"
    with serving(steering_routes(stage, exports(stage))) as server, browser(tmp_path) as page:
        page.open(server.url)
        page.wait(REST)
        place = "document.querySelector('#frame-place').textContent"
        assert page.run(place) == "1 of 5" and not page.run("document.querySelector('#film').hidden")
        page.run("seen = new Set(); setInterval(() => seen.add(document.querySelector('#frame').value), 5)")
        page.run("document.querySelector('#play').click()")
        page.wait("seen.size === 5")
        assert page.run("document.querySelector('#play').textContent") == "Stop"
        page.run("document.querySelector('#play').click()")
        page.wait(REST)
        assert stage.resting().frame == page.run(frame)
        page.run("(f => { f.value = 3; f.dispatchEvent(new Event('input')); })(document.querySelector('#frame'))")
        page.wait(f"{REST} && {frame} === 3")
        assert page.run(place) == "4 of 5" and stage.resting().frame == 3
        assert np.array_equal(stage.settled()[1], stage.native(Controls.of({"frame": "3"}))[0])
        assert page.run("document.querySelector('#undo').disabled")  # a place in the film is no step
        for size in ((1000, 700), (390, 844)):
            page.resize(*size)
            write_image(tmp_path / f"film-{size[0]}.png", page.screenshot())
            assert page.run("document.documentElement.scrollWidth") <= size[0]
