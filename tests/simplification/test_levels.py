"""Levels of detail: written as streamed SOG, read back, and chosen by what a panel shows."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_cases import rig

from lightfield_gs import InputError, Panel, cli, encode, read_scene
from lightfield_gs.app.levels import read_levelled
from lightfield_gs.bench.scenes import benchmark_rig, sheet
from lightfield_gs.io.scenes import sog_writing
from lightfield_gs.io.scenes.streamed_sog import StreamedSog
from lightfield_gs.panels.look import Look
from lightfield_gs.scene.gaussians import Gaussians, from_tensors
from lightfield_gs.simplification import levels as module
from lightfield_gs.simplification.level_choice import are_seen

COUNTS = [2304, 1152, 576]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A sheet in chunks of 300 and three levels: the scene, and its folder."""
    scene, folder = sheet(48), tmp_path_factory.mktemp("levels") / "sheet"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "CHUNK", 300)
        assert module.write_levels(scene, folder / "lod-meta.json", 3, ["Vertical Axis: z"]) == COUNTS
    return scene, folder


def _psnr_db(image, other):
    return float(-10 * (image - other).square().mean().log10())


def test_the_index_is_what_other_readers_expect(written):
    scene, folder = written
    meta = json.loads((folder / "lod-meta.json").read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == 3 and meta["counts"] == COUNTS and meta["count"] == sum(COUNTS)
    nodes, leaves = [meta["tree"]], []
    while nodes:
        node = nodes.pop()
        leaves += [node] if "lods" in node else []
        for child in node.get("children", []):
            nodes.append(child)
            assert all(a <= b for a, b in zip(node["bound"]["min"], child["bound"]["min"]))
            assert all(a >= b for a, b in zip(node["bound"]["max"], child["bound"]["max"]))
    assert len(leaves) == 8 and all(leaf["lods"]["0"]["count"] <= 300 for leaf in leaves)
    for level in range(3):
        taken = sorted((leaf["lods"][str(level)] for leaf in leaves), key=lambda part: (part["file"], part["offset"]))
        files = {part["file"]: 0 for part in taken}
        for part in taken:  # ranges follow one another without gaps
            assert part["offset"] == files[part["file"]]
            files[part["file"]] += part["count"]
        for file, count in files.items():
            assert json.loads((folder / meta["filenames"][file]).read_text())["count"] == count


def test_the_finest_level_is_the_scene_as_exactly_as_a_sog_holds_it(written):
    scene, folder = written
    read = read_scene(folder, lod=0)
    found = read.gaussians
    assert read.comments == ("Vertical Axis: z",)
    near = torch.cdist(scene.means.double(), found.means.double()).min(1)
    assert float(near.values.max()) < 1e-3 * float(scene.means.abs().max())
    whole = Panel.load("toy-8v")
    fan = benchmark_rig("sheet:48", scene, whole, None)
    assert _psnr_db(encode(found, whole, fan, output="float32"), encode(scene, whole, fan, output="float32")) > 45
    counts = [read_scene(folder, lod=level).gaussians.count for level in range(3)]
    assert counts == COUNTS


def test_the_chosen_levels_keep_the_picture_and_follow_the_distance(written):
    _, folder = written
    whole, levelled = Panel.load("toy-8v"), read_levelled(folder, False)
    finest = read_scene(folder, lod=0).gaussians
    fan, counts = benchmark_rig("sheet:48", finest, whole, None), []
    for zoom in (4.0, 1.0, 0.1):
        near = Look(zoom=zoom).applied(fan, whole, finest)
        chosen, words = levelled.choose(whole, [near])
        counts.append(chosen.count)
        images = [encode(one, whole, near, output="float32") for one in (chosen, finest)]
        assert torch.equal(*images) or _psnr_db(*images) >= 45
        assert words.startswith(f"levels of detail: {chosen.count} of {COUNTS[0]} Gaussians, in ")
    assert counts[2] < counts[1] and counts[0] < finest.count  # far away coarse levels do, near by few chunks are seen


def test_chunks_that_no_camera_sees_are_left_out(written):
    """A box counts as seen wherever the projection of one of its points, for one camera, is on the panel."""
    _, folder = written
    whole, streamed = Panel.load("toy-8v"), StreamedSog(folder)
    fan = replace(
        rig(whole), world_to_camera=benchmark_rig("sheet:48", read_scene(folder).gaussians, whole, None).world_to_camera
    )
    fan = replace(fan, focal_px=(4000.0, 4000.0), principal_point_px=(240.0, 120.0))
    found = are_seen(streamed.leaves, whole, fan)
    r = np.random.default_rng(0)
    for leaf, is_seen in zip(streamed.leaves, found):
        points = leaf.bound[0] + r.random((20_000, 3)) * (leaf.bound[1] - leaf.bound[0])
        x, y, z = (points @ fan.world_to_camera[:3, :3].T + fan.world_to_camera[:3, 3]).T
        v = fan.focal_px[1] * y / z + 120
        for s in np.linspace(*fan.offset_range(whole), 5):
            u = fan.focal_px[0] * ((x - s) / z + s / fan.zero_depth) + 240
            if ((z > 0.01) & (u >= 0) & (u <= whole.width_px) & (v >= 0) & (v <= whole.height_px)).any():
                assert is_seen
    assert 0 < found.sum() < len(found)


def test_a_sog_folder_is_read_back_within_its_steps(tmp_path):
    r = torch.Generator().manual_seed(3)
    scene = Gaussians(
        10 * torch.randn(3000, 3, generator=r),
        torch.randn(3000, 4, generator=r),
        torch.exp(torch.randn(3000, 3, generator=r)),
        torch.rand(3000, generator=r),
        torch.randn(3000, 4, 3, generator=r),
    )
    sog_writing.write_folder(tmp_path, {name: field.numpy() for name, field in scene.fields().items()}, True)
    read = read_scene(tmp_path)
    found = read.gaussians
    logs = [one.means.sign() * one.means.abs().log1p() for one in (scene, found)]
    assert float((logs[0] - logs[1]).abs().max()) < 8 / 65535
    turns = [one.quaternions / one.quaternions.norm(dim=1, keepdim=True) for one in (scene, found)]
    assert float((turns[0] * turns[1]).sum(1).abs().min()) > 0.9999
    assert float((scene.scales.log() - found.scales.log()).abs().max()) < 0.1
    assert float((scene.opacities - found.opacities).abs().max()) < 0.51 / 255
    assert float((scene.sh[:, 0] - found.sh[:, 0]).abs().max()) < 0.1
    error = (scene.sh[:, 1:] - found.sh[:, 1:]).square().mean()
    assert float(error) < 0.6 and read.comments  # 1024 entries for 3000 random points of nine dimensions
    few = from_tensors(field[:500] for field in scene.fields().values())
    own = tmp_path / "few"
    own.mkdir()
    sog_writing.write_folder(own, {name: field.numpy() for name, field in few.fields().items()})
    assert float((read_scene(own).gaussians.sh[:, 1:] - few.sh[:, 1:]).abs().max()) < 0.1


def test_the_command_writes_levels_with_the_framing_and_refuses_mixtures(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sheet(24).save("scene.ply")
    line = "simplify scene.ply -o out/lod-meta.json --levels 2 --panel toy-8v --device cpu"
    assert cli.main(line.split()) == 0
    assert "levels of 576, 288 Gaussians" in capsys.readouterr().out
    assert [path.name for path in sorted((tmp_path / "out").iterdir())] == ["0_0", "1_0", "lod-meta.json"]
    assert cli.main("encode out -o a.png --panel toy-8v --device cpu".split()) == 0
    told = capsys.readouterr().out
    assert "the framing stored in the file" in told and "levels of detail: " in told
    for words, reason in (
        (line, "exists: remove it"),
        (line.replace("out/", "new/") + " --psnr 40", "--psnr"),
        ("simplify scene.ply -o a.ply --levels 3", "FOLDER/lod-meta.json"),
    ):
        assert cli.main(words.split()) == 2 and reason in capsys.readouterr().err
    with pytest.raises(InputError, match="exists"):
        module.write_levels(sheet(8), tmp_path / "out/lod-meta.json")
