"""Runs that are cut off: their log and their checkpoint, and that they resume with the same numbers."""

import json
import math
import signal
import time
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from training_runs import finish, losses, run_config, start

from training.checkpoints import cut_log, load_checkpoint
from training.config import Stage, TrainingConfig

pytestmark = pytest.mark.long_file


def test_log_is_cut_at_the_resumed_step(tmp_path):
    log = tmp_path / "losses.jsonl"
    log.write_text("".join(json.dumps({"step": step}) + "\n" for step in range(5)) + '{"step": 5, "lo')
    cut_log(log, 3)
    assert [json.loads(line)["step"] for line in log.read_text().splitlines()] == [0, 1, 2]


@pytest.mark.parametrize("line", ['{"step": 5, "lo', "5", "[1]", "null", "{}", '{"step": "two"}'])
def test_log_is_cut_at_a_damaged_line(tmp_path, line):
    log = tmp_path / "losses.jsonl"
    log.write_text('{"step": 0}\n' + line + '\n{"step": 1}\n')
    cut_log(log, 3)
    assert log.read_text() == '{"step": 0}\n'


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        PermissionError(13, "Permission denied"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate"),
        torch.OutOfMemoryError("CUDA out of memory."),
    ],
)
def test_a_checkpoint_is_not_called_damaged_for_want_of_memory_or_rights(tmp_path, monkeypatch, error):
    """The message would have the user remove it."""
    monkeypatch.setattr(torch, "load", lambda *_, **__: (_ for _ in ()).throw(error))
    with pytest.raises(type(error)) as caught:
        load_checkpoint(tmp_path / "last.pt", TrainingConfig("out", ["data"], [Stage(1, 16, 1)]))
    assert caught.value is error


def _interrupt(config: Path, output: Path, number: int) -> str:
    """Start a run, signal it once a checkpoint exists and a later step is logged; returns what it printed."""
    process = start(config)
    deadline = time.monotonic() + 120
    while not ((output / "last.pt").exists() and len(losses(output)) >= 5):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()[0]
        time.sleep(0.002)
    process.send_signal(number)
    return process.communicate(timeout=120)[0]


def test_killed_run_resumes_to_the_same_losses(small_set):
    """kill -9 in the middle, resume, and compare with a run that was left alone: every digit of every step."""
    validated = {
        "validation": str(small_set / "set"),
        "validate_every": 4,
        "validation_objects": 1,
        "threads": 1,
        "procedural": 0.5,
    }
    whole, killed = (run_config(small_set, name, **validated) for name in ("whole", "killed"))
    finish(whole)
    _interrupt(killed, small_set / "killed", signal.SIGKILL)
    assert len(losses(small_set / "killed")) < 12
    finish(killed)
    assert losses(small_set / "killed") == losses(small_set / "whole")
    assert len(losses(small_set / "whole")) == 12
    scores = [(small_set / name / "scores.jsonl").read_text().splitlines() for name in ("killed", "whole")]
    assert scores[0] == scores[1] and [json.loads(line)["step"] for line in scores[1]] == [4, 8, 12]
    assert all(math.isfinite(json.loads(line)["loss"]) for line in losses(small_set / "whole"))
    weights = [load_file(small_set / name / "model.safetensors") for name in ("killed", "whole")]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[1])
    assert list((small_set / "whole/tensorboard").iterdir())


def test_a_run_by_the_clock_ends_with_scores_also_when_it_was_stopped(small_set):
    """The time before a stop counts: the second stage comes and the run ends after the time of both starts."""
    stages = [{"minutes": minutes, "image_size_px": size, "objects": 2} for minutes, size in ((0.05, 16), (0.03, 32))]
    config = run_config(small_set, "timed", stages=stages, validation=str(small_set / "set"), validation_objects=1)
    _interrupt(config, small_set / "timed", signal.SIGTERM)
    first = losses(small_set / "timed")
    seconds = torch.load(small_set / "timed/last.pt", weights_only=True)["seconds"]
    assert 0 < seconds < 4.5
    finish(config)
    lines = losses(small_set / "timed")
    rates = [json.loads(line)["learning_rate"] for line in lines]
    assert lines[: len(first)] == first and rates[-1] < 0.1 * max(rates)
    (scores,) = (small_set / "timed/scores.jsonl").read_text().splitlines()
    assert json.loads(scores)["step"] == len(lines)
    assert (small_set / "timed/stage-1.safetensors").exists()
    assert torch.load(small_set / "timed/last.pt", weights_only=True)["seconds"] >= 4.8


def test_scores_that_a_run_owes_are_taken_when_it_goes_on(small_set):
    """A run killed after a checkpoint and before its scores; a line of a step that is taken again is dropped."""
    config = run_config(
        small_set, "owing", validation=str(small_set / "set"), validate_every=6, validation_objects=1, threads=1
    )
    finish(config)
    log = small_set / "owing/scores.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text(lines[0] + json.dumps({"step": 13, "psnr_db": 0}) + "\n")
    finish(config)
    assert log.read_text() == "".join(lines) and len(lines) == 2


def test_terminated_run_saves_its_last_step(small_set):
    config = run_config(small_set, "terminated", stages=[{"steps": 400, "image_size_px": 16, "objects": 2}])
    printed = _interrupt(config, small_set / "terminated", signal.SIGTERM)
    assert "run the same command to resume" in printed
    state = torch.load(small_set / "terminated/last.pt", weights_only=True)
    assert state["step"] == len(losses(small_set / "terminated"))
    process = start(run_config(small_set, "terminated", seed=1))
    message = process.communicate(timeout=120)[0]
    assert process.returncode == 2 and "another configuration (seed, stages differ)" in message
    (small_set / "terminated/last.pt").write_bytes(b"damaged")
    process = start(config)
    message = process.communicate(timeout=120)[0]
    assert process.returncode == 2 and "damaged checkpoint" in message and "Traceback" not in message
