"""The memory that a fit needs, and the places of its photographs and moments: they change no bit of the scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fit_capture import write_capture
from fit_scene import first_state, known_scene, photograph_scene

import lightfield_gs as lf
from lightfield_gs import InputError
from lightfield_gs.fitting import checkpoint, placement
from lightfield_gs.fitting.checkpoint import Identity
from lightfield_gs.fitting.memory import MemoryEstimate, estimate_memory
from lightfield_gs.fitting.optimizer import RawParameters
from lightfield_gs.fitting.photo_storage import ReadAhead, RowFile
from lightfield_gs.fitting.placement import Placement, Room
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.io.captures.capture import read_capture

QUICK = dict(steps=60, cap_max=200, device="cpu", test_every=4)
GB = 1_000_000_000


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_capture(tmp_path_factory.mktemp("memory") / "capture", masked=True)


def test_memory_is_that_of_the_formula():
    settings = FitSettings(cap_max=1000, sh_degree=1, batch_size=2)
    parameters, moments, gradients = 4 * 1000 * 27, 8 * 1000 * 23, 4 * 1000 * 23
    rest = parameters, moments, gradients, 2 * (450 * 1000 + 90 * 1200), parameters, moments
    assert estimate_memory(settings, "cuda", 10, 40, 30, False) == (10 * 1200 * 3, 10 * 1200 * 3, *rest)
    assert estimate_memory(settings, "cuda", 10, 40, 30, True) == (10 * 1200 * 4, 10 * 1200 * 4, *rest)
    on_cpu = estimate_memory(replace(settings, sh_degree=3, batch_size=1), "cpu", 10, 40, 30, False)
    assert sum(on_cpu[2:]) == 2 * 4 * 1000 * (63 + 118)  # copies take more than a step


def test_without_memory_for_it_a_fit_does_not_begin(capture, monkeypatch):
    monkeypatch.setattr(placement, "free_bytes", lambda device: GB)
    with pytest.raises(InputError, match="cap_max=.*scale=.*sh_degree="):
        lf.fit(capture, **{**QUICK, "cap_max": 1_000_000}, progress=False)


@pytest.mark.parametrize("batch_size", [1, 3])
def test_photographs_on_disk_make_the_same_scene(capture, tmp_path, capsys, batch_size):
    """Also in a fit that was stopped. Their files go when it ends."""
    given = {**QUICK, "batch_size": batch_size, "cone": 30.0}
    expected = lf.fit(capture, **given, progress=False)
    files: list[Path] = []

    def stop() -> bool:
        files[:] = tmp_path.rglob("*.uint8")
        return len(list(tmp_path.glob("stopped"))) == 0

    given |= {"photos_on": "disk", "folder": tmp_path}
    assert lf.fit(capture, **given, stop=stop).stopped and sorted({f.name for f in files}) == [
        "photographs.uint8",
        "weights.uint8",
    ]
    assert "decodes the photographs to files of 0 MB in" in capsys.readouterr().out
    (tmp_path / "stopped").touch()
    result = lf.fit(capture, **given, stop=stop, progress=False)
    for name, field in expected.gaussians.fields().items():
        assert torch.equal(field, result.gaussians.fields()[name]), name
    assert expected.scores == result.scores and expected.window_scores == result.window_scores
    assert len(files) == 4 and not any(file.exists() for file in files)


NEED = MemoryEstimate(photographs=10 * GB, read_ahead=0, parameters=2 * GB, moments=8 * GB, gradients=GB, work=GB)


@pytest.mark.parametrize(
    "device, free_gb, expected",  # of the device, the host, the disk
    [
        ("cuda", (80, 64, 999), ("device", "device")),
        ("cuda", (19, 64, 999), ("host", "device")),  # photographs would fill more than half of it
        ("cuda", (19, 19, 999), ("disk", "device")),
        ("cuda", (19, 19, 12), ("host", "device")),  # nor is there room for files
        ("cuda", (14, 64, 999), ("host", "host")),  # four fifths of 14 GB are less than 12
        ("cpu", (40, 40, 999), ("device", "device")),
        ("cpu", (19, 19, 999), ("disk", "device")),
    ],
)
def test_photographs_and_moments_go_where_there_is_room(device, free_gb, expected):
    room = Room(device, *(number * GB for number in free_gb), folder=Path("run/photographs"))
    chosen = Placement.choose(NEED, room, "auto", "auto")
    assert (chosen.photographs, chosen.moments) == expected
    assert len(chosen.assumptions("auto", "auto")) == ("disk" in expected) + (chosen.moments == "host")
    assert Placement.choose(NEED, room, "memory", "device").photographs in ("device", "host")


@pytest.mark.parametrize(
    "memory_gb, gaussians, moments", [(80, 10_000_000, "device"), (8, 2_200_000, "device"), (8, 4_100_000, "host")]
)
def test_three_thousand_photographs_of_12_megapixels_are_fitted(memory_gb, gaussians, moments):
    """The table of docs/scenes.md."""
    need = estimate_memory(FitSettings(cap_max=gaussians), "cuda", 3000, 4000, 3000, False)
    room = Room("cuda", memory_gb * GB, 32 * GB, 500 * GB, folder=Path("run/photographs"))
    chosen = Placement.choose(need, room, "auto", "auto")
    assert chosen.suffices and (chosen.photographs, chosen.moments) == ("disk", moments)


def test_more_than_there_is_is_refused():
    room = Room("cuda", 14 * GB, 12 * GB, 9 * GB, folder=Path("run/photographs"))
    with pytest.raises(InputError, match="photographs need 10.0 GB of disk, and run has 9.0 GB free; use a folder="):
        Placement.choose(NEED, room, "disk", "auto")
    chosen = Placement.choose(NEED, room, "auto", "auto")
    with pytest.raises(InputError, match="needs 26.0 GB of the memory of the host .* and 12.0 GB are free"):
        chosen.check(is_certain=True)
    chosen.check(is_certain=False)


@pytest.mark.parametrize("density", ["mcmc", "adaptive"])
def test_moments_stay_in_pinned_memory(density, capture, tmp_path, monkeypatch):
    """Through changes of density, sorts, more harmonics and a checkpoint. Here memory is pinned in name only."""
    pinned: list[int] = []

    def pin(tensor: torch.Tensor) -> torch.Tensor:
        kept.append(tensor.clone())
        pinned.append(id(kept[-1]))
        return kept[-1]

    kept: list[torch.Tensor] = []
    monkeypatch.setattr(torch.Tensor, "pin_memory", pin)
    monkeypatch.setattr(torch.Tensor, "is_pinned", lambda tensor: id(tensor) in pinned)
    settings = FitSettings(steps=600, cap_max=220, density=density, grow_grad2d=1e-5)
    images, identity = photograph_scene(known_scene()), Identity.make(settings, read_capture(capture), [0])
    fits = [Trainer(first_state(known_scene(), settings), images, settings) for _ in range(3)]
    for fit in fits[1:]:
        fit.state.first, fit.state.second = (
            RawParameters(*(t.pin_memory() for t in moments)) for moments in (fit.state.first, fit.state.second)
        )
    plain, hosted, resumed = fits
    plain.advance(110)
    hosted.advance(110)
    checkpoint.save(tmp_path / checkpoint.FILE, hosted, identity, [])
    checkpoint.restore(tmp_path / checkpoint.FILE, resumed, identity)
    assert hosted.state.count != 150 and hosted.state.degree == 3
    for fit in (hosted, resumed):
        for name, tensor in fit.state.tensors().items():
            assert tensor.is_pinned() == name.startswith(("first", "second")), name
            assert torch.equal(tensor, plain.state.tensors()[name]), name


def test_rows_of_a_file_are_read_in_any_order(tmp_path):
    rows = torch.arange(5 * 6, dtype=torch.uint8).view(5, 2, 3)
    file = RowFile(tmp_path / "rows.uint8", rows.shape)
    for row in (3, 0, 4, 1):
        file[row] = rows[row]
    rows[2] = 255  # was never set
    reader = ReadAhead({"file": file, "memory": rows}, pinned=False)
    order = torch.tensor([[0, 4], [2, 2], [3, 1], [0, 4], [1, 0]])
    for step in (0, 1, 2, 1, 4, 3):  # a step is repeated where the device lacked room
        taken = reader.take(order[step:])
        assert all(torch.equal(found, rows[order[step]]) for found in taken.values()) and len(taken) == 2
    assert torch.equal(file.select([3, 2]).index_select(0, torch.tensor([1, 0])), rows[[2, 3]])
    file.path.write_bytes(file.path.read_bytes()[:-1])
    assert torch.equal(file[4], rows[4])
    with pytest.raises(InputError, match="was cut off during the fit"):
        reader.take(torch.tensor([[1]]))
