"""Merging of Gaussians, judged by moments in float64 and by images of the exact rasterizer."""

import numpy as np
import torch
from rasterizer_cases import panel, rig

from lightfield_gs import encode
from lightfield_gs.base.harmonics import rotations
from lightfield_gs.bench.scenes import benchmark_rig, sheet
from lightfield_gs.panels.panel import Panel
from lightfield_gs.scene.gaussians import map_fields
from lightfield_gs.simplification.simplify import merge_to_count


def _psnr_db(image, other):
    return float(-10 * (image - other).square().mean().log10())


def test_equal_counts_by_merging_beat_the_most_visible_and_random_ones():
    from lightfield_gs.simplification.pruning import contributions

    scene, whole = sheet(64), Panel.load("toy-8v")
    fan = benchmark_rig("sheet:64", scene, whole, None)
    exact = encode(scene, whole, fan, output="float32")
    fewer = merge_to_count(scene, whole, fan, 2048)
    kept = contributions(scene, whole, fan).argsort(descending=True)[:2048]
    random = torch.randperm(scene.count, generator=torch.Generator().manual_seed(0))[:2048]
    rivals = [map_fields(scene, lambda field, rows=rows: field[rows]) for rows in (kept, random)]
    scores = [_psnr_db(encode(one, whole, fan, output="float32"), exact) for one in (fewer, *rivals)]
    assert fewer.count == 2048 and scores[0] > max(scores[1:]) + 3


def test_a_pair_has_the_moments_of_its_mixture():
    shown = panel(width_px=160, height_px=80)
    scene = map_fields(sheet(8), lambda field: field[27:28].repeat(2, *[1] * (field.ndim - 1)))
    scene.means[1, 0] += 0.3 * scene.scales[0].min()
    scene.scales[1] *= 1.2
    merged = merge_to_count(scene, shown, rig(shown), 1)
    means = scene.means.double().numpy()
    line, place = means[1] - means[0], merged.means[0].double().numpy() - means[0]
    share = place @ line / (line @ line)
    assert 0 < share < 1 and np.allclose(place, share * line, atol=1e-5)
    axes = (rotations(scene.quaternions.double()) * scene.scales.double()[:, None]).numpy()
    parts = axes @ axes.transpose(0, 2, 1)
    expected = (1 - share) * parts[0] + share * parts[1] + share * (1 - share) * np.outer(line, line)
    found = (rotations(merged.quaternions.double()) * merged.scales.double()[:, None]).numpy()[0]
    assert np.allclose(found @ found.T, expected, atol=1e-5 * np.abs(expected).max() + 1e-8)
