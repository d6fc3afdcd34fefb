"""The parts of a training step and their times."""

import time

import pytest
import torch
from training_runs import run_config

from training import profile
from training.marks import PartTime, StepMarks

PARTS = ["batch", "network", "rasterizer", "loss", "loss backward", "rasterizer backward", "network backward", "update"]


def test_times_are_those_between_marks():
    marks = StepMarks(torch.device("cpu"))
    marks.mark("start")
    for seconds in (0.001, 0.012, 0.03):
        time.sleep(seconds)
        marks.mark("sleep")
        x = torch.ones((), requires_grad=True)
        y = 2 * x
        marks.mark_at_gradient(y, "square backward")
        (y * y).backward()
        marks.mark("double backward")
    found = marks.medians()
    assert [part.part for part in found] == ["sleep", "square backward", "double backward"]
    assert 12 <= found[0].host_ms < 30 and found[0].device_ms is None
    assert x.grad == 8  # measuring changes nothing


def test_the_table_adds_up():
    printed = profile.table([PartTime("network", 3.0, 1.0), PartTime("rasterizer", 1.0, 2.0)])
    assert printed.splitlines()[-2].split() == ["all", "4.00", "3.00"]
    assert printed.splitlines()[-1] == "rasterizer: 1.00 of 4.00 ms, 25 %"


def test_a_profile_names_all_parts_and_saves_nothing(small_set, capsys):
    config = run_config(small_set, "profiled", procedural=0.5)
    assert profile.main(["--config", str(config), "--steps", "4", "--warm-up", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:20].strip() for line in lines[1:-2]] == PARTS
    assert all(float(line.split()[-1]) > 0 for line in lines[1:-1])
    assert not (small_set / "profiled").exists()


@pytest.mark.parametrize("arguments", [["--steps", "1"], ["--warm-up", "-1"], ["--steps", "99"]])
def test_steps_that_a_run_does_not_have_are_refused(small_set, capsys, arguments):
    config = run_config(small_set, "profiled")
    assert profile.main(["--config", str(config), "--steps", "4", "--warm-up", "2", *arguments]) == 2
    assert "--steps and --warm-up: expected at least 2 and 0" in capsys.readouterr().err
