"""The page of `view` as an owner uses it, in a headless Chromium: controls, the way back, looks, pictures, words."""

import json
import re
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import SWIFTSHADER_CANVAS
from command_line import PANEL, scene
from test_page import serving
from test_page_in_browser import REST, browser, pixels

from lightfield_gs import encode
from lightfield_gs.panels.rig import Rig
from lightfield_gs.show.page.exports import exports
from lightfield_gs.show.page.gallery import Gallery
from lightfield_gs.show.page.looks import LookStore
from lightfield_gs.show.page.routes import shown_routes
from lightfield_gs.show.page.stage import Controls, Stage, StagedScene
from lightfield_gs.show.page.steering import steering_routes

pytestmark = pytest.mark.not_sanitized  # a sanitizer that is loaded before a browser stops it
SIZES = {"desktop": (1440, 900), "tablet": (820, 1180), "phone": (390, 844)}


def read(path: Path, is_dropped: bool = False) -> StagedScene:
    """A scene that differs for each file: by its bytes."""
    gaussians = scene(seed=sum(path.read_bytes()))
    return StagedScene(gaussians, Rig.frame(gaussians, PANEL), path.name)


@contextmanager
def page_of(folder: Path, *names: str, size=(1440, 900), panel=PANEL, gpu=(), fragment=""):
    """The page of `view` with these pictures in its strip, and the stage behind it; fragment: of its address."""
    pictures, dropped = folder / "pictures", folder / "dropped"
    for made in (pictures, dropped):
        made.mkdir(exist_ok=True)
    paths = [pictures / name for name in names or ("first.ply",)]
    for path in paths:
        path.write_bytes(path.name.encode())
    stage = Stage(read(paths[0]), panel)

    def find(where: Path) -> list[Path]:
        return sorted(path for path in where.iterdir() if path.suffix == ".ply")

    gallery = Gallery(paths, 0, read, find, lambda path: True, (".ply",), dropped)
    looks = LookStore(folder / "looks.json")
    routes = steering_routes(stage, exports(stage), gallery, looks, lambda controls: ["lightfield-gs", "encode"])
    with serving(routes) as server, browser(folder, *size, gpu=gpu) as page:
        page.resize(*size)
        page.open(f"{server.url}/{fragment}")
        page.wait(REST)
        yield page, stage


def value(page, name: str) -> float:
    return float(page.run(f"document.querySelector('#{name}-typed').value"))


def type_number(page, name: str, number: float) -> None:
    page.run(
        f"(t => {{t.value = {number}; t.dispatchEvent(new Event('change'))}})(document.querySelector('#{name}-typed'))"
    )
    page.wait(REST)


def click(page, query: str) -> None:
    page.run(f"document.querySelector('{query}').click()")
    page.wait(REST)


def press(page, key: str, modifiers: int = 0) -> None:
    for kind in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=kind, key=key, modifiers=modifiers)
    page.wait(REST)


LARGE = replace(PANEL, pixel_pitch_mm=4.0)  # on which everything is far before and behind the surface


def test_depth_becomes_comfortable_and_every_step_has_a_way_back(tmp_path):
    with page_of(tmp_path, panel=LARGE) as (page, stage):
        type_number(page, "depth_amount", 200)
        assert stage.resting().depth_amount == 2 and not stage.depth(stage.resting()).comfortable
        assert "Too deep" in page.run("document.querySelector('#comfort').innerText")
        click(page, "#make-comfortable")
        report = stage.depth(stage.resting())
        assert report.comfortable and report.amount < 1.02  # and no flatter than that takes
        click(page, "[aria-label=Black]")
        assert stage.resting().background == "#000000" and pixels(page, "eye")[0, 0].max() < 5

        press(page, "z", modifiers=2)  # Ctrl
        assert stage.resting().background == "" and stage.depth(stage.resting()).comfortable
        click(page, "#undo")
        assert value(page, "depth_amount") == 200
        click(page, "#undo")
        assert stage.resting() == Controls(focus=stage.base.zero_depth, cone_deg=PANEL.cone_deg)
        assert page.run("document.querySelector('#undo').disabled && !document.querySelector('#redo').disabled")
        for _ in range(3):
            press(page, "z", modifiers=10)  # Ctrl and Shift
        assert stage.resting().background == "#000000" and page.run("document.querySelector('#redo').disabled")


