"""`lightfield-gs calibrate`: patterns written, profiles nudged in their own format."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import complaint, run
from PIL import Image

from lightfield_gs.base.arrays import decode_srgb, encode_srgb
from lightfield_gs.io.images import read_image, read_info, write_image
from lightfield_gs.panels.lens_change import LensChange, changed
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import bars, single, sweep
from lightfield_gs.panels.simulate import simulate

TEMPLATE = dict(pitch=42.0, slope=-6, center=0.3, DPI=136, screenW=768, screenH=432, invView=1, viewCone=40)


def visual(**change) -> dict:
    return {"serial": "LKG-1", **{key: {"value": value} for key, value in {**TEMPLATE, **change}.items()}, "extra": [1]}


def middle(panel: Panel) -> float:
    """Phase of a sub-pixel in the panel's middle, DESIGN 3, in lens widths."""
    d = 3 * (panel.width_px - 1) / 2 + 3 * (panel.height_px - 1) / 2 * panel.slant_tan + 1 + panel.phase
    return d / panel.line_number


def test_patterns_are_written_with_their_panel(capsys, tmp_path):
    path = tmp_path / "p.png"
    run(capsys, f"calibrate pattern single --view 2-3 --panel toy-8v -o {path}")
    assert np.array_equal(read_image(path, as_stored=True), single(Panel.load("toy-8v"), 2, 3))
    assert json.loads(read_info(path).metadata["panel"])["name"] == "toy-8v"
    assert "of 8 views" in run(capsys, f"calibrate pattern numbers --panel toy-8v -o {path}")
    for kind in ("greys", "rgb", "pitch --span 1 --bands 3", "slope", "centre", "depth", "phase --shift 1"):
        run(capsys, f"calibrate pattern {kind} --panel toy-8v -o {path}")
        assert read_image(path).shape == (240, 480, 3)
    assert "leave it out" in complaint(capsys, f"calibrate pattern hues --view 2 --panel toy-8v -o {path}")
    assert "0..7" in complaint(capsys, f"calibrate pattern single --view 8 --panel toy-8v -o {path}")
    assert "odd" in complaint(capsys, f"calibrate pattern pitch --bands 4 --panel toy-8v -o {path}")


@pytest.mark.parametrize(
    "wrap", [lambda v: v, lambda v: {"a": [json.dumps({"calibration": v}), {"b": v}]}], ids=["plain", "nested"]
)
@pytest.mark.parametrize("change", [{}, dict(flipImageX=1, slope=6), dict(pitch="42", center="0.3")])
def test_a_looking_glass_is_nudged_in_its_own_words(capsys, tmp_path, wrap, change):
    old, new = tmp_path / "visual.json", tmp_path / "new.json"
    old.write_text(json.dumps(wrap(visual(**change))))
    said = run(
        capsys, f"calibrate nudge {old} -o {new} --pitch-by 0.042 --slope-by -0.03 --centre-by 0.2 --pattern hues"
    )
    assert "pitch 42 -> 42.042, slope " in said and "line_number 9.84828219 -> " in said
    kept, written = wrap(visual(**change)), json.loads(new.read_text())
    while "pitch" not in written:  # into the nested ones
        kept, written = (part["a"] if "a" in part else part for part in (kept, written))
        kept, written = (json.loads(part[0])["calibration"] for part in (kept, written))
    assert list(written) == list(kept)
    assert {key: value for key, value in written.items() if key not in ("pitch", "slope", "center")} == {
        key: value for key, value in kept.items() if key not in ("pitch", "slope", "center")
    }
    assert type(written["pitch"]["value"]) is type(kept["pitch"]["value"])
    assert float(written["pitch"]["value"]) == pytest.approx(42.042, rel=1e-12)
    assert written["slope"]["value"] == pytest.approx(TEMPLATE["slope"] * (-1 if change.get("slope") else 1) - 0.03)
    before, after = Panel.load(old), Panel.load(new)
    assert middle(after) - middle(before) == pytest.approx(-0.2, abs=1e-6)
    assert np.array_equal(read_image(tmp_path / "new-hues.png", as_stored=True), sweep(after))


