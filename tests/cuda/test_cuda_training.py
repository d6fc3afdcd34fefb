"""Training on CUDA against training on the CPU: the same samples, nearly the same losses. Needs a GPU."""

import json
import time

import pytest
import torch
from training_runs import losses, run_config

from lightfield_gs import _core
from training.data.batches import make_batch
from training.distributed import join_team
from training.loop import make_planner, train
from training.profile import profile
from training.train import read_config
from training.trainer import Trainer

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

STAGES = [{"steps": 4, "image_size_px": 16, "objects": 4}, {"steps": 2, "image_size_px": 32, "objects": 2}]


def _config(folder, name, **changes):
    return read_config(["--config", str(run_config(folder, name, dropout=0.0, **({"stages": STAGES} | changes)))])


def _trained(folder, name, **changes) -> list[dict]:
    """Return the log's rows of the steps of a run in this process."""
    assert train(_config(folder, name, **changes)) == folder / name / "model.safetensors"
    return [json.loads(line) for line in losses(folder / name)]


FAULTS = {"blur_px": 0.8, "noise": 0.02, "outline_px": 1.0}


def _batches(folder, size_px, compiled=False, **changes):
    """The fields of a batch on the CPU and, maybe compiled, on CUDA."""
    batches = []
    for device in ("cpu", "cuda"):
        with join_team(device) as team:
            planner = make_planner(_config(folder, "unused", **changes), team)
            plan = planner.plan(3, 9, 4, size_px)
            batches.append(make_batch(plan, planner.views, compiled and device == "cuda"))
    assert all(found.is_cuda for found in vars(batches[1]).values())
    return list(zip(*(vars(batch).values() for batch in batches)))


@pytest.mark.parametrize("compiled", [False, True])
def test_batches_are_those_of_the_cpu(small_set, compiled):
    for expected, found in _batches(small_set, 32, compiled, augmentation=FAULTS):
        torch.testing.assert_close(found.cpu(), expected, atol=1e-4, rtol=1e-6)


@pytest.mark.parametrize("compiled", [False, True])
def test_procedural_objects_are_those_of_the_cpu(small_set, compiled):
    for expected, found in _batches(small_set, 64, compiled, procedural=0.5):
        difference = (found.cpu() - expected).abs()  # a surfel at the border of seen and unseen may fall to either side
        assert difference.mean() < 1e-4 and difference.quantile(0.99) < 1e-3


def test_a_run_takes_the_steps_of_the_cpu(small_set):
    on_cpu, on_gpu = (
        _trained(small_set, f"float32-{device}", device=device, bfloat16=False) for device in ("cpu", "cuda")
    )
    assert len(on_gpu) == 6
    assert on_gpu[0] == pytest.approx(on_cpu[0], rel=1e-3, abs=1e-6)
    for expected, found in zip(on_cpu, on_gpu):  # Adam makes whole steps of noise about zero gradients
        assert found["loss"] == pytest.approx(expected["loss"], rel=1e-2)


def test_compiled_network_takes_the_same_steps(small_set):
    eager, compiled = (_trained(small_set, f"compiled-{flag}", device="cuda", compile=flag) for flag in (False, True))
    for expected, found in zip(eager, compiled):
        assert found["loss"] == pytest.approx(expected["loss"], rel=2e-2)


def test_resumed_trainer_goes_on_alike(small_set, tmp_path):
    """Weights, averages and the optimizer's moments come back onto the device from a file."""
    with join_team("cuda") as team:
        config = _config(small_set, "unused", device="cuda", bfloat16=False)
        planner, whole, resumed = make_planner(config, team), Trainer(config, team), Trainer(config, team)
        batches = [make_batch(planner.plan(step, 4 * step, 4, 16), planner.views) for step in range(4)]
        for batch in batches[:2]:
            whole.advance(batch)
        torch.save(whole.state(), tmp_path / "last.pt")
        resumed.restore(torch.load(tmp_path / "last.pt", map_location="cpu", weights_only=True))
        for batch in batches[2:]:
            expected, found = (trainer.advance(batch).read() for trainer in (whole, resumed))
            assert found == pytest.approx(expected, rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_batch_waits_for_nothing(small_set, compiled):
    """Images are resident: what goes to the device are the numbers of a plan, and the host does not wait for them.
    Procedural objects are there from the first step of their block on."""
    with join_team("cuda") as team:
        planner = make_planner(_config(small_set, "unused", procedural=0.25, augmentation=FAULTS), team)
        make_batch(planner.plan(0, 0, 4, 32), planner.views, compiled)
        plan = planner.plan(1, 4, 4, 32)
        torch.cuda.set_sync_debug_mode("error")
        try:
            make_batch(plan, planner.views, compiled)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert sum(value.nbytes for value in vars(plan).values() if isinstance(value, torch.Tensor)) < 20_000


def test_a_profile_times_the_device(small_set):
    """Parts of a step add up to it, with and without a compiled network; the backward's come in their order."""
    for flag in (False, True):
        stages = [{"steps": 16, "image_size_px": 32, "objects": 4}]
        began = time.perf_counter()
        parts = profile(_config(small_set, "unused", device="cuda", compile=flag, stages=stages), steps=10, warm_up=6)
        seconds = time.perf_counter() - began
        assert [part.part for part in parts] == [
            "batch",
            "network",
            "rasterizer",
            "loss",
            "loss backward",
            "rasterizer backward",
            "network backward",
            "update",
        ]
        assert all(part.device_ms > 0 and part.host_ms > 0 for part in parts)
        assert sum(part.device_ms for part in parts) < 1e3 * seconds