def test_a_click_makes_sharp_what_is_there_and_a_drag_does_not(tmp_path):
    with page_of(tmp_path) as (page, stage):
        box = page.run("document.querySelector('[data-pane=eye] canvas').getBoundingClientRect().toJSON()")
        seen = stage.eye(Controls(), 640, still=False).pixels
        row, column = np.argwhere(seen.min(axis=2) < 100)[0]
        share = (column + 0.5) / seen.shape[1], (row + 0.5) / seen.shape[0]
        x, y = box["x"] + share[0] * box["width"], box["y"] + share[1] * box["height"]
        for kind in ("mousePressed", "mouseReleased"):
            page.mouse(kind, x, y, button="left", clickCount=1)
        page.wait(f"document.querySelector('#focus-typed').value !== '100' && {REST}")
        assert stage.resting().focus == pytest.approx(stage.depth_at(Controls(), share), rel=1e-3)
        before = stage.resting()
        page.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
        page.mouse("mouseMoved", x + 30, y, button="left", buttons=1)
        page.mouse("mouseReleased", x + 30, y, button="left", clickCount=1)
        page.wait(REST)
        assert stage.resting().focus == before.focus and stage.resting().yaw_deg == -9


def test_keys_steer_the_picture_and_the_end_of_the_zone_is_said(tmp_path):
    with page_of(tmp_path) as (page, stage):
        page.run("document.querySelector('[data-pane=eye] .picture').focus()")
        press(page, "ArrowLeft")
        press(page, "+")
        press(page, "ArrowDown", modifiers=8)  # Shift
        now = stage.resting()
        assert (now.yaw_deg, now.zoom, now.pan_y) == (5, pytest.approx(1.05), pytest.approx(0.02))
        assert page.run("document.querySelector('#edge').hidden")
        page.run("(s => {s.value = 0.5; s.dispatchEvent(new Event('input'))})(document.querySelector('#eye'))")
        assert "double" in page.run("document.querySelector('#edge').innerText")


def test_a_look_is_kept_for_other_pictures_and_other_days(tmp_path):
    with page_of(tmp_path, "a.ply", "b.ply") as (page, stage):
        type_number(page, "zoom", 150)
        type_number(page, "focus", 90)
        click(page, "[aria-label=Grey]")
        page.run("document.querySelector('#look-name').value = 'Evening <b>'")
        page.run("document.querySelector('#keep').requestSubmit()")
        page.wait("document.querySelector('#kept button')")
    with page_of(tmp_path / "pictures", "b.ply") as (page, stage):
        assert page.run("document.querySelector('#kept').innerText") == "None is kept yet."
    with page_of(tmp_path, "b.ply") as (page, stage):
        assert page.run("document.querySelector('#kept button').innerText") == "Evening <b>"
        click(page, "#kept button")
        now = stage.resting()
        assert (now.zoom, now.background) == (1.5, "#808080")
        assert now.focus == pytest.approx(0.9 * stage.base.zero_depth)
        page.run("document.querySelector('#kept button + button').click()")
        page.wait("document.querySelector('#kept .none')")
    assert json.loads((tmp_path / "looks.json").read_text()) == {}


def drop(page, *paths: Path) -> None:
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        page.call("Input.dispatchDragEvent", type=kind, x=300, y=300, data=data)


def test_pictures_of_the_strip_and_dropped_folders_open(tmp_path):
    album = tmp_path / "album"
    album.mkdir()
    for name in ("new.ply", "notes.txt", "other.ply"):
        (album / name).write_bytes(name.encode())
    with page_of(tmp_path, "a.ply", "b.ply") as (page, stage):
        type_number(page, "depth_amount", 50)
        click(page, "#items li:nth-child(2) button")
        page.wait(f"document.querySelector('#name').textContent === 'b.ply' && {REST}")
        assert value(page, "depth_amount") == 100 and stage.resting().depth_amount == 1  # as it opens
        expected = read(tmp_path / "pictures" / "b.ply")
        np.testing.assert_array_equal(pixels(page, "eye"), Stage(expected, PANEL).eye(Controls(), 64, True).pixels)
        drop(page, album)
        page.wait(f"document.querySelector('#name').textContent === 'new.ply' && {REST}")
        names = page.run("[...document.querySelectorAll('#items span')].map(each => each.textContent)")
        assert names == ["a.ply", "b.ply", "new.ply", "other.ply"]
        assert "1 of the files is neither" in page.run("document.querySelector('#message').innerText")
        drop(page, album / "notes.txt")
        page.wait("document.querySelector('#message').innerText.includes('None of these files')")


