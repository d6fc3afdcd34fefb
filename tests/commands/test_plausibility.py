"""Notes on what a command can do, but was hardly asked for: panels in other units, rigs of other panels, no picture."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from command_line import PANEL, complaint, run, scene

from lightfield_gs import cli
from lightfield_gs.app.panel import implausible_units
from lightfield_gs.io.images import read_image, write_image
from lightfield_gs.panels.rig import Rig


def notes(capsys, line: str) -> list[str]:
    """Return the notes on stderr of a command that succeeds."""
    code = cli.main(line.split())
    output = capsys.readouterr()
    assert code == 0, output.err
    return output.err.splitlines()


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(slant_tan=9.46), "leans the lenses by 84 degrees; .* write its tangent, 0.166625"),
        (dict(slant_tan=-9.46), "tangent, -0.166625"),
        (dict(cone_deg=0.7), "in radians, write 40.107"),
        (dict(viewing_distance_mm=0.6), "in metres, write 600"),
        (dict(pixel_pitch_mm=190), "hardly the width of a pixel"),
    ],
)
def test_numbers_in_other_units_are_doubted(change, words):
    (doubt,) = implausible_units(replace(PANEL, **change))
    assert re.search(words, doubt)
    assert not implausible_units(PANEL) and not implausible_units(replace(PANEL, viewing_distance_mm=None))


def test_commands_doubt_the_units_of_a_panel(folder, capsys):
    replace(PANEL, cone_deg=0.5, name="odd").to_yaml("odd.yaml")
    for line in ("encode s.ply -o o.png", "prune s.ply -o l.ply", "simulate o.png --eye 0,0,600 -o e.png"):
        assert notes(capsys, f"{line} --panel odd.yaml")[0].startswith("note: panel odd: cone_deg 0.5 is hardly a cone")


@pytest.mark.parametrize("ratio", [0.5, 1, 1.5, 2])
def test_a_rig_of_a_panel_of_another_size_is_refused(folder, capsys, ratio):
    rig = Rig.frame(scene(), PANEL)
    scaled = replace(
        rig,
        focal_px=tuple(ratio * part for part in rig.focal_px),
        principal_point_px=tuple(ratio * part for part in rig.principal_point_px),
    )
    scaled.to_yaml("r.yaml")
    for line in ("encode s.ply -o o.png", "prune s.ply -o l.ply --contribution-cut 0"):
        line += " --panel p.yaml --rig r.yaml"
        if ratio == 1:
            notes(capsys, line)
        else:
            words = complaint(capsys, line)
            assert "r.yaml: its principal point" in words and "96 x 60 pixels" in words and "size_px" in words


def test_cameras_of_a_panel_of_another_size_are_doubted(folder, capsys):
    cameras = Rig.frame(scene(), PANEL).cameras(PANEL)
    for ratio in (1, 2):
        (folder / "c.json").write_text(
            json.dumps(
                {
                    "world_to_camera": cameras.world_to_camera.tolist(),
                    "focal_px": (ratio * cameras.focal_px).tolist(),
                    "principal_point_px": (ratio * cameras.principal_point_px).tolist(),
                }
            )
        )
        said = notes(capsys, "encode s.ply -o o.png --panel p.yaml --method sorted --cameras c.json")
        assert [words.split(" (")[0] for words in said] == ["note: c.json: its principal point"] * (ratio == 2)


@pytest.mark.parametrize("invert", [False, True])
def test_cameras_in_the_order_of_a_quilt_are_doubted(folder, capsys, invert):
    panel = replace(PANEL, invert_views=invert)
    panel.to_yaml("p.yaml")
    cameras = Rig.frame(scene(), panel).cameras(panel)
    for step in (1, -1):
        fields = ("world_to_camera", "focal_px", "principal_point_px")
        (folder / "c.json").write_text(json.dumps({name: getattr(cameras, name).tolist()[::step] for name in fields}))
        said = notes(capsys, "encode s.ply -o o.png --panel p.yaml --method sorted --cameras c.json")
        eye, side = ("left", "right") if invert else ("right", "left")
        assert [words.split(": depth")[0] for words in said] == (step < 0) * [
            f"note: c.json: view 0 of panel small goes to the {eye}-most eye, and camera 0 stands on the {side}"
        ]


@pytest.mark.parametrize("method", ["direct", "sorted", "classic"])
def test_a_picture_of_nothing_is_doubted(folder, capsys, method):
    away = Rig(np.diag([1.0, -1, -1, 1]), (96, 96), (48, 30), 2.0)
    away.world_to_camera[2, 3] = -5
    away.to_yaml("r.yaml")
    line = f"encode s.ply -o o.png --panel p.yaml --method {method}"
    (said,) = notes(capsys, f"{line} --rig r.yaml --background 0,0.5,1")
    assert said.startswith("note: o.png is all background: none of 60 Gaussians is within what the cameras see")
    assert (read_image("o.png") == read_image("o.png")[0, 0]).all()
    run(capsys, line)


def test_an_image_of_another_panel_is_doubted(folder, capsys):
    run(capsys, "encode s.ply -o o.png --panel p.yaml")
    replace(PANEL, phase=1.0, views=10, name="other").to_yaml("other.yaml")
    replace(PANEL, pixel_pitch_mm=0.2, name="same lens").to_yaml("same.yaml")
    line = "simulate o.png --eye 0,0,600 -o e.png --panel"
    (said,) = notes(capsys, f"{line} other.yaml")
    assert "o.png was encoded for panel small, whose views and phase differ from those of other" in said
    for panel in ("p.yaml", "same.yaml"):
        run(capsys, f"{line} {panel}")
    write_image("o.png", np.zeros((60, 96, 3), np.uint8), {"panel": "{}"})
    assert "cannot be used, nor compared" in notes(capsys, f"{line} p.yaml")[0]
