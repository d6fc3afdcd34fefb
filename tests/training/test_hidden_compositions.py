"""Scores of hidden surfaces on compositions, against renders without what is in front."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mesh_packs import cube, write_packs
from PIL import Image

from training.hidden.compositions import CompositionOptions, Compositions
from training.hidden.evaluate import main
from training.hidden.examples import make_examples
from training.meshes.pack import ResidentMeshes, read_meshes

OPTIONS = CompositionOptions(64, objects=(1.0, 0.0, 0.0), extent=(0.4, 0.6))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Packs with an object of each split, and two photographs."""
    root, random = tmp_path_factory.mktemp("hidden"), np.random.default_rng(0)
    write_packs(root / "meshes", {"train": [cube()], "val": [cube()]})
    (root / "photographs").mkdir()
    for name in ("seen.png", "held.png"):
        coarse = Image.fromarray(random.integers(0, 256, (20, 20, 3), np.uint8))
        coarse.resize((512, 512), Image.Resampling.BILINEAR).save(root / "photographs" / name)
    return root


@pytest.fixture(scope="module")
def meshes(folders):
    return ResidentMeshes(read_meshes(folders / "meshes"))


def test_behind_the_first_surface_is_what_is_seen_without_it(meshes):
    pictures = torch.randint(256, (3, 3, 512, 512), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    whole = Compositions(meshes, pictures, OPTIONS).make(np.random.default_rng(2), 3)
    without = Compositions(meshes, pictures, replace(OPTIONS, objects=(0.0, 0.0, 0.0))).make(
        np.random.default_rng(2), 3
    )
    hidden = whole.first_depth < without.first_depth
    assert 0.02 < hidden.float().mean() < 0.6
    assert torch.equal(whole.second_depth[hidden], without.first_depth[hidden])
    assert torch.allclose(whole.second.movedim(1, -1)[hidden], without.first.movedim(1, -1)[hidden], atol=1e-5)
    assert torch.equal(whole.first_depth[~hidden], without.first_depth[~hidden])


def test_the_truth_in_a_hole_is_the_second_surface(meshes):
    """Where the first one hides it, and the first one in the visible fringe."""
    pictures = torch.full((1, 3, 512, 512), 128, dtype=torch.uint8)
    composition = Compositions(meshes, pictures, OPTIONS).make(np.random.default_rng(5), 4)
    examples = make_examples(composition, np.random.default_rng(6))
    assert examples.known.any() and not (examples.known & ~examples.hole).any()
    apart = (examples.log_disparity + composition.second_depth.log())[examples.known & ~examples.fringe]
    assert apart.abs().median() < 1e-4
    outside = ~examples.hole[:, None].expand(-1, 3, -1, -1)
    assert torch.equal(examples.truth[outside], examples.image[outside])


def test_the_program_scores_both_fillings(folders, capsys):
    places = ["--meshes", str(folders / "meshes"), "--photographs", str(folders / "photographs")]
    assert main([*places, "--names", "held*", "--count", "1", "--size", "96"]) == 0
    scores, error = capsys.readouterr().out.splitlines()
    _, membrane, exemplar = scores.replace("membrane", "|").replace("exemplar", "|").split("|")
    assert 5 < float(membrane) < 60 and 5 < float(exemplar) < 60 and float(error.split()[-1]) < 0.25
    assert main([*places, "--names", "none*"]) == 2 and "that match none*" in capsys.readouterr().err
