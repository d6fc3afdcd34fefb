"""Looking Glass calibrations as people have them, and text in the encodings that editors save."""

import json
import re
import warnings

import pytest
from command_line import complaint, run

from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.looking_glass import find_calibration
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

FLAT = {
    "configVersion": "3.0",
    "serial": "LKG-A",
    "pitch": 47.0,
    "slope": -5.5,
    "center": 0.1,
    "viewCone": 42,
    "invView": 1,
    "DPI": 338.0,
    "screenW": 256,
    "screenH": 160,
    "flipSubp": 0,
    "subpixelCells": [],
}
WRAPPED = {
    key: value if key in ("configVersion", "serial", "subpixelCells") else {"value": value}
    for key, value in FLAT.items()
}
STRINGS = {key: {"value": str(value["value"])} if isinstance(value, dict) else value for key, value in WRAPPED.items()}
OTHER = {**WRAPPED, "serial": "LKG-B", "pitch": {"value": 52.0}}
DISPLAYS = {  # each holds WRAPPED and OTHER, as one program or another stores them
    "list": [WRAPPED, OTHER],
    "service": {
        "devices": [
            {"hwid": "LKG-A", "calibration": WRAPPED, "defaultQuilt": {"tileX": 8}},
            {"hwid": "LKG-B", "calibration": OTHER},
        ],
        "error": 0,
    },
    "by number": {"devices": {"0": {"calibration": WRAPPED}, "1": {"calibration": OTHER}, "2": {"calibration": {}}}},
    "strings": {
        "payload": {
            "name": "devices",
            "value": {
                str(number): {
                    "name": str(number),
                    "value": {
                        "hwid": {"type": "string", "value": serial},
                        "calibration": {"type": "string", "value": json.dumps({**data, "serial": ""}) if data else ""},
                    },
                }
                for number, (serial, data) in enumerate({"LKG-A": WRAPPED, "LKG-B": OTHER, "a monitor": None}.items())
            },
        }
    },
}


def test_a_calibration_reads_the_same_however_it_is_written():
    panel = Panel.from_looking_glass(FLAT)
    assert (panel.width_px, panel.cone_deg, panel.pixel_pitch_mm) == (256, 42, 25.4 / 338)
    nested = {"hardwareSDKversion": "2.0", "calibration": WRAPPED, "defaultQuilt": {"quiltAspect": 0.75}}
    for written in (WRAPPED, STRINGS, nested, [nested], {"calibration": json.dumps(nested)}, [WRAPPED, {"a": WRAPPED}]):
        assert Panel.from_looking_glass(written) == panel


def test_keys_are_known_whatever_their_capitals():
    loud = {key.upper(): value for key, value in WRAPPED.items()}
    assert Panel.from_looking_glass(loud) == Panel.from_looking_glass(WRAPPED)
    assert find_calibration({**WRAPPED, "cellPatternMode": "2"}, "here")["CellPatternMode"] == 2
    with pytest.raises(InputError, match="here: expected each key once"):
        find_calibration({**WRAPPED, "Pitch": 3}, "here")


def test_what_is_no_number_stays_as_it_is():
    cells = [{"ROffsetX": "-0.31"}, {"ROffsetX": {"value": 0.5}}, 3]
    flat = find_calibration({**STRINGS, "subpixelCells": {"value": cells}, "invView": True, "odd": "7"}, "here")
    assert flat["subpixelCells"] == [{"ROffsetX": -0.31}, {"ROffsetX": 0.5}, 3]
    assert flat["invView"] is True and flat["odd"] == "7"
    assert flat["configVersion"] == "3.0" and flat["screenW"] == 256


@pytest.mark.parametrize(
    "text, hint",
    [
        ("47,0", "write it with a point"),
        ("", "got ''"),
        ("wide", "got 'wide'"),
        ("nan", "got 'nan'"),
        ("1_0", "got '1_0'"),
        ("4 7", "got '4 7'"),
    ],
)
def test_strings_that_are_no_numbers_are_refused_by_name(tmp_path, text, hint):
    path = tmp_path / "visual.json"
    for change, key in (
        ({"pitch": {"value": text}}, "pitch"),
        ({"subpixelCells": [{}, {"GOffsetY": text}]}, r"subpixelCells\[1\]: GOffsetY"),
    ):
        path.write_text(json.dumps({"calibration": {**WRAPPED, **change}}))
        with pytest.raises(InputError, match=f"visual.json: calibration: {key} must be a number, .*{hint}"):
            Panel.load(path)


@pytest.mark.parametrize("shape", DISPLAYS)
def test_several_displays_are_told_apart_by_their_serial(tmp_path, shape):
    path = tmp_path / "displays.json"
    path.write_text(json.dumps(DISPLAYS[shape]))
    assert Panel.load(path, serial="LKG-A") == Panel.from_looking_glass(WRAPPED)
    assert Panel.load(str(path), serial="lkg-b") == Panel.from_looking_glass(OTHER)
    with pytest.raises(InputError, match="2 displays: LKG-A, LKG-B; say which with serial="):
        Panel.load(path)
    with pytest.raises(InputError, match="no calibration of a display with serial 'LKG-C'; it has LKG-A, LKG-B"):
        Panel.load(path, serial="LKG-C")


