"""Framing and turning of scenes on a GPU: as on the CPU."""

import numpy as np
import pytest
import torch
from rasterizer_cases import random_scene
from subject_cases import PANEL, UPRIGHT, blobs, directions, floaters, joined, room, thing

from lightfield_gs import _core
from lightfield_gs.panels import framing
from lightfield_gs.panels.rig import Rig

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

SCENES = {
    "thing": thing(),
    "floaters": joined(thing(), floaters(45, 3, 20)),
    "room": joined(room(), thing(count=500)),
    "sky": joined(thing(), blobs(100 * directions(2000, 4), 5.0)),
    "shell": room(),
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("pose", [None, UPRIGHT])
def test_a_scene_is_framed_as_on_the_cpu(name, pose):
    rigs, notes = [], ([], [])
    for device, said in zip(("cpu", "cuda"), notes):
        rigs.append(Rig.frame(SCENES[name].to(device), PANEL, pose, notes=said))
    assert notes[0] == notes[1]
    assert np.allclose(rigs[0].world_to_camera, rigs[1].world_to_camera, atol=1e-3)
    assert rigs[1].focal_px == pytest.approx(rigs[0].focal_px, rel=0.01)
    assert rigs[1].zero_depth == pytest.approx(rigs[0].zero_depth, rel=0.02)


def test_the_zero_plane_of_a_given_camera_is_that_of_the_cpu():
    scene = thing((0, 0, 3))
    depths = [
        framing.focus_on_scene(Rig(UPRIGHT, (80.0, 80.0), (80.0, 40.0), 1.0), scene.to(device), PANEL).zero_depth
        for device in ("cpu", "cuda")
    ]
    assert depths[1] == pytest.approx(depths[0], rel=0.01)


def test_gaussians_are_turned_where_they_are():
    scene, rotation = random_scene(20, 3, dtype=torch.float32), (0.5, 0.5, -0.5, 0.5)
    turned = scene.to("cuda").rotated(rotation)
    for name, field in scene.rotated(rotation).fields().items():
        assert turned.fields()[name].is_cuda
        torch.testing.assert_close(turned.fields()[name].cpu(), field)
