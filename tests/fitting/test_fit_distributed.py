"""Several processes fit as one does; each of them ends when another does."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from fit_capture import write_capture
from fit_scene import first_state, known_scene, photograph_scene, psnr_db
from two_processes import printed_by_two

from lightfield_gs import cli
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.torchrun import is_first
from lightfield_gs.fitting.distributed import ALONE, Group, join_group
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer

# Most of the time goes to processes that import torch once more
pytestmark = [pytest.mark.long_file, pytest.mark.not_sanitized]
TESTS = Path(__file__).resolve().parents[1]
TWO_GPUS = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
DENSITIES = ("mcmc", "adaptive")
FITTING = f"""
import sys, torch
sys.path[:0] = {[str(TESTS), str(TESTS / "fitting")]!r}
from test_fit_distributed import DENSITIES, fitted
from lightfield_gs.fitting.distributed import join_group
from lightfield_gs import cli
torch.set_num_threads(1)
with join_group(sys.argv[2]) as (group, device):
    results = [fitted(density, group, device) for density in DENSITIES]
    if group.is_first:
        torch.save(results, sys.argv[1])
sys.exit(cli.main(sys.argv[3:]))
"""
BREAKING_OFF = """
import torch
from lightfield_gs import InputError
from lightfield_gs.fitting import distributed
with distributed.join_group("cpu") as (group, device):
    try:
        group.check_same("settings", bytes([group.rank]))
    except InputError as error:
        print(error, flush=True)
    if not group.is_first:
        raise ValueError("no photographs")
    group.sum_([torch.zeros(3)])
"""


def fitted(density: str, group: Group, device: str) -> dict[str, object]:
    """Fit with the same arguments in all processes of the group; return the first step's state and the result."""
    settings = FitSettings(
        steps=120, cap_max=200, batch_size=2, sh_degree=1, density=density, exposure=True, poses=True, dropout=0.05
    )
    scene = known_scene()
    views = photograph_scene(scene, device=device)
    trainer = Trainer(first_state(scene, settings, device=device), views, settings, group)
    trainer.advance(1)
    first = [tensor.clone() for tensor in trainer.state.values]
    trainer.advance(120)
    group.check_same("results", b"".join(t.cpu().numpy().tobytes() for t in trainer.state.values), device)
    group.check_same("tallies", trainer.statistics.seen.cpu().numpy().tobytes(), device)
    score, losses = psnr_db(trainer.state, views), trainer.counters.losses
    return {"first": first, "psnr_db": score, "losses": losses, "extra": trainer.extra}


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=TWO_GPUS)])
def test_two_processes_fit_as_one(tmp_path, device, capsys):
    """The same sums in another order: rounding at first, and what comes of it at the end. Then, by the same processes,
    the command: one scene, one voice, and a checkpoint from which one process alone goes on."""
    program, path = tmp_path / "fitting.py", tmp_path / "two.pt"
    program.write_text(FITTING)
    capture, scene = write_capture(tmp_path / "capture"), tmp_path / "scene.ply"
    options = ["fit", str(capture), "-o", str(scene), "--device", device, "--gaussians", "200", "--sh-degree", "0"]
    options += ["--steps", "20", "--views-per-step", "2"]
    codes, printed = zip(*printed_by_two(program, str(path), device, *options))
    assert codes == (0, 0), printed
    words = "".join(printed)
    assert words.count("200 Gaussians after 20 of 20 steps") == 1, printed
    assert words.count("held-out PSNR") >= 1 and words.count("goes on from") == 0
    made = scene.read_bytes()
    assert cli.main(options) == 0
    assert "20 of 20 steps done" in capsys.readouterr().out and scene.read_bytes() == made
    for density, two in zip(DENSITIES, torch.load(path, map_location=device), strict=True):
        one = fitted(density, ALONE, device)
        for alone, together in zip(one["first"], two["first"]):
            torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(two["losses"][:3], one["losses"][:3], atol=1e-5, rtol=1e-4)
        if density == "adaptive" and device == "cuda":
            # Clones depend on thresholds: such a short fit of 200 Gaussians ends 2 dB elsewhere if its first state
            # changes by 1e-7. One process on CUDA sums two images in another order than two processes do.
            continue
        assert two["psnr_db"] == pytest.approx(one["psnr_db"], abs=0.05) and one["psnr_db"] > 14
        for name, alone in one["extra"].items():
            torch.testing.assert_close(two["extra"][name], alone, atol=0.02, rtol=0.1)


def test_all_end_when_one_does(tmp_path):
    """Where they were given different settings; and where one of them fails, for whatever reason."""
    program = tmp_path / "breaking_off.py"
    program.write_text(BREAKING_OFF)
    (first, by_first), (second, by_second) = printed_by_two(program)
    assert first != 0 and second != 0
    assert all("the 2 processes were given different settings" in words for words in (by_first, by_second)), by_first
    assert "process 0 of 2: the others have ended" in by_first and "no photographs" in by_second


def test_alone_nothing_is_reduced(monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    with join_group("cpu") as (group, device):
        assert group is ALONE and device == "cpu" and is_first() and not torch.distributed.is_initialized()
        numbers = torch.tensor([1.0, 2.0])
        group.sum_([numbers]), group.max_(numbers)
        assert numbers.tolist() == [1.0, 2.0] and group.largest(7) == 7


def test_a_step_is_shared_out_completely():
    order = torch.arange(12).view(2, 6)
    parts = [Group(rank, 3).split(order) for rank in range(3)]
    assert torch.cat(parts, 1).sort(1).values.equal(order) and {s.shape for s in parts} == {(2, 2)}
    with pytest.raises(InputError, match="4 processes cannot share the 6 photographs .* multiple of 4"):
        Group(1, 4).split(order)
