"""Training on CUDA against training on the CPU: the same samples, nearly the same losses. Needs a GPU."""
import json

import pytest
import torch

from lightfield_gs import _core
from training.data.batches import make_batch
from training.distributed import join_team
from training.loop import make_planner, train
from training.train import read_config
from training.trainer import Trainer
from training_runs import losses, run_config

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

STAGES = [{"steps": 4, "image_size_px": 16, "objects": 4}, {"steps": 2, "image_size_px": 32, "objects": 2}]


def _config(folder, name, **changes):
    return read_config(["--config", str(run_config(folder, name, dropout=0.0, **({"stages": STAGES} | changes)))])


def _trained(folder, name, **changes) -> list[dict]:
    """What the log says of each step of a run in this process."""
    assert train(_config(folder, name, **changes)) == folder / name / "model.safetensors"
    return [json.loads(line) for line in losses(folder / name)]


def test_batches_are_those_of_the_cpu(small_set):
    batches = []
    for device in ("cpu", "cuda"):
        with join_team(device) as team:
            planner = make_planner(_config(small_set, "unused"), team)
            batches.append(make_batch(planner.plan(3, 9, 4, 32), planner.views))
    for expected, found in zip(*(vars(batch).values() for batch in batches)):
        assert found.is_cuda
        torch.testing.assert_close(found.cpu(), expected, atol=1e-5, rtol=1e-6)


def test_procedural_objects_are_those_of_the_cpu(small_set):
    batches = []
    for device in ("cpu", "cuda"):
        with join_team(device) as team:
            planner = make_planner(_config(small_set, "unused", procedural=1.0), team)
            batches.append(make_batch(planner.plan(3, 9, 4, 64), planner.views))
    for expected, found in zip(*(vars(batch).values() for batch in batches)):
        assert found.is_cuda
        difference = (found.cpu() - expected).abs()  # a surfel at the border of seen and unseen may fall to either side
        assert difference.mean() < 1e-4 and difference.quantile(0.99) < 1e-3


def test_a_run_takes_the_steps_of_the_cpu(small_set):
    on_cpu, on_gpu = (_trained(small_set, f"float32-{device}", device=device, bfloat16=False)
                      for device in ("cpu", "cuda"))
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


def test_a_batch_waits_for_nothing(small_set):
    """Images are resident: what goes to the device are the numbers of a plan, and the host does not wait for them."""
    with join_team("cuda") as team:
        planner = make_planner(_config(small_set, "unused"), team)
        plan = planner.plan(0, 0, 4, 32)
        torch.cuda.set_sync_debug_mode("error")
        try:
            make_batch(plan, planner.views)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert sum(value.nbytes for value in vars(plan).values() if isinstance(value, torch.Tensor)) < 20_000
