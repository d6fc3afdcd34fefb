"""A fit from a capture on disk: the same bits after any stops, its messages and its refusals."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_capture import write_capture
from fit_scene import first_state, known_scene, photograph_scene
from safetensors.torch import save

import lightfield_gs as lf
from lightfield_gs import InputError
from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.fitting import checkpoint, memory, placement
from lightfield_gs.fitting.checkpoint import Identity
from lightfield_gs.fitting.settings import FORMER_NAMES, FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.captures.capture import read_capture

QUICK = dict(steps=60, cap_max=200, device="cpu", progress=False, test_every=8)
# Density changes every 2 steps from step 10 on, harmonics every 20: something is due at many of the first 60
SETTINGS = FitSettings(steps=600, cap_max=220)
KINDS = {
    "mcmc": SETTINGS,
    "adaptive": replace(SETTINGS, density="adaptive", grow_grad2d=1e-5),
    "all": replace(SETTINGS, exposure=True, poses=True, batch_size=2, background=None, antialiased=True),
}


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_capture(tmp_path_factory.mktemp("fit") / "capture")


@pytest.fixture(scope="module")
def in_one_go(capture, tmp_path_factory) -> bytes:
    """The scene's file of a fit that nothing came between."""
    path = tmp_path_factory.mktemp("fit") / "scene.ply"
    lf.fit(capture, **QUICK).save(path)
    return path.read_bytes()


def trainer(settings: FitSettings = SETTINGS) -> Trainer:
    return Trainer(first_state(known_scene(), settings), photograph_scene(known_scene()), settings)