def test_a_yaml_keeps_its_comments(capsys, tmp_path):
    old, new = tmp_path / "p.yaml", tmp_path / "new.yaml"
    old.write_text(
        "# mine\nwidth_px: 480\nheight_px: 240\nviews: 8\nline_number: 10.5  # wide\n"
        "slant_tan: 0.2\npixel_pitch_mm: 0.2\n"
    )
    said = run(capsys, f"calibrate nudge {old} -o {new} --pitch-by -1% --phase-by 2")
    before, after = Panel.load(old), Panel.load(new)
    assert after.line_number == pytest.approx(10.5 / 0.99) and after.slant_tan == 0.2
    assert middle(after) - middle(before) == pytest.approx(2 / after.line_number)
    assert f"pitch {3 * 25.4 / 0.2 / 10.5 * 1.04**0.5:.9g} -> " in said
    lines = new.read_text().splitlines()
    assert (
        lines[:2] == ["# mine", "width_px: 480"] and lines[4].endswith("  # wide") and lines[-1].startswith("phase: ")
    )
    run(capsys, f"calibrate nudge toy-8v -o {new} --slope-by 1%")
    assert Panel.load(new).slant_tan == pytest.approx(1 / 6 / 1.01) and "# A toy" in new.read_text()


def test_what_a_nudge_refuses(capsys, tmp_path):
    new = tmp_path / "new.yaml"
    assert "nothing to change" in complaint(capsys, f"calibrate nudge toy-8v -o {new}")
    assert "0.1%" in complaint(capsys, f"calibrate nudge bench-8k-96v -o {new} --pitch-by 0.1")
    assert ".yaml" in complaint(capsys, f"calibrate nudge toy-8v -o {tmp_path}/new.json --pitch-by 0.1")
    assert "no lens" in complaint(capsys, f"calibrate nudge toy-8v -o {new} --line-number-by -30")
    flow = tmp_path / "flow.yaml"
    flow.write_text("{width_px: 48, height_px: 24, views: 8, line_number: 10, slant_tan: 0.2}")
    assert "of this form" in complaint(capsys, f"calibrate nudge {flow} -o {new} --centre-by 0.1")
    assert not new.exists()


def test_what_calibrate_changes_has_a_way_back(capsys, tmp_path):
    path = tmp_path / "visual.json"
    path.write_text(first := json.dumps(visual()))
    run(capsys, f"calibrate nudge {path} -o {path} --pitch-by 0.1% --centre-by 0.05")
    second = path.read_text()
    assert "calibrate undo" in run(capsys, f"calibrate nudge {path} -o {path} --slope-by 2%")
    assert "the slope changes by +3 %" in complaint(capsys, f"calibrate nudge {path} -o {path} --slope-by 3%")
    run(capsys, f"calibrate nudge {path} -o {path} --slope-by 3% --yes")
    last = path.read_text()
    listed = run(capsys, f"calibrate history {path}").splitlines()
    assert [line[2] for line in listed[:4]] == list("1234") and [line[0] for line in listed[:4]] == list("   *")
    assert "pitch by 0.1%, centre by 0.05: pitch 42 -> 42.042" in listed[1]
    for _ in range(2):
        run(capsys, f"calibrate undo {path}")
    assert path.read_text() == second
    run(capsys, f"calibrate undo {path}")
    assert path.read_text() == first
    assert "as it was at first" in complaint(capsys, f"calibrate undo {path}")
    run(capsys, f"calibrate undo {path} --to 4")  # nothing is lost
    assert path.read_text() == last
    path.write_text("broken by hand")
    run(capsys, f"calibrate undo {path}")
    assert path.read_text() == last and "changed by hand" in run(capsys, f"calibrate history {path}")
    other = tmp_path / "other.json"
    for action in ("undo", "history"):
        assert "No such file" in complaint(capsys, f"calibrate {action} {other}")
    other.write_text(first)
    assert "nothing to undo" in complaint(capsys, f"calibrate undo {other}")
    new = tmp_path / "new.yaml"
    run(capsys, f"calibrate nudge toy-8v -o {new} --pitch-by 1%")
    run(capsys, f"calibrate undo {new}")
    assert Panel.load(new) == replace(Panel.load("toy-8v"), name=Panel.load(new).name)


