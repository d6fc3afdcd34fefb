"""The page to send in Chromium: by WebGPU the bytes of `encode`, and pictures drawn beforehand without it."""

import json
import os
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from chromium import SWIFTSHADER_CANVAS, Browser, find
from rasterizer_cases import CELLS, panel, random_scene, rig

from lightfield_gs import encode, panels, webgpu
from lightfield_gs.panels import simulate
from lightfield_gs.panels.look import Look, orbited
from lightfield_gs.panels.panel import Panel, panel_lens
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.scene_page.write import DrawnAs, write_scene_page
from lightfield_gs.show.scripts import joined
from lightfield_gs.webgpu.parameters import Boxes, tilings

pytestmark = [pytest.mark.not_sanitized, pytest.mark.slow]  # a sanitizer that is loaded before a browser stops it
STILL = "document.body?.dataset.state === 'still'"
HIDE_BAR = "document.querySelector('#bar').style.display = 'none'"
CALIBRATION = {
    "pitch": 47.0, "slope": -5.5, "center": 0.1, "viewCone": 42, "invView": 1, "DPI": 338.0, "screenW": 128,
    "screenH": 80, "flipSubp": 0, "subpixelCells": [],
}  # fmt: skip


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page of a Chromium that draws by WebGPU."""
    find()
    opened = Browser(tmp_path_factory.mktemp("browser"), 400, 300, gpu=SWIFTSHADER_CANVAS)
    try:
        opened.prefer(prefers_reduced_motion="reduce")
        has = "(async () => Boolean(navigator.gpu && await navigator.gpu.requestAdapter()))()"
        opened.open("file:///")
        if not opened.run(has):
            pytest.skip("this Chromium has no adapter for WebGPU")
        yield opened
    finally:
        opened.close()


def written(path: Path, gaussians: Gaussians, shown: Panel, fan: Rig, **drawn_as) -> Gaussians:
    """Write a page, and return the Gaussians that it draws."""
    return write_scene_page(path, "Scene", gaussians, shown, fan, DrawnAs(**drawn_as), False, True).shown


def opened(page: Browser, path: Path, shown: Panel, words: str = "software&panel") -> None:
    page.resize(shown.width_px, shown.height_px)
    page.open("about:blank")
    page.open(f"{path.as_uri()}#{words}")
    page.wait(STILL, 120)
    page.run(HIDE_BAR)


def most_apart(page: Browser, expected: torch.Tensor) -> int:
    page.wait(STILL, 60)
    return int(np.abs(page.screenshot().astype(int) - expected.numpy()).max())


KINDS = {
    "stripes": ({}, 0, {}),
    "other way, BGR, inverted": (dict(slant_tan=-0.18, subpixel_order="BGR", phase=-7.25, invert_views=True), 1, {}),
    "cells, anti-aliased": (dict(subpixel_cells=CELLS, cell_pattern=2), 0, dict(antialiased=True)),
    "view filter, degree 3": (dict(cone_deg=60.0), 3, dict(view_filter=2.0)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_canvas_has_the_bytes_of_encode(tmp_path, page, kind):
    of_panel, degree, drawn_as = KINDS[kind]
    shown = panel(**{"width_px": 160, "height_px": 96, **of_panel})
    fan = rig(shown, 0.1, -0.15, (0.53, 0.44))
    background = (0.1, 0.6, 0.3)
    gaussians = written(
        tmp_path / "p.html", random_scene(200, degree=degree, dtype=torch.float32), shown, fan,
        background=background, **drawn_as,
    )  # fmt: skip
    opened(page, tmp_path / "p.html", shown)
    assert page.run("document.body.dataset.exact") == "true" and page.run("document.querySelector('#word').hidden")
    expected = encode(gaussians, shown, fan, background=background, **drawn_as)
    assert expected.float().std() > 10 and most_apart(page, expected) <= 1

    page.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight'}))")
    turned = encode(gaussians, shown, orbited(fan, -3, 0), background=background, **drawn_as)
    assert most_apart(page, turned) <= 1


def test_a_dropped_calibration_takes_the_place_of_the_panel(tmp_path, page):
    made_for = panel(width_px=160, height_px=96)
    fan = rig(made_for)
    gaussians = written(tmp_path / "p.html", random_scene(200, dtype=torch.float32), made_for, fan)
    own = Panel.from_looking_glass(CALIBRATION)
    opened(page, tmp_path / "p.html", own)
    try:
        page.run(f"""(() => {{
          const dataTransfer = new DataTransfer();
          dataTransfer.items.add(new File([{json.dumps(json.dumps(CALIBRATION))}], "visual.json"));
          dispatchEvent(new DragEvent("drop", {{dataTransfer}}));
        }})()""")
        page.wait("document.querySelector('#display-now').textContent.includes('looking-glass')")
        page.run("document.querySelector('#display').close()")
        page.wait(f"{STILL} && document.querySelector('#picture').width === 128 && document.body.dataset.exact")
        assert page.run("document.body.dataset.exact") == "true"
        fitted = fan.fitted((made_for.width_px, made_for.height_px), own)
        assert most_apart(page, encode(gaussians, own, fitted)) <= 1
    finally:
        page.run("localStorage.clear()")


def test_a_wrong_screen_is_told_aloud(tmp_path, page):
    shown = panel(width_px=160, height_px=96)
    written(tmp_path / "p.html", random_scene(50, dtype=torch.float32), shown, rig(shown))
    opened(page, tmp_path / "p.html", replace(shown, width_px=800, height_px=600))
    assert "has 160 × 96" in page.run("document.querySelector('#word').innerText")
    page.run("document.querySelector('#leave').click()")
    page.wait(f"{STILL} && document.querySelector('#picture').width === 800")
    assert page.run("document.querySelector('#word').hidden && document.body.dataset.mode") == "screen"


def test_the_test_picture_tells_the_eyes_apart(tmp_path, page):
    shown = panel(width_px=160, height_px=96)
    written(tmp_path / "p.html", random_scene(50, dtype=torch.float32), shown, rig(shown))
    opened(page, tmp_path / "p.html", shown)
    page.run("document.querySelector('#test').click()")
    page.wait(STILL)
    pixels, views = page.screenshot(), shown.view_map()
    middle = slice(16, 80)
    np.testing.assert_array_equal(pixels[middle, :, 0] > 0, views[middle, :, 0] >= shown.views / 2)
    np.testing.assert_array_equal(pixels[middle, :, 2] > 0, views[middle, :, 2] < shown.views / 2)
    assert (pixels[:16, :80] == 255 * (np.arange(80) % 2)[None, :, None]).all()  # lines of one pixel
    assert (pixels[:16, 80:] == 255 * (np.arange(16) % 2)[:, None, None]).all()


def test_an_ordinary_screen_shows_one_view(tmp_path, page):
    """As large as the window; what the centre camera sees."""
    shown = panel(width_px=160, height_px=96)
    fan = rig(shown)
    gaussians = written(tmp_path / "p.html", random_scene(200, dtype=torch.float32), shown, fan)
    window = replace(shown, width_px=200, height_px=150, views=1)
    opened(page, tmp_path / "p.html", window, "software")
    flat = Look(depth_amount=0).applied(fan.fitted((160, 96), window), window)
    assert most_apart(page, encode(gaussians, window, flat)) <= 2  # its limits of the Jacobian are those of the cone


def test_pictures_are_shown_where_there_is_no_webgpu(tmp_path):
    find()
    shown = panel(width_px=160, height_px=96)
    written(tmp_path / "p.html", random_scene(50, dtype=torch.float32), shown, rig(shown))
    browser = Browser(tmp_path, 400, 300)
    try:
        browser.prefer(prefers_reduced_motion="reduce")
        browser.open((tmp_path / "p.html").as_uri())
        browser.wait("document.querySelector('#strip')?.dataset.view")
        assert "drawn beforehand" in browser.run("document.querySelector('#note').innerText")
        before = int(browser.run("document.querySelector('#strip').dataset.view"))
        browser.run("dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'}))")
        browser.wait(f"Number(document.querySelector('#strip').dataset.view) > {before}")
    finally:
        browser.close()


def open_modules(page: Browser, folder: Path, files: dict[str, Path]) -> None:
    """Let an empty page have what modules export, by its names."""
    lines = [
        f'import {{ {name} }} from "./{os.path.relpath(file, folder)}";\nwindow.{name} = {name};\n'
        for name, file in files.items()
    ]
    (folder / "entry.js").write_text("".join(sorted(lines, reverse=True)))
    page.open("about:blank")
    page.run(joined(folder / "entry.js"))


def test_eyes_of_the_page_look_through_the_lenses_as_those_of_the_package(tmp_path, page, monkeypatch):
    """Where they meet the lens of each sub-pixel, on panels of cells and lenses behind the pixels too."""
    open_modules(page, tmp_path, {"eyeBefore": Path(panels.__file__).parent / "browser" / "simulate.js"})
    found, turns_along = [], simulate._turns_along
    monkeypatch.setattr(
        simulate, "_turns_along", lambda *of: found.append((turns_along(*of), of[-1].slope)) or found[-1][0]
    )
    measures = dict(viewing_distance_mm=650.0, pixel_pitch_mm=0.18)
    assert page.run(f"eyeBefore({json.dumps(panel().to_dict())}, 0.2)") is None
    behind = panel(invert_views=True, subpixel_order="BGR", **measures)
    for one in (panel("cells", **measures), panel("cells of four rows", **measures), behind):
        found.clear()
        width, height = one.width_px, one.height_px
        eye_mm = 0.2 * simulate.zone_width_mm(one), 0.0, one.viewing_distance_mm
        seen = simulate.simulate(np.zeros((height, width, 3), np.uint8), one, eye_mm, threads=1)
        plain = "(eye) => ({...eye, turns: [...eye.turns], borders: [...eye.borders]})"
        eye = page.run(f"({plain})(eyeBefore({json.dumps(one.to_dict())}, 0.2))")
        along = np.stack([turns for turns, _ in found], 1).ravel()
        down = found[0][1] * 3 * one.slant_tan * np.arange(height)
        apart = np.array(eye["turns"]) - np.concatenate([along, down])
        assert np.abs(apart - apart.round()).max() < 1e-6
        assert eye["samples"] == [seen.shape[1], seen.shape[0]]
        cells = [simulate.cell_borders(size, one.line_number) for size in (width, height)]
        assert eye["borders"] == np.concatenate(cells).tolist()


def test_lenses_of_the_page_are_those_of_the_package(tmp_path, page):
    """Phases of 64 bits, cells, and what a visual.json becomes."""
    of_panels, of_webgpu = (Path(room.__file__).parent / "browser" for room in (panels, webgpu))
    files = {"lensOf": of_panels / "lens.js", "panelOfCalibration": of_panels / "calibration.js"}
    files |= dict.fromkeys(("boxesOf", "tilings"), of_webgpu / "parameters.js")
    open_modules(page, tmp_path, files)
    shown = [panel(name) for name in ("cells", "cells of four rows", "cells far aside", "cells of narrow lenses")]
    shown += [panel(), panel(line_number=9.0, slant_tan=-0.25, phase=1e6 / 3), Panel.load("65in-8k-96v")]
    words = "(_, value) => typeof value === 'bigint' ? String(value) : value"
    for one in shown:
        lens = json.loads(page.run(f"JSON.stringify(lensOf({json.dumps(one.to_dict())}, 0.5, -0.1), {words})"))
        expected = panel_lens(one, False, 0.5, -0.1)
        assert [int(phase) for phase in lens["phases"]] == list(expected.phases)
        assert lens["phase"] == pytest.approx(expected.phase, rel=1e-14) and lens["bgr"] == expected.bgr
        cells = lens["cells"] or []
        assert [int(cell["phase"]) for cell in cells] == list(expected.cell_phases)
        assert [cell["channel"] for cell in cells] == list(expected.cell_channels)
        for ordinals in tilings(expected):
            boxes = page.run(f"boxesOf(lensOf({json.dumps(one.to_dict())}, 0.5, -0.1), {ordinals})")
            assert tuple(boxes.values()) == astuple(Boxes.of(expected, ordinals))
        assert page.run(f"tilings(lensOf({json.dumps(one.to_dict())}, 0.5, -0.1))") == list(tilings(expected))
    places = {f"{colour}Offset{axis}": f"0.{k}" for k, colour in enumerate("RGB") for axis in "XY"}
    cells = {"subpixelCells": [places], "CellPatternMode": 0}
    for change in ({}, {"flipImageX": 1}, {"flipSubp": "1"}, {"invView": 0}, cells):
        data = {key: {"value": value} for key, value in {**CALIBRATION, **change}.items()}
        found = page.run(f"panelOfCalibration({json.dumps(json.dumps(data))}).panel")
        expected = replace(Panel.from_looking_glass(data), pixel_pitch_mm=None)
        assert Panel(**found) == expected
