"""The 3D displays among the screens, their calibrations, and the panel that commands without --panel take."""

import json
import sys

import numpy as np
import pytest
from command_line import complaint, run
from screen_cases import bridge_answer, calibration, connector, edid

from lightfield_gs import InputError, Panel
from lightfield_gs.app import panel as app_panel
from lightfield_gs.app.options import PanelOptions
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.displays import calibrations, find, linux
from lightfield_gs.displays.calibrations import Calibration
from lightfield_gs.displays.find import match_displays
from lightfield_gs.displays.screens import Screen
from lightfield_gs.io.images import write_image
from lightfield_gs.panels.display_kinds import DISPLAY_KINDS, kind_by_serial, kind_by_size, kind_name
from lightfield_gs.panels.quilt import QUILT_PRESETS

PORTRAIT = Screen("HDMI-1", "LKG-P00671", "", 1536, 2048, (1920, 0), 1.0)
LAPTOP = Screen("eDP-1", "Laptop", "", 2560, 1600, (0, 0), 1.0)


def no_bridge(url, _):
    raise InputError(f"Looking Glass Bridge does not answer at {url}")


@pytest.fixture
def computer(tmp_path, monkeypatch):
    """A computer with a laptop's screen, drives in `drives`, a home, and no Bridge; lookups are on."""
    root = tmp_path / "drm"
    connector(root, "eDP-1", edid("Laptop", maker="BOE"), "2560x1600")
    for name in ("drives", "home"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(linux, "_DRM", root)
    monkeypatch.setattr(find, "connected_screens", linux.read_screens)
    monkeypatch.setattr(calibrations, "drives", lambda: sorted((tmp_path / "drives").iterdir()))
    monkeypatch.setattr(calibrations, "connected_displays", no_bridge)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setenv("LIGHTFIELD_GS_DISPLAYS", "on")
    caches = (app_panel._found_panel, app_panel._survey)
    for one in caches:
        one.cache_clear()
    yield tmp_path
    for one in caches:
        one.cache_clear()


def plug_in(computer, serial="LKG-P00671", with_drive=True, size=(1536, 2048)):
    connector(computer / "drm", "HDMI-A-1", edid(serial, size_px=size), "{}x{}".format(*size))
    if with_drive:
        folder = computer / "drives" / serial / "LKG_calibration"
        folder.mkdir(parents=True)
        (folder / "visual.json").write_text(json.dumps(calibration(serial, size)))


def test_a_calibration_belongs_to_the_screen_of_its_serial_or_size():
    own = Calibration(calibration(), "drive", "LKG-P00671")
    other = Calibration(calibration("LKG-E00001", (1440, 2560)), "Bridge", "LKG-E00001")
    copy = Calibration(calibration("LKG-J00001", (3840, 2160)), "copy", "LKG-J00001", is_copy=True)
    first, second = match_displays([LAPTOP, PORTRAIT], [other, own, copy])
    assert (first.screen, first.calibration) == (PORTRAIT, own) and first.title == "Looking Glass Portrait LKG-P00671"
    assert (second.screen, second.calibration) == (None, other)  # Bridge knows it, this system does not
    nameless = Screen("DP-1", "LKG", "", 2048, 1536)
    assert match_displays([nameless], [copy, own])[0].calibration is own
    assert match_displays([LAPTOP], [copy]) == []


def test_kinds_by_serial_and_size():
    serials = {"LKG-PORT-00001": "portrait", "LKG-E00001": "go", "LKG-J00001": "16", "lkg-k1": "32-portrait"}
    assert {one: kind_by_serial(one) for one in serials} == {one: DISPLAY_KINDS[k] for one, k in serials.items()}
    assert kind_by_serial("LKG-Z1") is None
    assert kind_by_size(7680, 4320, 136) is DISPLAY_KINDS["65"] and kind_by_size(7680, 4320) is None


def test_quilts_of_late_2026():
    sizes = {name: (q.columns, q.rows, q.width_px, q.height_px) for name, q in QUILT_PRESETS.items()}
    assert sizes["27"] == sizes["16"] == (8, 6, 7680, 4320) and sizes["27-portrait"] == (12, 4, 7680, 4320)
    assert sizes["16-portrait"] == (11, 6, 5995, 6000) and sizes["32-portrait"] == (11, 6, 8184, 8184)
    assert sizes["16-gen3"] == (7, 7, 5999, 5999)


@pytest.mark.parametrize("name", DISPLAY_KINDS)
def test_panels_by_name_have_a_lens_and_a_place_for_the_eyes(name):
    with pytest.warns(UserWarning, match="only its visual.json gives right views"):
        panel = Panel.load(name)
    assert (panel.width_px, panel.height_px) == DISPLAY_KINDS[name].size_px and panel.viewing_distance_mm
    assert app_panel.why_no_eye(panel) is None and 9 < panel.line_number < 20


def test_drives_of_linux():
    mounts = "/dev/sda1 / ext4 rw 0 0\n/dev/sdb /media/me/LKG\\0401 vfat rw 0 0\nnas:/x /mnt/nas nfs rw 0 0\n"
    assert [str(one) for one in calibrations.mounted_drives(mounts)] == ["/media/me/LKG 1"]


def test_bridge_tells_calibrations(computer, monkeypatch):
    told = bridge_answer(calibration(), calibration("LKG-X1", (5120, 2880)), hardware="27_gen3_l")
    monkeypatch.setattr(calibrations, "connected_displays", lambda *_: told)
    first, second = calibrations.find_calibrations([])
    assert (first.serial, second.serial) == ("LKG-P00671", "LKG-X1") and second.kind is DISPLAY_KINDS["27"]
    panel = Panel.from_looking_glass(second.data, serial="LKG-X1")
    assert (panel.width_px, panel.height_px) == (5120, 2880)


def test_commands_take_the_display_that_is_connected(computer, capsys):
    plug_in(computer)
    path = computer / "hues.png"
    words = run(capsys, f"calibrate pattern hues -o {path}")
    assert "1536 x 2048" in words
    line = next(line for line in words.splitlines() if "is connected" in line)
    assert "Looking Glass Portrait LKG-P00671" in line and "visual.json" in line and "--panel" in line
    assert "450 mm, usual before a Looking Glass Portrait" in words
    assert app_panel.connected_preset() == "portrait"
    listed = run(capsys, "displays")
    assert "screen: Laptop on eDP-1: 2560 x 1600" in listed and "3D display: Looking Glass Portrait LKG-P" in listed
    facts = json.loads(run(capsys, "displays --json"))
    assert facts["displays"][0]["serial"] == "LKG-P00671" and facts["screens"][0]["width_px"] == 1536


def test_show_says_where_the_display_is_and_whether_the_image_suits_it(computer, capsys, monkeypatch):
    plug_in(computer)
    monkeypatch.setattr("lightfield_gs.commands.show.serve", lambda *_: None)
    run(capsys, f"calibrate pattern hues -o {computer / 'own.png'}")
    words = run(capsys, f"show {computer / 'own.png'}")
    assert "display: Looking Glass Portrait LKG-P00671 on HDMI-A-1; move the browser there" in words
    assert "lens is not" not in words
    run(capsys, f"calibrate pattern hues --panel toy-8v -o {computer / 'toy.png'}")
    assert "made for panel toy-8v, whose lens is not the display's" in run(capsys, f"show {computer / 'toy.png'}")
    write_image(computer / "bare.png", np.zeros((2048, 1536, 3), np.uint8))
    assert "for panel looking-glass" in run(capsys, f"show {computer / 'bare.png'}")


def test_without_a_display_the_default_panel_is_taken_and_said(computer, capsys):
    words = run(capsys, f"calibrate pattern hues -o {computer / 'hues.png'}")
    assert "7680 x 3840" in words and "assumed: panel 65in-8k-96v: no display was found (another: --panel" in words
    listed = run(capsys, "displays")
    assert (
        "3D display: none" in listed and "/Volumes/LKG-" in listed and "Looking Glass Bridge does not answer" in listed
    )


def test_without_its_calibration_a_typical_lens_is_taken_and_said(computer, capsys):
    plug_in(computer, "LKG-E00042", with_drive=False, size=(1440, 2560))
    words = run(capsys, f"calibrate pattern hues -o {computer / 'hues.png'}")
    assert "1440 x 2560" in words and "a typical Looking Glass Go" in words and "LKG_calibration" in words


def test_a_serial_chooses_among_displays(computer, capsys):
    plug_in(computer)
    folder = computer / "drives" / "two" / "LKG_cal"
    folder.mkdir(parents=True)
    (folder / "visual.json").write_text(json.dumps(calibration("LKG-E7", (1440, 2560), DPI=491)))
    with pytest.warns(UserWarning, match="also connected: Looking Glass Go LKG-E7"):
        assert app_panel.load_panel(PanelOptions()).width_px == 1536
    with pytest.warns(UserWarning):
        assert app_panel.load_panel(PanelOptions(device_serial="lkg-e7")).width_px == 1440
    with pytest.raises(InputError, match="no display with serial=LKG-Q is connected; found: Looking Glass Portrait"):
        app_panel.load_panel(PanelOptions(device_serial="LKG-Q"))


def test_the_lookup_can_be_turned_off(computer, monkeypatch):
    plug_in(computer)
    monkeypatch.setenv("LIGHTFIELD_GS_DISPLAYS", "off")
    assert app_panel.load_panel(PanelOptions()).name == DEFAULT_PANEL


def test_a_damaged_calibration_is_said(computer, capsys):
    folder = computer / "drives" / "LKG" / "LKG_calibration"
    folder.mkdir(parents=True)
    (folder / "visual.json").write_text("{")
    assert "visual.json is not JSON" in run(capsys, "displays")
    (folder / "visual.json").write_text(json.dumps(calibration(fringe=1)))
    assert "fringe is set" in complaint(capsys, f"calibrate pattern hues -o {computer / 'hues.png'}")


@pytest.mark.parametrize(
    "words, name",
    [
        ("Looking Glass Go", "go"),
        ("looking-glass-portrait", "portrait"),
        ('16"', "16"),
        ("27 inch", "27"),
        ("32in", "32"),
        ("27-landscape", "27"),
        ("65-inch", "65"),
        ("16-portrait", "16-portrait"),
        ("LKG-E01234", "go"),
        ("12", None),
        ("inch", None),
    ],
)
def test_a_display_is_named_in_an_owners_words(words, name):
    assert kind_name(words) == name


def test_a_visual_json_that_is_not_there_is_said_with_its_place(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = complaint(capsys, "encode s.ply -o o.png --panel visual.json")
    assert "cannot read visual.json" in words and "/Volumes/LKG" in words and "E: on Windows" in words
