"""Several processes fit as one does; each of them ends when another does."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from fit_capture import write_capture

from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.several import ALONE, Group, is_first, joined

pytestmark = [pytest.mark.long_file, pytest.mark.not_sanitized]  # torchrun, which imports torch once more
TESTS = Path(__file__).resolve().parents[1]
TWO_GPUS = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
FITTING = f"""
import sys, torch
sys.path.insert(0, {str(TESTS)!r})
from fit_scene import first_fields, known_scene, psnr_db, views_of
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.several import joined
from lightfield_gs.fitting.trainer import Trainer
torch.set_num_threads(1)
with joined(sys.argv[3]) as (group, device):
    options = dict(exposure=True, poses=True, density=sys.argv[2])
    settings = FitSettings(steps=120, gaussians=200, views=2, sh_degree=1, **options)
    scene = known_scene()
    views = views_of(scene, device=device)
    trainer = Trainer(first_fields(scene, settings, device=device), views, settings, group)
    trainer.advance(1)
    first = [tensor.clone() for tensor in trainer.fields.values]
    trainer.advance(120)
    group.check_same("results", b"".join(t.cpu().numpy().tobytes() for t in trainer.fields.values), device)
    group.check_same("tallies", trainer.tally.seen.cpu().numpy().tobytes(), device)
    if group.is_first:
        values = first, psnr_db(trainer.fields, views), trainer.counters.losses, trainer.fields.count, trainer.extra
        torch.save(values, sys.argv[1])
"""
BREAKING_OFF = """
import sys, torch
from lightfield_gs.fitting import several
with several.joined("cpu") as (group, device):
    group.barrier()
    if sys.argv[1] == "differs":
        group.check_same("settings", bytes([group.rank]))
    if not group.is_first:
        raise ValueError("no photographs")
    group.sum_([torch.zeros(3)])
"""


def start(processes: int, program: str, *arguments: str) -> subprocess.Popen:
    command = [sys.executable]
    if processes > 1:
        command += ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    streams = dict(stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen([*command, program, *arguments], env=environment, **streams)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=TWO_GPUS)])
@pytest.mark.parametrize("density", ["mcmc", "adaptive"])
def test_two_processes_fit_as_one(tmp_path, density, device):
    """The same sums in another order: rounding at first, and what comes of it at the end."""
    program = tmp_path / "fitting.py"
    program.write_text(FITTING)
    results = [tmp_path / f"{processes}.pt" for processes in (1, 2)]
    running = [start(processes, str(program), str(path), density, device) for processes, path in enumerate(results, 1)]
    for process in running:
        printed = process.communicate(timeout=120)[0]
        assert process.returncode == 0, printed
    one, two = (torch.load(path, map_location="cpu") for path in results)
    for alone, together in zip(one[0], two[0]):
        torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(two[2][:3], one[2][:3], atol=1e-5, rtol=1e-4)
    assert two[1] == pytest.approx(one[1], abs=0.05) and one[1] > 14
    for name, alone in one[4].items():
        torch.testing.assert_close(two[4][name], alone, atol=0.02, rtol=0.1)


def test_the_command_writes_once(tmp_path):
    """Two processes of the command: one scene, one voice, and a checkpoint from which one process alone goes on."""
    capture, scene = write_capture(tmp_path / "capture"), tmp_path / "scene.ply"
    options = [str(capture), "-o", str(scene), "--device", "cpu", "--gaussians", "200", "--sh-degree", "0"]
    options += ["--steps", "20", "--views-per-step", "2"]
    process = start(2, "-m", "lightfield_gs", "fit", *options)
    printed = process.communicate(timeout=120)[0]
    assert process.returncode == 0 and printed.count("200 Gaussians after 20 of 20 steps") == 1, printed
    assert printed.count("held-out PSNR") >= 1 and printed.count("goes on from") == 0
    made = scene.read_bytes()
    process = start(1, "-m", "lightfield_gs", "fit", *options)
    assert "20 of 20 steps done" in process.communicate(timeout=120)[0] and scene.read_bytes() == made


@pytest.mark.parametrize(
    "how, said",
    [("differs", "the 2 processes were given different settings"), ("raises", "process 0 of 2: the others have ended")],
)
def test_all_end_when_one_does(tmp_path, how, said):
    program = tmp_path / "breaking_off.py"
    program.write_text(BREAKING_OFF)
    process = start(2, str(program), how)
    printed = process.communicate(timeout=60)[0]
    assert process.returncode != 0 and said in printed, printed


def test_alone_nothing_is_reduced(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    with joined("cpu") as (group, device):
        assert group is ALONE and device == "cpu" and is_first() and not torch.distributed.is_initialized()
        numbers = torch.tensor([1.0, 2.0])
        group.sum_([numbers]), group.max_(numbers), group.barrier()
        assert numbers.tolist() == [1.0, 2.0] and group.largest(7) == 7


def test_a_step_is_shared_out_completely():
    order = torch.arange(12).view(2, 6)
    shares = [Group(rank, 3).share(order) for rank in range(3)]
    assert torch.cat(shares, 1).sort(1).values.equal(order) and {s.shape for s in shares} == {(2, 2)}
    with pytest.raises(InputError, match="4 processes cannot share the 6 photographs .* multiple of 4"):
        Group(1, 4).share(order)
