"""Pruning by contribution, judged by the float64 oracle and by exact images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_cases import PANELS, all_subpixels, panel, random_scene, rig

from lightfield_gs import Gaussians, InputError, Panel, Rig, cli, encode, prune, reference
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.bench.scenes import benchmark_rig, cloud
from lightfield_gs.simplification.pruning import contributions

STOP = 1e-4  # transmittance at which samples end


@pytest.mark.parametrize("name", ["default lens", "leaning the other way, BGR", "narrower than a sub-pixel"])
def test_contributions_are_the_weights_of_the_oracle(name):
    shown, scene = panel(name, width_px=40, height_px=16), random_scene(12, 1, size=0.2)
    fan, places, found = rig(shown), all_subpixels(shown), contributions(scene, shown, rig(shown))
    for k in range(scene.count):
        scene.sh = torch.full_like(scene.sh[:, :1], -0.5 / SH_CONSTANT)
        scene.sh[k] = 0.5 / SH_CONSTANT  # white, all others black: its weights are seen
        weights = reference.subpixel_colours(scene, shown, fan, *places, background=(0, 0, 0))
        assert found[k] == pytest.approx(weights.sum(), rel=1e-3, abs=0.05)


@pytest.mark.parametrize("name", PANELS)
def test_the_mean_error_is_at_most_the_cut(name):
    shown, scene = panel(name), random_scene(150, size=0.15, dtype=torch.float32)
    fan = rig(shown)
    for background in ((1.0, 1.0, 1.0), (0.0, 0.3, 0.1)):
        whole = encode(scene, shown, fan, background=background, output="float32")
        for cut in (0.003, 0.03, 0.2):
            fewer = prune(scene, shown, fan, cut)
            error = (encode(fewer, shown, fan, background=background, output="float32") - whole).abs().mean()
            assert error <= cut + STOP and fewer.count <= scene.count


def test_what_nobody_sees_goes_and_the_rest_keeps_its_order():
    scene, whole = cloud(20_000), Panel.load("65in-8k-96v")
    shown = replace(whole, width_px=1500, height_px=40)
    fan = replace(benchmark_rig("sheet:1", None, whole, 20.0), principal_point_px=(750.0, 20.0))
    unseen, fewer = prune(scene, shown, fan, 0.0), prune(scene, shown, fan, 1e-3)
    assert 0 < fewer.count < 0.9 * unseen.count < 0.5 * scene.count  # few of them are before these rows
    assert torch.equal(encode(unseen, shown, fan), encode(scene, shown, fan))
    places = [int((scene.means == mean).all(1).nonzero()) for mean in fewer.means[:50]]
    assert places == sorted(places)
    assert prune(fewer, shown, fan, 1.0).count == 0


def test_scenes_of_any_kind():
    shown, scene = panel(), random_scene(30, 2)
    with torch.inference_mode():
        inferred = Gaussians(*(t.clone() for t in scene.fields().values()))
        assert prune(inferred, shown, rig(shown), 0.0).count > 0
    assert not prune(scene, shown, rig(shown), 0.01).means.requires_grad
    assert prune(random_scene(0), shown, rig(shown), 0.5).count == 0
    with pytest.raises(InputError, match="one scene"):
        prune(Gaussians(*(t[None] for t in scene.fields().values())), shown, rig(shown), 0.5)
    for cut in (-1, 2, float("nan"), "much"):
        with pytest.raises(InputError, match="contribution_cut"):
            prune(scene, shown, rig(shown), cut)


def test_the_command_is_the_library_call(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene, shown = cloud(2000), panel(width_px=160, height_px=80)
    scene.save("scene.ply"), shown.to_yaml("panel.yaml")
    assert (
        cli.main(
            "prune scene.ply -o less.ply --panel panel.yaml --contribution-cut 0.01 --save-rig r.yaml "
            "--device cpu".split()
        )
        == 0
    )
    stored = Gaussians.load("scene.ply")
    fan = Rig.from_yaml("r.yaml")
    expected = prune(stored, shown, fan, 0.01)
    assert torch.equal(Gaussians.load("less.ply").means, expected.means) and 0 < expected.count < 2000
    assert f"{expected.count} of 2000 Gaussians" in capsys.readouterr().out
    for line, words in (
        ("prune scene.ply -o less.png", "ends in .ply"),
        ("prune no.ply -o a.ply", "no.ply"),
        ("prune scene.ply -o a.ply --contribution-cut 2", "0..1"),
        ("prune scene.ply -o a.ply --panel panel.yaml --contribution-cut 1 --save-rig a.yaml", "nothing would be left"),
    ):
        assert cli.main(line.split()) == 2 and words in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["less.ply", "panel.yaml", "r.yaml", "scene.ply"]
    assert np.allclose(fan.world_to_camera, Rig.frame(stored, shown).world_to_camera)
