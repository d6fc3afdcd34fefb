"""An Encoder repeats only the stages whose input has changed: its images are those of `encode` whatever has."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_cases import panel, random_scene, rig, turned_pose

from lightfield_gs import Encoder, Gaussians, InputError, encode
from lightfield_gs.encoding.encoder_frames import STAGES
from lightfield_gs.rasterizer.stats import skipped_lines

SHOWN = panel("default lens")


class Viewer:
    """An Encoder and what it is given; every frame is compared with that of `encode`."""

    def __init__(self, degree=1, count=80, output="float32", **options):
        self.scene = random_scene(count, degree, extent=1.8, dtype=getattr(torch, output))  # part is beside the panel
        self.options = dict(background=torch.tensor([0.1, 0.5, 0.9]), output=output, **options)
        self.encoder = Encoder(SHOWN, rig(SHOWN), **self.options)
        self.draw()

    def draw(self) -> set[str]:
        """The stages that were not repeated."""
        before = dict(self.encoder.stats["reused"])
        image = self.encoder(self.scene)
        assert torch.equal(image, encode(self.scene, SHOWN, self.encoder.rig, **self.options))
        image.fill_(7)  # it is the caller's
        return {stage for stage in STAGES if self.encoder.stats["reused"][stage] > before[stage]}

    def move_zero_plane(self, depth):
        self.encoder.rig = replace(self.encoder.rig, zero_depth=depth)


def with_numpy(viewer):
    viewer.scene.sh.numpy()[:, 0] *= 0.5


def past_autograd(viewer):
    viewer.scene.means.data[3] += 0.1


def nearer(viewer):
    viewer.scene.means[5, 2] -= 0.3


def other_tensors(viewer):
    viewer.scene = Gaussians(*(t.clone() for t in viewer.scene.fields().values()))


def fewer(viewer):
    viewer.scene = Gaussians(*(t[::2] for t in viewer.scene.fields().values()))


def no_harmonics(viewer):
    viewer.scene.sh = viewer.scene.sh[:, :1]


def strong_harmonics(viewer):
    viewer.scene.sh[:, 1:] *= 20


def other_background(viewer):
    viewer.options["background"][1] = 0.2


def turned(viewer):
    viewer.encoder.rig.world_to_camera = turned_pose(0.2, 0.1)


def altered_rig(viewer):
    viewer.encoder.rig.cone_deg = 25.0


ALL, UP_TO_COMPOSITE = set(STAGES), {"project", "order", "bin"}
# What is changed, and the stages that are spared then
CHANGES = [
    (with_numpy, set()),
    (strong_harmonics, set()),
    (no_harmonics, set()),
    (past_autograd, set()),
    (nearer, set()),
    (other_tensors, UP_TO_COMPOSITE),
    (fewer, set()),
    (other_background, UP_TO_COMPOSITE),
    (turned, set()),
    (altered_rig, set()),
    (lambda viewer: viewer.scene.scales.mul_(0.7), set()),
    (lambda viewer: viewer.scene.opacities.mul_(0.7), set()),
    (lambda viewer: viewer.move_zero_plane(2.2), set()),
]


@pytest.mark.parametrize("output", ["float32", "float64"])
@pytest.mark.parametrize("change, spared", CHANGES, ids=[c.__name__ for c, _ in CHANGES])
def test_only_what_a_change_reaches_is_repeated(change, spared, output):
    viewer = Viewer(output=output)
    change(viewer)
    assert viewer.draw() == spared
    viewer.draw()  # the image is copied when it is asked for again
    assert viewer.draw() == ALL and viewer.draw() == ALL


@pytest.mark.parametrize("quality", ["exact", "fast"])
def test_any_changes_in_any_order(quality):
    viewer, random = Viewer(degree=2, quality=quality), np.random.default_rng(4)
    changes = [change for change, _ in CHANGES if change not in (fewer, no_harmonics)]
    for step in range(60):
        for change in random.choice(changes, random.integers(0, 3)):
            change(viewer)
        if step % 7 == 0:
            viewer.scene.opacities.fill_(0.5)
            viewer.scene.sh.clamp_(-2, 2)
            viewer.move_zero_plane(float(random.uniform(1.4, 3)))
        viewer.draw()
    assert viewer.encoder.stats["frames"] == 61


def test_bad_values_are_refused_and_forgotten():
    viewer = Viewer()
    viewer.scene.opacities[3] = 2
    with pytest.raises(InputError, match="opacities"):
        viewer.encoder(viewer.scene)
    viewer.scene.opacities[3] = 0.5
    viewer.draw()
    with pytest.raises(InputError, match="one scene"):
        viewer.encoder(Gaussians(*(t[None] for t in viewer.scene.fields().values())))
    viewer.encoder.rig = None
    with pytest.raises(InputError, match="rig"):
        viewer.encoder(viewer.scene)


@pytest.mark.parametrize(
    "name, value",
    [("panel", panel(views=9)), ("views", "continuous"), ("output", "uint8"), ("quality", "fast"), ("versioned", True)],
)
def test_what_frames_are_kept_for_cannot_be_set(name, value):
    encoder = Viewer().encoder
    before = getattr(encoder, name)
    with pytest.raises(AttributeError):
        setattr(encoder, name, value)
    assert getattr(encoder, name) == before


def test_forgetting_draws_everything_again():
    viewer = Viewer()
    viewer.draw(), viewer.draw()
    viewer.encoder.forget()
    assert viewer.draw() == set()


def test_counters_have_lines():
    viewer = Viewer()
    viewer.draw()
    assert skipped_lines(viewer.encoder.stats, viewer.scene.count) == [
        "of 2 frames drawn without a stage anew: project 1, order 1, bin 1, composite 0"
    ]
