"""Images by rolling shutters: against the oracle of the same definition, and against rows read one by one."""

import math
from dataclasses import replace
from typing import cast

import pytest
import torch
from camera_oracle import image_of, oracle_image, pose_at
from torch import Tensor

from lightfield_gs import Cameras, Gaussians, InputError, Panel, Rig, encode, render
from lightfield_gs.reference.blend import Eye, Projection, Scene
from lightfield_gs.scene.cameras import recentre

WIDTH, HEIGHT = 40, 30


def _turned(pose: Tensor, turn: Tensor, way: Tensor) -> Tensor:
    """Return a pose after a turn (rotation vector) and a move of its translation."""
    x, y, z = turn.unbind()
    o = torch.zeros_like(x)
    rotation = torch.linalg.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o]).view(3, 3))
    top = torch.cat([rotation @ pose[:3, :3], (pose[:3, 3] + way)[:, None]], 1)
    return torch.cat([top, pose[3:]])


def _cameras(model: str, shutter: str, motion: float = 1.0) -> Cameras:
    """A camera that turns by 8 degrees and moves by a tenth of the distance while it reads an image, times `motion`."""
    focal = {"pinhole": 35.0, "fisheye": 30.0, "orthographic": 9.0}[model]
    numbers = torch.tensor([0.1, -0.05, 0.02]), torch.tensor([0.1, -0.2, 0.3])
    first = _turned(torch.eye(4).double(), *(x.double() for x in numbers))
    turn, way = torch.tensor([[0.06, -0.1, 0.07], [0.2, 0.25, 0.2]]).double() * motion
    more = {"distortion": torch.tensor([[0.05, -0.01, 0.002, 0.0]]).double()} if model == "fisheye" else {}
    return Cameras(
        first[None],
        torch.tensor([[focal, 1.1 * focal]]).double(),
        torch.tensor([[WIDTH / 2 + 0.7, HEIGHT / 2 - 0.4]]).double(),
        WIDTH,
        HEIGHT,
        model=model,
        rolling_shutter=shutter,
        world_to_camera_end=_turned(first, turn, way)[None],
        **more,
    )


def _scene(count: int = 30, size: float = 1.0) -> Gaussians:
    """Gaussians ahead, some beyond the limits of the Jacobian, with harmonics that show where the camera stands."""
    torch.manual_seed(0)
    means = torch.randn(count, 3).double() * torch.tensor([1.6, 1.3, 0.5]) + torch.tensor([0.0, 0, 4])
    scales = (0.05 + 0.2 * torch.rand(count, 3).double()) * size
    opacities = 0.3 + 0.5 * torch.rand(count).double()
    return Gaussians(means, torch.randn(count, 4).double(), scales, opacities, 0.4 * torch.randn(count, 4, 3).double())


CASES = [
    ("pinhole", "top_to_bottom", False),
    ("pinhole", "bottom_to_top", True),
    ("pinhole", "left_to_right", False),
    ("fisheye", "right_to_left", False),
    ("fisheye", "top_to_bottom", True),
    ("orthographic", "top_to_bottom", False),
]


@pytest.mark.parametrize("model, shutter, antialiased", CASES)
def test_images_and_gradients_are_the_oracles(model, shutter, antialiased):
    cameras, scene = _cameras(model, shutter), _scene()
    weights = torch.rand(HEIGHT, WIDTH, 3).double()
    found = []
    for draw in (
        lambda s, c: render(s, c, background=(0.3, 0.3, 0.3), antialiased=antialiased).image[0],
        lambda s, c: oracle_image(s, c, 0.3, antialiased),
    ):
        fields = {name: t.clone().requires_grad_() for name, t in scene.fields().items()}
        twists = torch.zeros(2, 2, 3).double().requires_grad_()  # of either pose: a turn and a move
        first, last = (
            _turned(pose[0], *twist)[None]
            for pose, twist in zip((cameras.world_to_camera, cameras.world_to_camera_end), twists)
        )
        names = "focal_px", "principal_point_px"
        optics = {name: getattr(cameras, name).clone().requires_grad_() for name in names}
        moving = replace(cameras, world_to_camera=first, world_to_camera_end=last, **optics)
        image = draw(Gaussians(**fields), moving)
        (image * weights).sum().backward()
        found.append((image.detach(), *(t.grad for t in (*fields.values(), twists, *optics.values()))))
    for ours, truth in zip(*found):
        torch.testing.assert_close(ours, truth, atol=1e-9, rtol=1e-7)


def _errors(motion: float, size: float) -> tuple[float, float]:
    """Return the error, a root of a mean square, of the native image and of a still camera's. The truth is rows that
    ordinary cameras draw, each with the pose of its time."""
    finer = 4  # so that the blur of the pixels is small beside the Gaussians
    scene, given = _scene(40, size), _cameras("pinhole", "top_to_bottom", motion)
    focal, centre = given.focal_px * finer, cast(Tensor, given.principal_point_px) * finer
    size_px = {"width_px": WIDTH * finer, "height_px": HEIGHT * finer}
    moving = replace(given, focal_px=focal, principal_point_px=centre, **size_px)
    chosen, truth = list(range(2, HEIGHT * finer, 12)), []
    for row in chosen:
        time = torch.tensor(row / (HEIGHT * finer - 1)).double()
        rotation, eye = pose_at(moving.world_to_camera[0], moving.world_to_camera_end[0], time)
        pose = torch.eye(4).double()
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
        seen = Eye(pose, moving.intrinsics()[0], moving.limits()[0, :4])
        rows = torch.tensor([row + 0.5]).double()
        truth.append(image_of(Projection(Scene(*scene.fields().values()), seen), rows, WIDTH * finer, 0.3))
    still = replace(moving, rolling_shutter="none", world_to_camera_end=None)
    drawn = [render(scene, cameras, background=(0.3, 0.3, 0.3)).image[0, chosen] for cameras in (moving, still)]
    return tuple(float((image - torch.cat(truth)).square().mean().sqrt()) for image in drawn)


