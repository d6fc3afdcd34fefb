"""Merging of Gaussians, judged by moments in float64 and by images of the exact rasterizer."""

import numpy as np
import torch
from rasterizer_cases import panel, rig

from lightfield_gs import encode, simplify
from lightfield_gs.base.harmonics import rotations
from lightfield_gs.bench.scenes import benchmark_rig, sheet
from lightfield_gs.panels.panel import Panel
from lightfield_gs.simplification import merging


def _psnr_db(image, other):
    return float(-10 * (image - other).square().mean().log10())


def test_equal_counts_by_merging_beat_the_most_visible_and_random_ones():
    from lightfield_gs.simplification.pruning import contributions

    scene, whole = sheet(64), Panel.load("toy-8v")
    fan = benchmark_rig("sheet:64", scene, whole, None)
    exact = encode(scene, whole, fan, output="float32")
    fewer = simplify(scene, whole, fan, count=2048).gaussians
    kept = contributions(scene, whole, fan).argsort(descending=True)[:2048]
    random = torch.randperm(scene.count, generator=torch.Generator().manual_seed(0))[:2048]
    rivals = [scene[rows] for rows in (kept, random)]
    scores = [_psnr_db(encode(one, whole, fan, output="float32"), exact) for one in (fewer, *rivals)]
    assert fewer.count == 2048 and scores[0] > max(scores[1:]) + 3


def test_a_pair_has_the_moments_of_its_mixture():
    shown = panel(width_px=160, height_px=80)
    scene = sheet(8)[[27, 27]]
    scene.means[1, 0] += 0.3 * scene.scales[0].min()
    scene.scales[1] *= 1.2
    merged = simplify(scene, shown, rig(shown), count=1).gaussians
    means = scene.means.double().numpy()
    line, place = means[1] - means[0], merged.means[0].double().numpy() - means[0]
    share = place @ line / (line @ line)
    assert 0 < share < 1 and np.allclose(place, share * line, atol=1e-5)
    axes = (rotations(scene.quaternions.double()) * scene.scales.double()[:, None]).numpy()
    parts = axes @ axes.transpose(0, 2, 1)
    expected = (1 - share) * parts[0] + share * parts[1] + share * (1 - share) * np.outer(line, line)
    found = (rotations(merged.quaternions.double()) * merged.scales.double()[:, None]).numpy()[0]
    assert np.allclose(found @ found.T, expected, atol=1e-5 * np.abs(expected).max() + 1e-8)


def test_systems_of_eigenvectors_are_solved_some_at_a_time(monkeypatch):
    """cuSOLVER fails with half a million of them."""
    scene, whole = sheet(16), Panel.load("toy-8v")
    fan = benchmark_rig("sheet:16", scene, whole, None)
    at_once = simplify(scene, whole, fan, count=128).gaussians
    monkeypatch.setattr(merging, "_EIGENSYSTEMS", 7)
    assert all(
        map(torch.equal, simplify(scene, whole, fan, count=128).gaussians.fields().values(), at_once.fields().values())
    )


def test_the_bound_holds_and_is_used():
    """The light field is as near as was asked for, the scene is not much larger, and views between are near too."""
    scene, whole = sheet(48), Panel.load("toy-8v")
    fan = benchmark_rig("sheet:48", scene, whole, None)
    exact = encode(scene, whole, fan, output="float32")
    found = {least: simplify(scene, whole, fan, psnr_db=least) for least in (35.0, 45.0)}
    for least, small in found.items():
        assert abs(_psnr_db(encode(small.gaussians, whole, fan, output="float32"), exact) - small.psnr_db) < 0.01
        assert least <= small.psnr_db < least + 5 and small.gaussians.count < scene.count
    assert found[35.0].gaussians.count < found[45.0].gaussians.count
    between = {"views": "continuous", "output": "float32"}
    truth = encode(scene, whole, fan, **between)
    assert _psnr_db(encode(found[45.0].gaussians, whole, fan, **between), truth) > 42


def test_equal_gaussians_become_one_with_the_alpha_of_both():
    """Two equal Gaussians of opacity a cover 1 - (1 - a)^2, and no light is made or lost beyond the bound."""
    shown = panel(width_px=160, height_px=80)
    scene = sheet(8)[[27, 27]]
    scene.opacities[:] = 0.3
    merged = simplify(scene, shown, rig(shown), count=1)
    assert merged.gaussians.count == 1 and merged.psnr_db > 40
