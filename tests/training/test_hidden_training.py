"""Training for hidden surfaces: compositions against renders without what is in front, and runs that are stopped."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mesh_packs import cube, write_packs
from PIL import Image

from training.hidden.compositions import CompositionOptions, Compositions
from training.hidden.config import HiddenConfig
from training.hidden.examples import make_examples
from training.hidden.train import train
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


def test_a_stopped_run_goes_on_to_the_same_weights(folders, tmp_path):
    config = HiddenConfig(
        "",
        str(folders / "meshes"),
        str(folders / "photographs"),
        ["held*"],
        leaves=0,
        steps=3,
        batch=1,
        batches=1,
        device="cpu",
        compositions=replace(OPTIONS, focal=(1.0, 1.0)),
        score_every=3,
        scored=1,
    )
    weights = train(replace(config, output_dir=str(tmp_path / "whole")))
    parts = replace(config, output_dir=str(tmp_path / "parts"), checkpoint_every=1)
    assert train(replace(parts, seconds=1e-9)) is not None  # ends after its first step
    again = train(parts)
    assert weights.read_bytes() == again.read_bytes()
