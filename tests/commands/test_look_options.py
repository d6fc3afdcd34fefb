"""Depth, size and place of a scene, by options of the commands that draw one."""

import json
import re

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run

from lightfield_gs import Look, cli, depth_report
from lightfield_gs.base.cli_messages import as_options
from lightfield_gs.io.images import read_info
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

OPTIONS = "--focus 0.4,0.6 --depth-amount 0.5 --cone 20 --zoom 1.2 --pan -0.1,0.05"


def expected_rig() -> Rig:
    gaussians = Gaussians.load("s.ply")
    look = Look(focus=(0.4, 0.6), depth_amount=0.5, cone_deg=20, zoom=1.2, pan=(-0.1, 0.05))
    return look.applied(Rig.frame(gaussians, PANEL), PANEL, gaussians)


def test_encode_looks_so_and_everything_it_writes_says_so(folder, capsys):
    assert (
        cli.main(f"encode s.ply -o o.png --panel p.yaml {OPTIONS} --save-rig r.yaml --save-gaussians g.ply".split())
        == 0
    )
    out = capsys.readouterr().out
    rig = expected_rig()
    assert (
        f"look: depth {rig.zero_depth:.5g} in the panel's plane, a cone of {rig.cone_deg:.4g} degrees, 1.2 times" in out
    )
    assert Rig.from_yaml("r.yaml").to_dict() == rig.to_dict()
    assert json.loads(read_info("o.png").metadata["rig"]) == rig.to_dict()
    for again in ("encode s.ply --rig r.yaml", "encode g.ply"):
        run(capsys, f"{again} -o again.png --panel p.yaml")
        assert json.loads(read_info("again.png").metadata["rig"]) == rig.to_dict()


def test_prune_looks_so(folder, capsys):
    run(capsys, f"prune s.ply -o kept.ply --panel p.yaml {OPTIONS} --save-rig r.yaml")
    assert Rig.from_yaml("r.yaml").to_dict() == expected_rig().to_dict()


def test_a_flat_rig_can_be_stored(folder, capsys):
    run(capsys, "encode s.ply -o o.png --panel p.yaml --depth-amount 0 --save-rig r.yaml")  # nothing to note
    assert Rig.from_yaml("r.yaml").cone_deg == 0
    run(capsys, "encode s.ply -o again.png --panel p.yaml --rig r.yaml")
    assert (folder / "o.png").read_bytes() == (folder / "again.png").read_bytes()


@pytest.mark.parametrize(
    "options, words",
    [
        ("--focus 0.02,0.02", "focus: nothing opaque is at 0.02,0.02 of the picture"),
        ("--focus 0.5,1.2", "argument --focus: expected a point X,Y of the picture, 0..1 each, got '0.5,1.2'"),
        ("--focus -1", "argument --focus: expected "),
        ("--depth-amount 3", "argument --depth-amount: expected 0..2, got '3'"),
        ("--cone 180", "argument --cone: expected 0..179 degrees"),
        ("--zoom 0", "argument --zoom: expected 0.01..100"),
        ("--pan -0.1", "argument --pan: expected 2 numbers"),
        ("--pan 0,11", "argument --pan: expected fractions of the panel's width and height, -10..10"),
        ("--zoom 2 --method sorted --cameras c.json", "--zoom is about a rig, and --cameras takes its place"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(folder, capsys, options, words):
    assert words in complaint(capsys, f"encode s.ply -o o.png --panel p.yaml {options}")
    assert not (folder / "o.png").exists()


def test_the_depth_report_is_that_of_the_library(folder, capsys):
    code = cli.main("encode s.ply -o o.png --panel p.yaml --depth-report".split())
    output = capsys.readouterr()
    gaussians = Gaussians.load("s.ply")
    report = depth_report(gaussians, PANEL, Rig.frame(gaussians, PANEL))
    assert code == 0 and output.out.splitlines()[-7:-1] == report.lines()
    # A cloud of scattered Gaussians has gaps all over
    assert output.err.splitlines() == [f"note: {as_options(words)}" for words in report.warnings()] and output.err


def test_what_was_steered_gets_notes_unasked(folder, capsys):
    sheet = Gaussians(
        torch.cartesian_prod(torch.linspace(-1, 1, 40), torch.linspace(-0.6, 0.6, 24), torch.tensor([3.0])),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(960, 1),
        torch.full((960, 3), 0.04),
        torch.full((960,), 0.99),
        torch.zeros(960, 1, 3),
    )
    sheet.save("sheet.ply")
    Rig(np.eye(4), (90.0, 90.0), (48.0, 30.0), 3.0).to_yaml("r.yaml")
    assert "look" not in run(capsys, "encode sheet.ply -o o.png --panel p.yaml --rig r.yaml")
    # What fills the picture of the centre camera, and not those beside it, is noted in any case
    Rig(np.eye(4), (180.0, 180.0), (48.0, 30.0), 1.5).to_yaml("near.yaml")
    for command in ("encode sheet.ply -o o.png", "quilt sheet.ply -o q --tiles 4x3 --size 96x96"):
        assert cli.main(f"{command} --panel p.yaml --rig near.yaml".split()) == 0
        noted = capsys.readouterr().err
        assert noted.startswith("note: the outermost views look past what the scene knows: ") and noted.count("\n") == 1
    assert cli.main("encode sheet.ply -o o.png --panel p.yaml --rig r.yaml --focus 0.8 --zoom 2".split()) == 0
    assert re.match(r"note: the outermost views look past what the scene knows: ", capsys.readouterr().err)
