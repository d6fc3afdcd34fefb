"""Several processes train as one does."""

import json
import os
from pathlib import Path

import pytest
import torch
from training_runs import losses, run_config, start

from lightfield_gs import InputError
from lightfield_gs.base.torchrun import see_own_gpu
from training.distributed import Team, join_team

PROGRAM = Path(__file__).with_name("train_and_list_threads.py")
# The training command; each process ends without a word in its third step.
BREAKING_OFF = """
import os
from training import loop, train
made, batches = loop.make_batch, []
def make_batch(*arguments):
    batches.append(arguments)
    return made(*arguments) if len(batches) < 3 else os._exit(1)
loop.make_batch = make_batch
train.main()
"""
# Float32 without dropout, whose masks belong to a process.
STEPS = {"bfloat16": False, "stages": [{"steps": 4, "image_size_px": 16, "objects": 4}]}
pytestmark = [pytest.mark.long_file, pytest.mark.not_sanitized]
TWO_GPUS = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")


def config_of(small_set: Path, name: str, device: str, **changes) -> Path:
    """The network after four steps, the same by one process and by two."""
    validation = {"validation": str(small_set / "set"), "validate_every": 2, "validation_objects": 1}
    # Roughness is a ratio of sums within an example.
    common = STEPS | validation | {"device": device, "loss": {"roughness": 0.02}, "checkpoint_every": 100}
    return run_config(small_set, name, dropout=0.0, **(common | changes))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=TWO_GPUS)])
def test_two_processes_take_the_steps_of_one(small_set, device):
    """torchrun with two processes against one, same samples: losses and weights but for rounding."""
    running = []
    for processes in (1, 2):
        output = small_set / f"{device}-{processes}"
        config = config_of(small_set, output.name, device)
        running.append((start(config, processes, [str(PROGRAM), f"{output}-threads"]), output))
    for processes, (process, output) in enumerate(running, 1):
        printed = process.communicate(timeout=240)[0]
        assert process.returncode == 0 and printed.count("weights:") == 1, printed
        assert printed.count('step 2: {"psnr_db"') == 1 and "steps/s" in printed  # the first process alone speaks
        assert [threads.read_text() for threads in small_set.glob(f"{output.name}-threads-*")] == [""] * processes
    alone, together = ([json.loads(line) for line in losses(output)] for _, output in running)
    assert len(alone) == len(together) == 4
    for one, two in zip(alone, together):
        assert two == pytest.approx(one, rel=1e-4 if device == "cpu" else 1e-3, abs=1e-7)
    if device == "cuda":
        return  # convolutions that add in no fixed order: Adam turns noise about zero gradients into whole steps
    one, two = (torch.load(output / "last.pt", weights_only=True) for _, output in running)
    for part in ("net", "average"):
        for name, weights in one[part].items():
            torch.testing.assert_close(two[part][name], weights, atol=1e-5, rtol=1e-4)


def test_one_process_resumes_the_checkpoint_of_two(small_set, tmp_path):
    """Two processes break off after the checkpoint of their second step; against the one of the test before."""
    program = tmp_path / "breaking_off.py"
    program.write_text(BREAKING_OFF)
    shared = config_of(small_set, "shared-run", "cpu", checkpoint_every=2)
    running = [start(shared, 2, [str(program)])]
    if not (small_set / "cpu-1/last.pt").exists():  # this test is run alone
        running.append(start(config_of(small_set, "cpu-1", "cpu")))
    printed = [process.communicate(timeout=240)[0] for process in running]
    first = losses(small_set / "shared-run")
    assert torch.load(small_set / "shared-run/last.pt", weights_only=True)["step"] == len(first) == 2, printed
    resumed = start(shared)
    assert resumed.wait(timeout=120) == 0, resumed.communicate()[0]
    alone, together = ([json.loads(line) for line in losses(small_set / name)] for name in ("cpu-1", "shared-run"))
    assert losses(small_set / "shared-run")[:2] == first and len(alone) == len(together) == 4
    for one, two in zip(alone, together):
        assert two == pytest.approx(one, rel=1e-4, abs=1e-7)


def test_a_step_is_shared_out_completely():
    parts = [range(12)[Team(torch.device("cpu"), rank, 4).split(12)] for rank in range(4)]
    assert [len(part) for part in parts] == [3, 3, 3, 3]
    assert [example for part in parts for example in part] == list(range(12))


def test_unequal_shares_are_refused():
    with pytest.raises(InputError, match="3 processes cannot share the 8 objects .* multiple of 3"):
        Team(torch.device("cpu"), 0, 3).split(8)


def test_one_process_needs_no_torchrun(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    with join_team("cpu") as team:
        assert (team.rank, team.size, team.device.type) == (0, 1, "cpu") and team.leads
        assert not torch.distributed.is_initialized()


@pytest.mark.parametrize(
    ("visible", "rank", "expected"), [(None, "1", ("1", "0")), ("4,6", "1", ("6", "0")), ("4", "1", ("4", "1"))]
)
def test_a_process_sees_its_own_gpu_alone(monkeypatch, visible, rank, expected):
    """As number 0, for the kernels that are compiled for that number; not where there are too few GPUs."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible or "")
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    for name, value in {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    see_own_gpu()
    assert (os.environ["CUDA_VISIBLE_DEVICES"], os.environ["LOCAL_RANK"]) == expected