def bits(trainer: Trainer) -> dict[str, bytes]:
    counters = {f"counters.{name}": t for name, t in trainer.counters.tensors().items() if name != "pairs"}
    tensors = {**trainer.state.tensors(), **trainer.statistics.tensors(), **counters, **trainer.extra}
    return {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_steps_do_not_depend_on_how_they_are_cut(kind):
    whole, cut = trainer(KINDS[kind]), trainer(KINDS[kind])
    whole.advance(60)
    for until in (1, 9, 10, 11, 12, 13, 20, 21, 40, 59, 60):
        cut.advance(until)
    assert whole.state.count > 150 and whole.state.degree == 2
    assert bits(cut) == bits(whole)


@pytest.mark.parametrize("kind, step", [("mcmc", 9), ("mcmc", 20), ("adaptive", 12), ("adaptive", 31), ("all", 31)])
def test_a_checkpoint_goes_on_to_the_same_bits(kind, step, capture, tmp_path):
    """Also at steps after which the density changes or harmonics are added, which must happen once."""
    settings = KINDS[kind]
    identity = Identity.make(settings, read_capture(capture), [0])
    whole, first, second = (trainer(settings) for _ in range(3))
    whole.advance(45)
    first.advance(step)
    checkpoint.save(tmp_path / "c", first, identity, [{"step": 3}])
    assert checkpoint.restore(tmp_path / "c", second, identity) == [{"step": 3}] and second.done == step
    second.advance(45)
    assert bits(second) == bits(whole)


def test_the_same_seed_gives_the_same_file(capture, in_one_go, tmp_path):
    lf.fit(capture, **QUICK).save(tmp_path / "again.ply")
    lf.fit(capture, **{**QUICK, "seed": 1}).save(tmp_path / "other.ply")
    assert (tmp_path / "again.ply").read_bytes() == in_one_go
    assert (tmp_path / "other.ply").read_bytes() != in_one_go


@pytest.mark.not_sanitized
def test_a_fit_that_was_killed_goes_on_to_the_same_file(capture, in_one_go, tmp_path):
    """By SIGKILL, some steps after a checkpoint."""
    program = f"""
import os, pathlib, lightfield_gs as lf
left = 3
def stop():
    global left
    left -= pathlib.Path({str(tmp_path / "run" / checkpoint.FILE)!r}).exists()
    left or os.kill(os.getpid(), 9)
lf.fit({str(capture)!r}, folder={str(tmp_path / "run")!r}, checkpoint_every=7, stop=stop, **{QUICK!r})
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -9
    said = checkpoint._read(tmp_path / "run" / checkpoint.FILE)[0]
    assert 7 <= said["step"] < 60 and said["step"] % 7 == 0
    lf.fit(capture, folder=tmp_path / "run", checkpoint_every=11, **QUICK).save(tmp_path / "scene.ply")
    assert (tmp_path / "scene.ply").read_bytes() == in_one_go


def test_a_fit_that_was_stopped_leaves_a_scene_and_goes_on(capture, in_one_go, tmp_path):
    calls = iter([False, False, True])
    begun = lf.fit(capture, folder=tmp_path / "run", stop=lambda: next(calls), **QUICK)
    assert begun.stopped and 3 <= begun.steps < 60 and begun.scores is not None
    done = lf.fit(capture, folder=tmp_path / "run", **QUICK)
    done.save(tmp_path / "scene.ply")
    assert not done.stopped and (tmp_path / "scene.ply").read_bytes() == in_one_go
    assert json.loads((tmp_path / "run/scores.json").read_text())["step"] == 60


def test_a_run_of_other_settings_or_of_another_capture_is_refused(capture, tmp_path):
    folder = tmp_path / "run"
    lf.fit(capture, folder=folder, **{**QUICK, "steps": 4})
    with pytest.raises(InputError, match=r"steps was 4 and is 5; .*fresh=True"):
        lf.fit(capture, folder=folder, **{**QUICK, "steps": 5})
    with pytest.raises(InputError, match="other photographs held out"):
        lf.fit(capture, folder=folder, **{**QUICK, "steps": 4, "test_every": 4})
    moved = read_capture(capture)
    moved = replace(moved, intrinsics=moved.intrinsics * 1.01)
    with pytest.raises(InputError, match="other cameras"):
        lf.fit(moved, folder=folder, **{**QUICK, "steps": 4})
    assert lf.fit(capture, folder=folder, fresh=True, **{**QUICK, "steps": 5}).steps == 5


@pytest.mark.parametrize(("photographs", "share"), [(12, 0.2), (30, 0.1), (48, 0.0), (100, 0.0)])
def test_a_checkpoint_of_the_former_default_of_dropout_is_of_the_share_that_it_stood_for(photographs, share, tmp_path):
    identity = Identity({**asdict(SETTINGS), "dropout": share}, {}, photographs)
    stored = {"settings": {**asdict(SETTINGS), "dropout": None}, "capture": {}}
    identity.check(tmp_path, stored)
    with pytest.raises(InputError, match=f"dropout was {share} and is 0.3"):
        replace(identity, settings={**asdict(SETTINGS), "dropout": 0.3}).check(tmp_path, stored)


def test_a_checkpoint_with_the_former_names_of_settings_goes_on(tmp_path):
    now = {new: old for old, new in FORMER_NAMES.items()}
    former = {now.get(name, name): value for name, value in asdict(SETTINGS).items()}
    assert former["rate_sh_dc"] == SETTINGS.sh0_lr and "sh0_lr" not in former
    identity = Identity(asdict(SETTINGS), {}, 6)
    identity.check(tmp_path, {"settings": former, "capture": {}})
    with pytest.raises(InputError, match="sh0_lr was 0.5 and is 0.0025"):
        identity.check(tmp_path, {"settings": former | {"rate_sh_dc": 0.5}, "capture": {}})


def test_a_file_that_is_no_checkpoint_is_refused(capture, tmp_path):
    path = tmp_path / checkpoint.FILE
    other = torch.zeros(1)
    for data in (
        b"nonsense",
        save({"a": other}, {"lightfield-gs fit": "{}"}),
        save({"a": other}, {"lightfield-gs fit": '{"version": 1, "settings": [], "capture": {}}'}),
        save({"a": other}, {"lightfield-gs fit": '{"version": 9}'}),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match="expected a checkpoint"):
            lf.fit(capture, folder=tmp_path, **QUICK)


def test_a_fit_that_gains_nothing_ends_early_where_asked(capture):
    still = {f"{name}_lr": 0.0 for name in ("means", "scales", "quats", "opacities", "sh0", "shN")}
    given = {**QUICK, **still, "cap_max": 150, "noise_lr": 0.0, "evaluate_every": 5}
    result = lf.fit(capture, stop_early=True, **given)
    assert result.steps == 20 and not result.stopped  # the best was the first: three after it were no better
    assert lf.fit(capture, **given).steps == 60


def test_the_scene_is_in_the_coordinates_of_the_capture(capture, tmp_path):
    result = lf.fit(capture, **{**QUICK, "steps": 2, "cap_max": 150})
    points = read_capture(capture).points
    assert np.abs(np.median(result.gaussians.means.numpy(), 0) - np.median(points, 0)).max() < 0.01
    result.save(tmp_path / "s.ply")
    header = (tmp_path / "s.ply").read_bytes()[:4000].decode(errors="replace")
    assert "property float x" in header and '"steps": 2' in header


def test_scalars_for_tensorboard_are_written_where_asked(capture, tmp_path, monkeypatch):
    given = {**QUICK, "folder": tmp_path, "steps": 3, "tensorboard": True}
    lf.fit(capture, **given)
    assert list((tmp_path / "tensorboard").glob("events.*"))
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(InputError, match=r"pip install 'lightfield-gs\[fit\]'"):
        lf.fit(capture, **given)


def test_photographs_are_reduced_until_they_fit_the_memory(capture, tmp_path, monkeypatch):
    """A fit that goes on keeps its size when memory comes free; a size that was asked for is kept."""
    free = [377_000]
    monkeypatch.setattr(placement, "free_bytes", lambda device: free[0])
    given = {**QUICK, "steps": 4, "folder": tmp_path / "run"}
    stops = iter([False, False, True])
    settings, sizes = FitSettings(cap_max=200), ((30, 20), (24, 16))
    estimates = [memory.estimate_memory(settings, "cpu", 8, *size, False) for size in sizes]
    need = [sum(estimate) - estimate.read_ahead for estimate in estimates]
    assert need[0] > 0.8 * free[0] > need[1]  # of the sizes 48, 38, 30, 24, ...
    with pytest.warns(Assumption, match="photographs are reduced to 24 pixels on the longer side: as they are, 48 x 3"):
        assert lf.fit(capture, **given, stop=lambda: next(stops)).stopped
    free[0] = 1 << 40
    with pytest.warns(Assumption, match="photographs are reduced to 24 pixels"):
        result = lf.fit(capture, **given)
    assert result.steps == 4 and not result.stopped
    free[0] = 377_000
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        lf.fit(read_capture(capture, longest_px=48), **{**given, "folder": None})
    assert not any("reduced" in str(warning.message) for warning in said)


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"step": 3}, "did you mean steps"),
        ({"antialiased": 1}, "antialiased: expected bool"),
        ({"means_lr": "fast"}, "means_lr"),
        ({"refine_every": "often"}, "refine_every"),
        ({"means_lr_decay": 0}, "means_lr_decay"),
        ({"init_scale": 0}, "init_scale"),
        ({"background": 1}, "background"),
        ({"device": "tpu"}, "device"),
        ({"photos_on": "tape"}, "photos_on: expected auto, memory, disk"),
        ({"test_names": "a.png"}, "test_names"),
        ({"checkpoint_every": 0}, "checkpoint_every"),
    ],
)
def test_what_cannot_be_is_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        lf.fit("/nowhere", **wrong)


def test_few_photographs_take_fewer_steps(tmp_path, monkeypatch, capsys):
    capture = write_capture(tmp_path / "capture")
    begun = dict(cap_max=200, device="cpu", stop=lambda: True)
    assert lf.fit(capture, **begun).settings.steps == 7000
    assert "7000 steps" in capsys.readouterr().out
    assert lf.fit(capture, **begun, steps=40).settings.steps == 40
    monkeypatch.setattr("lightfield_gs.fitting.fit.MANY_PHOTOGRAPHS", 5)
    assert lf.fit(capture, **begun).settings.steps == 30_000