def test_displays_without_or_with_the_same_serial_are_never_mixed_up():
    bare = [{key: value for key, value in data.items() if key != "serial"} for data in (WRAPPED, OTHER)]
    with pytest.raises(InputError, match=r"2 displays: devices.0 \(without a serial\), devices.1"):
        find_calibration({"devices": bare}, "here")
    with pytest.raises(InputError, match="2 different calibrations of a display with serial 'LKG-A'"):
        find_calibration([WRAPPED, {**OTHER, "serial": "LKG-A"}], "here", "LKG-A")
    with pytest.raises(InputError, match="serial 'LKG-A'; it has the whole"):
        find_calibration(bare[0], "here", "LKG-A")


def test_what_holds_no_calibration_is_refused():
    itself = {}
    itself.update(again=itself, more=[itself])
    for data in ({}, [], 3, "pitch", None, {"orientation": {"pitch": 1, "yaw": 2, "roll": 3}}, itself):
        with pytest.raises(InputError, match="here: expected a Looking Glass calibration with pitch"):
            find_calibration(data, "here")


@pytest.mark.parametrize(
    "change, said",
    [
        ({"viewCone": 0}, "is 0"),
        ({"viewCone": {"value": "0.0"}}, "is 0"),
        ({"viewCone": None}, "is not given"),
        ({}, "is not given"),
    ],
)
def test_without_a_cone_the_default_is_taken_and_said(tmp_path, change, said):
    without = {key: value for key, value in FLAT.items() if key != "viewCone"}
    with pytest.warns(Assumption, match=f"cone of 40 degrees, Looking Glass calibration: viewCone {said}"):
        assert Panel.from_looking_glass({**without, **change}).cone_deg == 40
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Panel.from_looking_glass(FLAT).cone_deg == 42


def test_the_command_line_chooses_a_display_and_says_what_was_assumed(folder, capsys):
    (folder / "two.json").write_text(json.dumps(DISPLAYS["service"]))
    assert "displays: LKG-A, LKG-B; say which" in complaint(capsys, "encode s.ply -o o.png --panel two.json")
    run(capsys, "encode s.ply -o o.png --panel two.json --device-serial LKG-B")
    lens = run(capsys, "info two.json --device-serial LKG-B")
    assert f"line_number: {Panel.from_looking_glass(OTHER).line_number}" in lens
    assert json.dumps(Panel.from_looking_glass(OTHER).to_dict()) in run(capsys, "info o.png")
    for line, words in (
        ("encode s.ply -o o.png --panel p.yaml --device-serial A", "p.yaml' is none; leave it out"),
        ("info p.yaml --device-serial A", "p.yaml is none"),
        ("simulate o.png --eye 0,0,1 -o e.png --device-serial A", "--device-serial .* a --panel"),
    ):
        assert re.search(words, complaint(capsys, line))
    (folder / "cone.json").write_text(json.dumps({**FLAT, "viewCone": 0}))
    for _ in range(2):  # a warning of Python's own would come once
        said = run(capsys, "info cone.json").splitlines()[-1]
        assert said.startswith("assumed: a viewing cone of 40 degrees, cone.json: viewCone is 0; on a display")


ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_text_of_every_encoding_is_read(tmp_path, encoding):
    calibration, panel, rig = tmp_path / "visual.json", tmp_path / "panel.yaml", tmp_path / "rig.yaml"
    calibration.write_bytes(json.dumps(WRAPPED, indent=1).encode(encoding))
    read = Panel.load(calibration)
    assert read == Panel.from_looking_glass(WRAPPED)
    read.to_yaml(panel)
    fan = Rig([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], (9, 9), (2, 1), 2)
    fan.to_yaml(rig)
    for path in (panel, rig):
        path.write_bytes(path.read_text().encode(encoding))
    assert Panel.load(panel) == read and Rig.from_yaml(rig).to_dict() == fan.to_dict()


def test_what_is_no_text_is_refused_in_one_line(tmp_path):
    for name, words in (("visual.json", "is not JSON"), ("panel.yaml", "is not YAML")):
        path = tmp_path / name
        for data in (b"\xff\xfe\x00", b"\xef\xbb\xbf\xff", b"{\x00\x00\xd8", b"\x80abc"):
            path.write_bytes(data)
            with pytest.raises(InputError, match=f"{name} {words}") as caught:
                Panel.load(path)
            assert "\n" not in str(caught.value)


def test_values_out_of_range_are_told_with_their_file(tmp_path):
    calibration, panel = tmp_path / "visual.json", tmp_path / "panel.yaml"
    calibration.write_text(json.dumps({**FLAT, "viewCone": -3}))
    panel.write_text("width_px: 3\nheight_px: 2\nviews: 4\nline_number: '5'\nslant_tan: 0\n")
    for path, words in ((calibration, "panel: cone_deg must be"), (panel, "panel: line_number must be a number")):
        with pytest.raises(InputError, match=f"{path.name}: {words}"):
            Panel.load(path)
