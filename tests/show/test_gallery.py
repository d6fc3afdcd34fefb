"""The strip of the page of `view`, files that are dropped on it and looks that are kept, without a browser."""

import io
import json
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from command_line import PANEL, scene
from PIL import Image
from test_page import get, serving

from lightfield_gs.app.openable import OPENED_SUFFIXES, depth_map_beside, photos_and_scenes
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.scenes.files import is_scene_path
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.gallery import Gallery
from lightfield_gs.show.page.looks import LookStore
from lightfield_gs.show.page.stage import Stage, StagedScene
from lightfield_gs.show.page.steering import steering_routes


def read(path: Path, is_dropped: bool) -> StagedScene:
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty; give another: --depth FILE")
    gaussians = scene(seed=path.stat().st_size)
    return StagedScene(gaussians, Rig.frame(gaussians, PANEL), f"{path.name}, dropped: {is_dropped}")


@contextmanager
def strip(folder: Path, *names: str):
    """A server of the page, a function that posts to it with its token, its stage and the folder of dropped files."""
    dropped = folder / "dropped"
    dropped.mkdir()
    for name in names:
        (folder / name).write_bytes(name.encode())
    gaussians = scene()
    stage = Stage(StagedScene(gaussians, Rig.frame(gaussians, PANEL)), PANEL)
    paths = [folder / name for name in names]
    gallery = Gallery(paths, 0, read, photos_and_scenes, is_scene_path, OPENED_SUFFIXES, dropped)
    with serving(steering_routes(stage, {}, gallery, LookStore(folder / "looks" / "looks.json"))) as server:
        token = json.loads(get(server, "/scene.json")[1])["token"]

        def post(address: str, body: str | bytes = "") -> tuple[int, bytes]:
            return get(server, address, "POST", body, X_Token=token)[:2]

        yield server, post, stage, dropped


def test_another_picture_opens_and_questions_about_the_old_one_are_refused(tmp_path):
    with strip(tmp_path, "a.ply", "bb.ply") as (server, post, stage, _):
        version = stage.version
        assert get(server, "/frame?show=eye&width=64&scene=0")[0] == 200
        assert json.loads(post("/open", "item=1")[1])["shown"] == 1
        assert stage.name == "bb.ply, dropped: False" and stage.version > version  # the panel's page follows
        assert get(server, "/frame?show=eye&width=64&scene=0")[0] == 410
        assert post("/rest", "scene=0&zoom=2")[0] == 410 and stage.resting().zoom == 1
        assert get(server, "/drawing.bin?scene=0")[0] == 410
        assert get(server, f"/frame?show=eye&width=64&scene={stage.number}")[0] == 200
        assert post("/open", "item=2")[0] == 400
        assert get(server, "/open", "POST", "item=0")[0] == 403  # without the token


def test_a_picture_that_cannot_be_read_leaves_the_stage_and_tells_why_without_options(tmp_path, capsys):
    with strip(tmp_path, "a.ply", "b.ply") as (server, post, stage, _):
        (tmp_path / "b.ply").write_bytes(b"")
        before = stage.scene
        assert post("/open", "item=1") == (400, b"b.ply is empty") and stage.scene is before
        assert "--depth FILE" in capsys.readouterr().err


def test_dropped_files_join_the_strip(tmp_path):
    data = np.random.default_rng(0).bytes(3 << 20)
    with strip(tmp_path, "a.ply") as (server, post, stage, dropped):
        assert post("/drop?drop=7&name=Ma%20photo.jpg", data)[0] == 204
        assert post("/drop?drop=7&name=Ma%20photo_depth.png", b"depths")[0] == 204
        assert (dropped / "7" / "Ma photo.jpg").read_bytes() == data
        found = json.loads(post("/dropped", "drop=7")[1])
        assert [item["name"] for item in found["items"]] == ["a.ply", "Ma photo.jpg"] and found["first"] == 1
        assert post("/open", "item=1")[0] == 200 and stage.name == "Ma photo.jpg, dropped: True"


@pytest.mark.parametrize("name", ["..%2F..%2Fevil.ply", "%2Fetc%2Fevil.ply", "C%3A%5Cevil.ply", "..%5Cevil.ply"])
def test_dropped_files_stay_in_their_folder(tmp_path, name):
    with strip(tmp_path, "a.ply") as (server, post, stage, dropped):
        assert post(f"/drop?drop=1&name={name}", b"ply")[0] == 204
        assert [path.relative_to(dropped).as_posix() for path in dropped.rglob("*.ply")] == ["1/evil.ply"]


@pytest.mark.parametrize(
    "query", ["name=run.sh&drop=1", "name=.ply&drop=1", "name=&drop=1", "name=a.ply&drop=-1", "name=a.ply"]
)
def test_other_files_are_refused_and_the_connection_goes_on(tmp_path, query):
    with strip(tmp_path, "a.ply") as (server, post, stage, dropped):
        assert post(f"/drop?{query}", bytes(1 << 20))[0] == 400
        assert not list(dropped.rglob("*.*")) and get(server, "/drop?drop=1&name=a.ply", "POST", b"x")[0] == 403


def test_small_pictures_are_upright_and_scenes_have_none(tmp_path):
    with strip(tmp_path, "a.ply", "b.jpg") as (server, post, stage, _):
        exif = Image.Exif()
        exif[0x0112] = 6  # stored on its side
        Image.new("RGB", (800, 400), (200, 30, 30)).save(tmp_path / "b.jpg", exif=exif)
        small = Image.open(io.BytesIO(get(server, "/thumbnail?item=1")[1]))
        assert small.size == (96, 192) and np.abs(np.asarray(small).mean((0, 1)) - (200, 30, 30)).max() < 5
        assert get(server, "/thumbnail?item=0")[0] == 404


def test_photos_and_scenes_of_a_folder_come_in_order_without_their_depths_and_masks(tmp_path):
    for name in ("b10.jpg", "b9.jpg", "b9_depth.png", "mask.png", "s.spz", ".hidden.jpg", "notes.txt", "s.rig.yaml"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in photos_and_scenes(tmp_path)] == ["b9.jpg", "b10.jpg", "s.spz"]
    assert depth_map_beside(tmp_path / "b9.jpg") == tmp_path / "b9_depth.png"
    assert depth_map_beside(tmp_path / "b10.jpg") is None


def test_looks_outlive_the_program_and_hold_numbers_alone(tmp_path):
    with strip(tmp_path, "a.ply") as (server, post, *_):
        look = {"zoom": 2, "background": "#102030", "other": "x"}
        assert post("/looks/keep", urlencode({"name": "Für Omas TV", "look": json.dumps(look)}))[0] == 200
        for wrong in ('{"zoom": "2"}', '{"zoom": NaN}', "[]", '{"background": 5}', "no"):
            assert post("/looks/keep", f"name=b&look={wrong}")[0] == 400
        assert post("/looks/keep", "name=++&look={}")[0] == 400
    kept = LookStore(tmp_path / "looks" / "looks.json")
    assert kept.looks() == {"Für Omas TV": {"zoom": 2, "background": "#102030"}}
    kept.remove("Für Omas TV")
    assert kept.looks() == {}
