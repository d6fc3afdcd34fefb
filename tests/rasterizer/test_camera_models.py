"""Images by cameras that are no pinholes, against the oracle with each model's formula and autograd's Jacobian."""

import math

import pytest
import torch
from torch import Tensor

from lightfield_gs import Cameras, Gaussians, InputError, Panel, Rig, encode, render
from lightfield_gs.reference.blend import Eye, Projection, Samples, Scene

WIDTH, HEIGHT = 44, 36
BEND = (0.05, -0.01, 0.002, -0.0003)


def _fisheye(t: Tensor, bend: tuple[float, ...] = BEND) -> Tensor:
    """Return the plane's point [..., 2] by OpenCV's formulas, of points [..., 3]."""
    radius = torch.linalg.norm(t[..., :2], dim=-1)
    angle = torch.atan2(radius, t[..., 2])
    distance = angle * (1 + sum(k * angle ** (2 * n + 2) for n, k in enumerate(bend)))
    return t[..., :2] * (distance / radius)[..., None]


def _equirectangular(t: Tensor) -> Tensor:
    return torch.stack([torch.atan2(t[..., 0], t[..., 2]), torch.asin(t[..., 1] / torch.linalg.norm(t, dim=-1))], -1)


FORMULAS = {"orthographic": lambda t: t[..., :2], "fisheye": _fisheye, "equirectangular": _equirectangular}


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


class _Oracle(Projection):
    """The oracle before a camera of another model: its rows of spread are Jacobians by autograd times the spread."""

    def __init__(self, scene: Scene, cameras: Cameras, antialiased: bool):
        self.cameras = cameras
        eye = Eye(cameras.world_to_camera[0], cameras.intrinsics()[0], torch.zeros(4, dtype=torch.float64))
        self.formula = FORMULAS[cameras.model]
        super().__init__(scene, eye, antialiased)
        t = self.position.detach()
        ahead = cameras.model == "orthographic" or (cameras.widest_deg or 180) <= 90
        depth = t[:, 2] if ahead else t.norm(dim=1)
        seen = (depth >= 0.01) & (scene.opacities.detach() * 255 >= 1)
        if cameras.model == "fisheye":
            seen &= torch.atan2(t[:, :2].norm(dim=1), t[:, 2]) < math.radians(cameras.widest_deg)
        drawn = torch.nonzero(seen).flatten()
        self.order = drawn[torch.sort(depth[drawn], stable=True).indices]
        self.row, self.rows_reached = self._rows()

    def footprint(self, gaussian: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
        t, spread = self.position[gaussian], self.spread[:, :, gaussian]
        shape = t.shape[:-1]
        flat = t.reshape(-1, 3)
        focal, centre = self.eye.intrinsics[:2], self.eye.intrinsics[2:]
        with torch.enable_grad():
            each = (
                torch.func.vmap(torch.func.jacrev(self.formula)) if len(flat) else (lambda _: flat.new_zeros(0, 2, 3))
            )
            jacobian = each(flat).reshape(*shape, 2, 3)
        u, v = (self.formula(flat).reshape(*shape, 2) * focal + centre).unbind(-1)
        rows = torch.einsum("...ij,jk...->ik...", jacobian * focal[:, None], spread)
        return u, v, rows[0], rows[1]


def _oracle_image(scene: Gaussians, cameras: Cameras, background: float, antialiased: bool) -> Tensor:
    projection = _Oracle(Scene(*scene.fields().values()), cameras, antialiased)
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    rows, columns = y.flatten().double() + 0.5, x.flatten().double() + 0.5
    blend = projection.blend(Samples(columns, rows, torch.zeros_like(rows)))
    colours = projection.colour(blend.gaussian, torch.zeros(len(blend.gaussian), dtype=torch.float64))
    return (blend.sum(colours) + blend.transmittance[:, None] * background).view(HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("model", FORMULAS)
def test_images_and_gradients_are_the_oracles(model, antialiased):
    cameras, scene = _cameras(model), _scene()
    weights = torch.rand(HEIGHT, WIDTH, 3, dtype=torch.float64)
    found = []
    for draw in (
        lambda s, c: render(s, c, background=(0.3, 0.3, 0.3), antialiased=antialiased).image[0],
        lambda s, c: _oracle_image(s, c, 0.3, antialiased),
    ):
        fields = {name: t.clone().requires_grad_() for name, t in scene.fields().items()}
        pose = cameras.world_to_camera.clone().requires_grad_()
        image = draw(Gaussians(**fields), _with_pose(cameras, pose))
        (image * weights).sum().backward()
        found.append((image.detach(), *(t.grad for t in fields.values()), pose.grad[:, :3]))
    for ours, truth in zip(*found):
        torch.testing.assert_close(ours, truth, atol=1e-9, rtol=1e-7)


def _with_pose(cameras: Cameras, pose: Tensor) -> Cameras:
    return Cameras(
        pose,
        cameras.focal_px,
        cameras.principal_point_px,
        WIDTH,
        HEIGHT,
        model=cameras.model,
        distortion=cameras.distortion,
        widest_deg=cameras.widest_deg,
    )


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
    for model in FORMULAS:
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
    assert bent.select([0]).to(torch.float64).widest_deg == bent.widest_deg