def camera(start: Panel, true: Panel, eye, folder, name: str) -> list[str]:
    """Files of photographs of the three shifts: the panel seen straight on in a dark room, a few pixels a lens."""
    paths = []
    for shift in range(3):
        seen = simulate(decode_srgb(bars(start, shift) / 255), true, eye)
        photo = np.pad(seen.repeat(3, 0).repeat(3, 1), ((40, 50), (60, 30), (0, 0)))
        paths.append(str(folder / f"{name}-{shift}.png"))
        write_image(paths[-1], np.rint(255 * encode_srgb(photo)).astype(np.uint8))
    return paths


def test_a_profile_is_fitted_to_photographs(capsys, tmp_path):
    old, new = tmp_path / "visual.json", tmp_path / "new.json"
    old.write_text(json.dumps(visual(screenW=480, screenH=270)))
    start = replace(Panel.load(old), viewing_distance_mm=600)
    true = changed(start, LensChange(pitch_percent=0.3, slope_percent=-1, centre=0.15))
    eyes = (-10, 0, 600), (80, 30, 620)
    photos = [camera(start, true, eye, tmp_path, f"p{k}") for k, eye in enumerate(eyes)]
    line = f"calibrate fit {' '.join(sum(photos, []))} --eye -10,0,600 --eye 80,30,620 --panel {old} -o {new}"
    assert "--viewing-distance" in complaint(capsys, line)
    said = run(capsys, f"{line} --viewing-distance 600")
    assert "pitch 42 -> 42.12" in said and "p1-0.png p1-1.png p1-2.png" in said
    fitted = Panel.load(new)
    assert fitted.line_number == pytest.approx(true.line_number, rel=1e-5)
    assert middle(fitted) - middle(true) == pytest.approx(0, abs=2e-3)
    listed = tmp_path / "places.yaml"
    entries = [{"eye_mm": eye, "photos": [Path(p).name for p in paths]} for eye, paths in zip(eyes, photos)]
    listed.write_text("places: " + json.dumps(entries))
    again = tmp_path / "again.json"
    run(capsys, f"calibrate fit {listed} --panel {old} -o {again} --viewing-distance 600")
    assert again.read_text() == new.read_text()
    said = run(capsys, f"calibrate fit {listed} --panel {old} -o {again} --viewing-distance 600 --refine")
    left = [float(number) for number in re.findall(r"left (\S+) views over before, and (\S+) after", said)[0]]
    assert left[1] <= left[0] and Panel.load(again).line_number == pytest.approx(true.line_number, rel=1e-6)
    for number, seconds in enumerate((1 / 30, 1 / 30, 1 / 60)):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: seconds, 0x829D: 1.8, 0x8827: 100})
        Image.open(photos[0][number]).save(tmp_path / f"e{number}.jpg", exif=exif)
    unlike = " ".join(str(tmp_path / f"e{number}.jpg") for number in range(3))
    words = complaint(capsys, f"calibrate fit {unlike} --eye 0,0,600 --one-place --panel toy-8v -o {tmp_path}/x.yaml")
    assert "one exposure" in words and "e0.jpg 2, e1.jpg 2, e2.jpg 1" in words
    few = f"calibrate fit {' '.join(photos[0])} --panel toy-8v -o {tmp_path}/x.yaml"
    assert "3 photographs and 0 --eye" in complaint(capsys, few)
    assert "one place" in complaint(capsys, f"{few} --eye 0,0,600")
    listed.write_text("places: [{eye_mm: [0, 0, 1], photos: [none.png]}]")
    assert "places[0]" in complaint(capsys, f"calibrate fit {listed} --panel toy-8v -o {tmp_path}/x.yaml")
    assert not (tmp_path / "x.yaml").exists()