def test_rows_by_cameras_of_their_own_are_the_truth():
    """What is left is the curvature of projections across a footprint: it falls with the motion, and with the square of
    the footprint. A still camera errs some eighty times as much."""
    whole, still = _errors(1.0, 1.0)
    assert whole < 4e-4 and still > 60 * whole
    assert _errors(0.5, 1.0)[0] < 0.65 * whole and _errors(0.25, 1.0)[0] < 0.36 * whole
    assert _errors(1.0, 0.5)[0] < 0.45 * whole


def test_a_still_camera_draws_what_an_ordinary_one_does():
    scene = _scene()
    for model in ("pinhole", "fisheye", "orthographic"):
        rolling = _cameras(model, "left_to_right", 0.0)
        ordinary = replace(rolling, rolling_shutter="none", world_to_camera_end=None)
        found, expected = (render(scene, c, alpha=True, depth=True, radii=True) for c in (rolling, ordinary))
        for ours, truth in zip(found, expected):
            torch.testing.assert_close(ours, truth, atol=1e-12, rtol=1e-12)


def test_the_image_depends_on_nothing_but_the_motion():
    """The same scene elsewhere, several cameras at once, in single precision, and in chunks of cameras."""
    scene, cameras = _scene(), _cameras("pinhole", "bottom_to_top")
    image = render(scene, cameras).image
    far = (30.0, -40.0, 50.0)
    moved = replace(scene, means=scene.means - torch.tensor(far).double())
    torch.testing.assert_close(render(moved, cameras.relative_to(far)).image, image, atol=1e-9, rtol=0)
    single = scene.to(torch.float32)
    assert (render(single, cameras).image - image).abs().max() < 1e-4
    away = replace(single, means=(scene.means - 1000.0).float())
    means, near = recentre(away.means, cameras.relative_to((1000.0, 1000.0, 1000.0)))
    assert means.abs().max() < 100 and near.world_to_camera_end.abs().max() < 100
    assert (render(away, cameras.relative_to((1000.0, 1000.0, 1000.0))).image - image).abs().max() < 5e-3
    both = cameras.select([0, 0])
    torch.testing.assert_close(render(scene, both).image[1:], image, atol=0, rtol=0)


def test_features_go_by_the_same_splats():
    """Features that are the channels of an image of plain colours, with the gradients of both poses."""
    scene, cameras = _scene(), _cameras("pinhole", "top_to_bottom")
    colours, found = torch.rand(scene.count, 3).double(), []
    for name in ("image", "features"):
        ends = {key: pose.clone().requires_grad_() for key, pose in cameras.ends().items()}
        drawn = render(scene, replace(cameras, **ends), background=(0.0, 0.0, 0.0), colors=colours, features=colours)
        getattr(drawn, name).square().sum().backward()
        found.append((getattr(drawn, name).detach(), *(pose.grad for pose in ends.values())))
    for ours, truth in zip(*found):
        torch.testing.assert_close(ours, truth, atol=1e-9, rtol=1e-9)
    with pytest.raises(InputError, match="got a rolling shutter"):
        render(scene, cameras, eps2d=0.1)


def test_gaussians_that_move_with_the_readout_are_not_drawn():
    """A camera that turns up by as much as it sees while it reads down sees one row all the time."""
    scene, pose = _scene(), torch.eye(4).double()
    still = Cameras(pose[None], torch.tensor([[35.0, 35.0]]).double(), torch.tensor([[20.0, 15.0]]).double(), 40, 30)
    angle = torch.tensor([2 * math.atan(15 / 35), 0, 0]).double()
    ends = [_turned(pose, sign * angle, torch.zeros(3).double())[None] for sign in (-1, 1)]
    drawn = [
        render(scene, replace(still, rolling_shutter="top_to_bottom", world_to_camera_end=end), radii=True).radii
        for end in ends
    ]
    counts = sorted(int((radii > 0).sum()) for radii in drawn)
    assert counts[0] == 0 and counts[1] > 10


def test_what_makes_no_rolling_shutter_is_refused():
    cameras = _cameras("pinhole", "top_to_bottom")
    end = cameras.world_to_camera_end
    with pytest.raises(InputError, match="expected one of none, top_to_bottom"):
        replace(cameras, rolling_shutter="down")
    with pytest.raises(InputError, match="go together, got no world_to_camera_end"):
        replace(cameras, world_to_camera_end=None)
    with pytest.raises(InputError, match="go together, got no rolling_shutter"):
        replace(cameras, rolling_shutter="none")
    with pytest.raises(InputError, match="world_to_camera_end.0.: expected a rotation"):
        replace(cameras, world_to_camera_end=2 * end)
    with pytest.raises(InputError, match="less than 90 degrees"):
        replace(cameras, world_to_camera_end=torch.diag(torch.tensor([-1.0, 1, -1, 1])).double()[None] @ end)
    with pytest.raises(InputError, match="equirectangular"):
        replace(cameras, model="equirectangular")
    panel = Panel.load("toy-8v")
    with pytest.raises(InputError, match="rolling"):
        wide = replace(cameras, width_px=panel.width_px, height_px=panel.height_px)
        encode(_scene(), panel, Rig.frame(_scene(), panel), method="sorted", cameras=wide)
