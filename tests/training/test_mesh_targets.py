"""Where the targets of scenes of meshes are seen from."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from mesh_packs import cube, write_packs

from training.data.plan import Augmentation, BatchPlanner
from training.data.resident import ResidentViews
from training.data.sampler import ViewSampler
from training.meshes.pack import ResidentMeshes, read_meshes
from training.meshes.scenes import MeshOptions, MeshPlan, MeshScenes


@pytest.fixture(scope="module")
def packs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("meshes") / "packs"
    write_packs(folder, {"train": [cube()]})
    return folder


def _plans(packs: Path, cone_deg: tuple[float, float], **options) -> Iterator[MeshPlan]:
    """The plans of some steps, two targets beside the source in each example."""
    meshes = MeshScenes(ResidentMeshes(read_meshes(packs)), MeshOptions(str(packs), **options), cone_deg)
    sampler = ViewSampler([], *cone_deg, targets=2, seed=0)
    planner = BatchPlanner(ResidentViews([]), sampler, Augmentation(), meshes=meshes)
    for step in range(12):
        yield planner.plan(step, 0, 32, 8).meshes


def _directions(packs: Path, cone_deg: tuple[float, float], **options) -> np.ndarray:
    """Where the targets' cameras stand on the unit sphere about the scene, y up in its own axes, [N,3]."""
    found = []
    for plan in _plans(packs, cone_deg, **options):
        first = np.unique(plan.sources.draws.view, return_index=True)[1]
        turned = plan.sources.to_camera[first, :, :3].double()
        turned /= turned.det().abs()[:, None, None] ** (1 / 3)
        cameras = plan.world_to_camera[:, 1:].double()
        middle = torch.tensor([0, 0, 1.3, 1.0], dtype=torch.float64)
        places = torch.linalg.inv(cameras)[..., :3, 3] - middle[:3]
        found.append((places @ turned).reshape(-1, 3) / 1.3)
    return torch.cat(found).numpy()


def test_targets_may_be_all_round_the_object(packs):
    """Archimedes: heights on a sphere are spread evenly."""
    places = _directions(packs, (180.0, 180.0))
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 1, atol=1e-4)
    heights = np.sort(places[:, 1])
    assert np.abs(heights - np.linspace(-1, 1, len(heights))).max() < 0.07
    assert np.abs(places.mean(0)).max() < 0.1


def test_targets_may_be_nearer_to_the_source(packs):
    angles = []
    for exponent in (1.0, 2.0):
        plans = _plans(packs, (25.0, 12.0), towards_centre=exponent)
        cameras = torch.cat([plan.world_to_camera[:, 1:] for plan in plans])
        angles.append(torch.rad2deg(torch.acos(cameras[..., 2, 2].clamp(-1, 1))).flatten())
    assert angles[1].median() < 0.7 * angles[0].median() and angles[1].max() > 0.8 * angles[0].max()
