"""Images by cameras that are no pinholes, against the oracle with each model's formula and autograd's Jacobian."""

import math
from dataclasses import replace

import pytest
import torch
from camera_oracle import oracle_image

from lightfield_gs import Cameras, Gaussians, InputError, Panel, Rig, encode, render

WIDTH, HEIGHT = 44, 36
BEND = (0.05, -0.01, 0.002, -0.0003)


MODELS = ("orthographic", "fisheye", "equirectangular")


def _cameras(model: str, dtype: torch.dtype = torch.float64) -> Cameras:
    focal = {"orthographic": 9.0, "fisheye": 14.0, "equirectangular": 9.0}[model]
    angle = math.radians(20)
    pose = torch.eye(4, dtype=dtype)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = math.sin(angle), -math.sin(angle)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 0.3], dtype=dtype)
    more = {"distortion": torch.tensor([BEND], dtype=dtype), "widest_deg": 110} if model == "fisheye" else {}
    return Cameras(
        pose[None],
        torch.tensor([[focal, focal * 1.1]], dtype=dtype),
        torch.tensor([[WIDTH / 2 + 0.7, HEIGHT / 2 - 0.4]], dtype=dtype),
        WIDTH,
        HEIGHT,
        model=model,
        **more,
    )


def _scene(count: int = 40, around: bool = True, dtype: torch.dtype = torch.float64) -> Gaussians:
    """Gaussians all round the cameras, or ahead."""
    torch.manual_seed(3)
    means = torch.nn.functional.normalize(torch.randn(count, 3, dtype=dtype), dim=1) * (1.5 + torch.rand(count, 1))
    if not around:
        means[:, 2] = means[:, 2].abs() + 1
    return Gaussians(
        means,
        torch.randn(count, 4, dtype=dtype),
        0.05 + 0.25 * torch.rand(count, 3, dtype=dtype),
        0.2 + 0.7 * torch.rand(count, dtype=dtype),
        torch.randn(count, 4, 3, dtype=dtype) * 0.4,
    )


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_images_and_gradients_are_the_oracles(model, antialiased):
    cameras, scene = _cameras(model), _scene()
    weights = torch.rand(HEIGHT, WIDTH, 3, dtype=torch.float64)
    found = []
    for draw in (
        lambda s, c: render(s, c, background=(0.3, 0.3, 0.3), antialiased=antialiased).image[0],
        lambda s, c: oracle_image(s, c, 0.3, antialiased),
    ):
        fields = {name: t.clone().requires_grad_() for name, t in scene.fields().items()}
        names = "world_to_camera", "focal_px", "principal_point_px"
        numbers = {name: getattr(cameras, name).clone().requires_grad_() for name in names}
        image = draw(Gaussians(**fields), replace(cameras, **numbers))
        (image * weights).sum().backward()
        numbers["world_to_camera"].grad[:, 3] = 0
        found.append((image.detach(), *(t.grad for t in (*fields.values(), *numbers.values()))))
    for ours, truth in zip(*found):
        torch.testing.assert_close(ours, truth, atol=1e-9, rtol=1e-7)


def test_a_fisheye_without_distortion_is_a_pinhole_near_its_axis():
    """Small Gaussians within two degrees of the axis look the same by either camera, to the square of the angle."""
    scene = _scene(30, around=False)
    flat = torch.tensor([0.02, 0.02, 1.0]).double()
    scene = Gaussians(scene.means * flat, scene.quaternions, scene.scales * 0.02, scene.opacities, scene.sh)
    focal, centre = torch.full((1, 2), 400.0).double(), torch.tensor([[20.0, 20.0]]).double()
    pose = torch.eye(4).double()[None]
    pinhole, fisheye = (
        render(scene, Cameras(pose, focal, centre, 40, 40, model=model), alpha=True, depth=True)
        for model in ("pinhole", "fisheye")
    )
    covered = pinhole.alpha > 0.2
    assert covered.any() and (pinhole.image - fisheye.image).abs().max() < 0.02
    assert (pinhole.depth - fisheye.depth)[covered].abs().max() < 0.02


def test_float32_agrees_with_float64():
    for model in MODELS:
        exact = render(_scene(), _cameras(model)).image
        single = render(_scene(dtype=torch.float64).to(torch.float32), _cameras(model)).image
        assert (exact - single).abs().max() < 1e-4


def test_an_equirectangular_image_has_no_seam():
    """A turn by 90 degrees moves the columns of a whole round by a quarter, also of Gaussians at the back."""
    pose = torch.eye(4).double()[None]
    turned = pose.clone()
    turned[0, :3, :3] = torch.tensor([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    scene, turn = _scene(60), Cameras.equirectangular
    first, second = (render(scene, turn(p, 64), alpha=True, radii=True) for p in (pose, turned))
    assert first.image.shape == (1, 32, 64, 3) and first.alpha.max() > 0.5
    torch.testing.assert_close(first.image.roll(-16, 2), second.image, atol=1e-6, rtol=0)
    torch.testing.assert_close(first.radii, second.radii, atol=1e-6, rtol=0)
    fields = {name: t.clone().requires_grad_() for name, t in scene.fields().items()}
    render(Gaussians(**fields), turn(pose, 64)).image.square().sum().backward()
    assert all(bool(t.grad.isfinite().all()) and t.grad.abs().max() > 0 for t in fields.values())


def test_what_does_not_go_together_is_refused():
    pose, numbers = torch.eye(4)[None], torch.full((1, 2), 20.0)
    with pytest.raises(InputError, match="model: expected one of pinhole"):
        Cameras(pose, numbers, numbers, 40, 40, model="ftheta")
    with pytest.raises(InputError, match="distortion and widest_deg are for fisheyes"):
        Cameras(pose, numbers, numbers, 40, 40, widest_deg=90)
    with pytest.raises(InputError, match="multiple of 4"):
        render(_scene().to(torch.float32), Cameras.equirectangular(pose, 42))
    panel = Panel.load("toy-8v")
    with pytest.raises(InputError, match="pinhole"):
        cameras = Cameras(pose, numbers, numbers, panel.width_px, panel.height_px, model="fisheye")
        encode(_scene().to(torch.float32), panel, Rig.frame(_scene(), panel), method="sorted", cameras=cameras)
    bent = Cameras(pose, numbers, numbers, 40, 40, model="fisheye", distortion=torch.tensor([[-0.3, 0, 0, 0.0]]))
    assert bent.widest_deg == pytest.approx(math.degrees(math.sqrt(1 / 0.9)), abs=0.2)  # 1 - 0.9 angle^2 = 0
    with pytest.raises(InputError, match="distortion has no gradients"):
        learned = torch.zeros(1, 4, requires_grad=True)
        render(_scene().to(torch.float32), replace(bent, distortion=learned, widest_deg=90))
    assert bent.select([0]).to(torch.float64).widest_deg == bent.widest_deg