@pytest.mark.slow
@pytest.mark.parametrize("gpu", [(), SWIFTSHADER_CANVAS], ids=["server", "webgpu"])
def test_the_display_follows_to_another_picture(tmp_path, gpu):
    """Its page is open on the display while the picture is chosen in another window."""
    with page_of(tmp_path, "a.ply", "b.ply", gpu=gpu, fragment="#software") as (page, stage):
        page.wait("document.body.dataset.draws")
        address, token = page.run("location.origin"), page.run("fetch('scene.json').then(a => a.json())")["token"]
        draws = page.run("document.body.dataset.draws")
        page.resize(PANEL.width_px, PANEL.height_px)
        page.open(f"{address}/panel#software")
        page.wait(f"document.body?.dataset.draws === '{draws}' && document.body.dataset.exact === 'true'", 60)
        before = page.run("document.body.dataset.version")
        page.run(
            f"fetch('open', {{method: 'POST', headers: {{'X-Token': '{token}'}}, body: 'item=1'}}).then(a => a.status)"
        )
        page.wait(f"document.body.dataset.version !== '{before}'", 60)
        other = read(tmp_path / "pictures" / "b.ply")
        assert np.abs(page.screenshot().astype(int) - encode(other.gaussians, PANEL, other.rig).numpy()).max() <= 1


LAYOUT_SHIFTS = """new PerformanceObserver(list => {
  for (const entry of list.getEntries()) window.shifted = (window.shifted ?? 0) + entry.value;
}).observe({type: "layout-shift", buffered: true})"""


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_nothing_jumps_while_pictures_and_words_come(tmp_path, size):
    """0.1 is "good" by the measure of the web, Cumulative Layout Shift; a page of instruments has next to none."""
    with page_of(tmp_path, "a.ply", "b.ply", size=size, panel=LARGE) as (page, stage):
        page.run(LAYOUT_SHIFTS)
        type_number(page, "depth_amount", 200)
        click(page, "#make-comfortable")
        click(page, "#items li:nth-child(2) button")
        page.wait(f"document.querySelector('#name').textContent === 'b.ply' && {REST}")
        time.sleep(0.2)
        assert page.run("window.shifted ?? 0") < 0.01


def test_an_owner_reads_no_words_of_the_command_line(tmp_path):
    with page_of(tmp_path, panel=LARGE) as (page, stage):
        type_number(page, "depth_amount", 200)
        page.run("document.querySelectorAll('details').forEach(each => { each.open = true; })")
        page.run("document.querySelectorAll('[hidden]').forEach(each => { each.hidden = false; })")
        words = page.run("document.querySelector('#command').textContent = ''; document.body.innerText")
        titles = page.run(
            "[...document.querySelectorAll('[title], [aria-label]')].map(e => `${e.title} ${e.ariaLabel}`).join()"
        )
        assert "Make it comfortable" in words
        assert re.findall(r"--\w+|\b\w+=|\w+_\w+|\brigs?\b|\bviews? \d|\bpx\b", words + titles) == []


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_serious(tmp_path, size, scheme):
    axe = pytest.importorskip("axe_playwright_python.base", reason="needs the extra `test`").AXE_SCRIPT
    with page_of(tmp_path, "a.ply", "b.ply", size=size, panel=LARGE) as (page, stage):
        page.prefer(prefers_color_scheme=scheme)
        page.run("document.querySelectorAll('details').forEach(each => { each.open = true; })")
        type_number(page, "depth_amount", 200)
        found = page.run(f"{axe}; axe.run()")
        serious = [
            (each["id"], each["nodes"][0]["html"])
            for each in found["violations"]
            if each["impact"] in ("serious", "critical")
        ]
        assert serious == [] and len(found["passes"]) > 20
        width = page.run("document.documentElement.scrollWidth")
        assert width <= size[0]


def test_axe_finds_nothing_serious_on_the_page_of_the_panel(tmp_path):
    axe = pytest.importorskip("axe_playwright_python.base", reason="needs the extra `test`").AXE_SCRIPT
    with serving(shown_routes(PANEL, np.zeros((60, 96, 3), np.uint8))) as server, browser(tmp_path) as page:
        page.open(server.url + "/panel")
        page.wait("document.body?.dataset.exact === 'false'")
        found = page.run(f"{axe}; axe.run()")
        assert [each["id"] for each in found["violations"] if each["impact"] in ("serious", "critical")] == []
