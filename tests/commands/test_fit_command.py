"""`lightfield-gs fit` from outside."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import complaint, run
from fit_capture import write_capture
from PIL import Image

from lightfield_gs import Gaussians, cli
from lightfield_gs.commands.fit import Interrupts
from lightfield_gs.fitting.trainer import Trainer

QUICK = "--steps 40 --gaussians 180 --device cpu"


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that commands run in, with a capture, `photos`."""
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "photos", masked=True)
    return tmp_path


def test_a_capture_becomes_a_scene(desk, capsys):
    out = run(capsys, f"fit photos -o scene.ply {QUICK} --picture-every 15 --sh-degree 1")
    assert "fits 7 photographs of 48 x 32 pixels, 1 held out, on cpu: 40 steps" in out
    assert "of memory" in out and "PSNR" in out and "SSIM by 11 x 11 windows" in out
    scene = Gaussians.load("scene.ply")
    assert (scene.count, scene.sh_degree) == (180, 1)
    scores = json.loads(Path("scene.fit/scores.json").read_text())
    assert scores["step"] == 40 and scores["views"][0]["name"] == "04.png" and len(scores["history"]) == 10
    assert sorted(p.name for p in Path("scene.fit/pictures").iterdir()) == [f"{n:07d}.png" for n in (15, 30, 40)]
    assert np.asarray(Image.open("scene.fit/last.png")).shape == (32, 3 * 48, 3)


def test_a_first_look_takes_small_numbers_unless_they_are_given(desk, capsys, monkeypatch):
    asked = {}
    monkeypatch.setattr("lightfield_gs.fitting.fit.fit", lambda capture, **given: asked.update(given) or 1 / 0)
    for words, steps, count in (
        (["--quick"], 1500, 15_000),
        (["--steps", "30000", "--quick"], 30_000, 15_000),
        ([], None, 300_000),
    ):
        with pytest.raises(ZeroDivisionError):
            cli.main(["fit", "photos", "-o", "scene.ply", "--device", "cpu", *words])
        assert (asked["steps"], asked["cap_max"]) == (steps, count)
        said = capsys.readouterr().out
        assert f"{steps} steps, {count} Gaussians" in said if words else "first look" not in said


def test_which_photographs_are_held_out_is_a_choice(desk, capsys):
    Path("test.txt").write_text("# held out\n01.png\n\n06.png\n")
    assert "6 photographs" in run(capsys, f"fit photos -o a.ply {QUICK} --steps 2 --test-list test.txt")
    out = run(capsys, f"fit photos -o b.ply {QUICK} --steps 2 --test-every none --longest-px 24")
    assert "8 photographs of 24 x 16 pixels, 0 held out" in out and "SSIM" not in out
    assert not Path("b.fit/scores.json").exists()


@pytest.mark.parametrize(
    "line, words",
    [
        ("fit nowhere -o s.ply", "nowhere: no such folder"),
        ("fit photos -o s.png", "expected a name that ends in .ply"),
        ("fit photos -o s.ply --steps 0", "--steps: expected a whole number in 1.."),
        ("fit photos -o s.ply --density magic", "--density"),
        ("fit photos -o s.ply --seed 12345678901234567890", "--seed"),
        ("fit photos -o s.ply --background 2,0,0", "--background"),
        ("fit photos -o s.ply --test-list photos/transforms.json", "transforms.json"),
        ("fit photos -o s.ply --test-every 1", "--test-every"),
        ("fit photos -o s.ply --scale 0.5 --longest-px 100", "not allowed with"),
        ("fit photos -o s.ply --sfm --images photos", "--sfm"),
        ("fit photos/images -o s.ply", "photos/images: is one folder of a capture: give the folder above, "),
        (
            "fit nowhere -o s.ply --cone nonsense",
            "--cone: expected a panel, or degrees, 1..179: unknown name 'nonsense'",
        ),
        (
            "fit nowhere -o s.ply --cone 0.2",
            "--cone: expected a panel, or degrees, 1..179: cone must be 1..179, got 0.2",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(desk, capsys, line, words):
    assert words in complaint(capsys, line)
    assert not Path("s.ply").exists()


def test_without_memory_there_are_three_remedies(desk, capsys, monkeypatch):
    def full(self: Trainer, until: int) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.")

    monkeypatch.setattr(Trainer, "advance", full)
    assert cli.main(f"fit photos -o s.ply {QUICK}".split()) == 2
    error = capsys.readouterr().err
    assert error == (
        "lightfield-gs: error: out of memory; use fewer --gaussians, a smaller --scale or a lower --sh-degree\n"
    )


def test_ctrl_c_leaves_a_scene_and_the_way_to_go_on(desk, capsys, monkeypatch):
    advance = Trainer.advance

    def interrupted(self: Trainer, until: int) -> None:
        advance(self, until)
        if self.done >= 12:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Trainer, "advance", interrupted)
    line = "fit photos -o s.ply --steps 5000 --gaussians 150 --device cpu --checkpoint-every 5"
    assert cli.main(line.split()) == 130
    printed = capsys.readouterr()
    assert "stops after this step" in printed.err and "the same command goes on" in printed.out
    assert Gaussians.load("s.ply").count == 150 and Path("s.fit/checkpoint.safetensors").exists()


def test_a_second_signal_aborts(capfd):
    before = signal.getsignal(signal.SIGINT)  # ignored, where the tests run in the background
    with pytest.raises(KeyboardInterrupt), Interrupts() as interrupts:
        signal.raise_signal(signal.SIGTERM)
        assert interrupts.number == signal.SIGTERM
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == before
