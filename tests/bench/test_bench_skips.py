"""The benchmark of what skipping saves: what it draws with and without each skip is the same picture."""

import json

import pytest
import torch
from bench_cases import arguments

from lightfield_gs import Panel
from lightfield_gs.bench import skips
from lightfield_gs.bench.pareto import Subject
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.commands import bench as command

PANEL = Panel(width_px=192, height_px=96, views=6, line_number=6.3, slant_tan=0.2, cone_deg=20)
# How far the pictures may be apart, in 1/255; the others skip what shows
MOST = {
    "culling": 0,
    "harmonics cut per Gaussian": 1,
    "reuse, nothing new": 0,
    "reuse, other colours": 0,
    "reuse, zero plane moved": 0,
    "reuse, all new": 1,
    "empty tiles": 1,
}
SPARED = {
    "nothing new": "project, order, bin, composite",
    "other colours": "no stage",
    "zero plane moved": "no stage",
    "all new": "no stage",
}


@pytest.fixture(scope="module", params=[0, 2])
def found(request) -> dict[str, skips.Skip]:
    scene = load_scene("cloud:3000", request.param)
    subject = Subject("cloud", scene, PANEL, benchmark_rig("cloud:3000", scene, PANEL, None))
    with torch.no_grad():
        return {skip.name: skip for skip in skips.skips(subject)}


def test_every_skip_draws_the_same_picture(found):
    for name, skip in found.items():
        if skip.with_it is None:
            assert skip.note.startswith("not separable") and skip.without is None
            continue
        error = (skip.with_it().to(torch.int16) - skip.without()).abs()
        assert error.max() <= MOST.get(name, 255) and error.float().mean() <= 0.02 * 255, name


def test_what_is_skipped_is_counted(found):
    for name in ("opacity cut", "early stop", "pruning of the scene"):
        assert int(found[name].counted.split()[0]) > 0, name
    assert " of " in found["lattice"].counted and found["pruning in a frame"].counted.endswith(" Gaussians")


def test_frames_spare_the_stages_that_they_say(found):
    assert {change: found[f"reuse, {change}"].counted for change in SPARED} == SPARED


def test_the_veil_leaves_no_tile_empty(found):
    assert int(found["empty tiles"].counted.split()[0]) > 0
    without = found["empty tiles"].without
    stats = {}
    without.func(*without.args, **without.keywords, stats=stats)
    assert stats["skipped"]["tiles"]["empty"] == 0


def test_rows_and_table(tmp_path, capsys):
    PANEL.to_yaml(tmp_path / "small.yaml")
    path = tmp_path / "skips.json"
    threads = torch.get_num_threads()
    assert (
        command.run(
            arguments(
                "skips",
                "--scene",
                "sheet:16,cloud:100",
                "--panel",
                str(tmp_path / "small.yaml"),
                "--cone",
                "5,20",
                "--repeats",
                "1",
                "--threads",
                "1",
                "--json",
                str(path),
            )
        )
        == 0
    )
    rows, shown = json.loads(path.read_text())["rows"], capsys.readouterr().out
    names = list(dict.fromkeys(row["skip"] for row in rows))
    assert len(rows) == 4 * len(names) == 4 * 13 and torch.get_num_threads() == threads
    for row in rows:
        assert (row["ms_with"] is None) == (row["ms_without"] is None) == row["note"].startswith("not separable: lists")
        assert row["ms_with"] is None or min(row["ms_with"], row["ms_without"]) > 0
    assert all(f"{name}: " in shown for name in names) and len(shown.splitlines()) == 2 + len(rows) + len(names)
