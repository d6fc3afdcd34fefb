"""No image comes without its graph, no gradient without a word, where gradients are wanted."""

import copy
import pickle

import pytest
import torch
from rasterizer_cases import dense_views, panel, projected, random_scene, rig

from lightfield_gs import Cameras, Encoder, Gaussians, InputError, encode, render

PANEL = panel(width_px=20, height_px=8, views=5)


def leaves(count: int = 5) -> list[torch.Tensor]:
    return [field.requires_grad_() for field in random_scene(count, 1, seed=3).fields().values()]


def cameras(pose=None, focal=None) -> Cameras:
    poses, optics, limits = (view[0] for view in dense_views(1, 1, 16, 12))
    return Cameras(poses if pose is None else pose, optics[:, :2] if focal is None else focal, optics[:, 2:], 16, 12)


@pytest.mark.parametrize("views", ["integer", "continuous"])
def test_classic_has_gradients(views):
    def draw(*fields):
        return [encode(Gaussians(*fields), PANEL, rig(PANEL), "classic", views=views, output="float64")]

    moving = leaves()
    with torch.no_grad():
        assert torch.equal(draw(*moving)[0], draw(*(field.detach() for field in moving))[0])
    assert torch.autograd.gradcheck(projected(draw), moving, eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    "options", [dict(view_filter=1.0), dict(stats={}), dict(threads=1)], ids=lambda options: next(iter(options))
)
def test_classic_refuses_what_has_no_gradients(options):
    with pytest.raises(InputError, match=f"{next(iter(options))}= is for images without gradients"):
        encode(Gaussians(*leaves()), PANEL, rig(PANEL), "classic", output="float64", **options)


def test_what_has_no_gradients_is_refused():
    scene = Gaussians(*leaves())
    with pytest.raises(InputError, match="method 'sorted' has no gradients.*'direct'"):
        encode(scene, PANEL, rig(PANEL), "sorted", output="float64")
    encoder = Encoder(PANEL, rig(PANEL), output="float64")
    with pytest.raises(InputError, match="an Encoder has no gradients"):
        encoder(scene)
    with torch.no_grad():
        assert torch.isfinite(encoder(scene)).all()
        encode(scene, PANEL, rig(PANEL), "sorted", output="float64")
    assert Encoder(PANEL, rig(PANEL))(scene).dtype == torch.uint8  # bytes have no gradients


@pytest.mark.parametrize("options", [{}, {"features": torch.ones(5, 2).double()}, {"eps2d": 0.2}], ids=str)
def test_intrinsics_have_gradients_however_they_are_given(options):
    scene = random_scene(5, 1, seed=3)

    def draw(numbers):
        fx, fy, cx, cy = numbers
        one, none = torch.ones_like(fx), torch.zeros_like(fx)
        matrix = torch.stack([fx, none, cx, none, fy, cy, none, none, one]).view(1, 3, 3)
        return render(scene, Cameras(cameras().world_to_camera, matrix, width_px=16, height_px=12), **options).image

    numbers = torch.tensor([20.0, 21.0, 8.0, 6.5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(draw, numbers, eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("loss", [torch.sum, lambda image: image.square().sum()], ids=["linear", "square"])
def test_second_derivatives_are_refused(loss):
    for draw in (
        lambda scene: render(scene, cameras()).image,
        lambda scene: encode(scene, PANEL, rig(PANEL), output="float64"),
        lambda scene: encode(scene, PANEL, rig(PANEL), "classic", output="float64"),
    ):
        moving = leaves()
        value = loss(draw(Gaussians(*moving)))
        (gradient,) = torch.autograd.grad(value, moving[0], create_graph=True)
        penalty = gradient.square().sum()
        with pytest.raises(InputError, match="differentiable once"):
            torch.autograd.grad(penalty, moving[0], retain_graph=True, allow_unused=True)
        with pytest.raises(InputError, match="differentiable once"):
            (value + penalty).backward()


def test_forward_mode_is_refused():
    scene, (moving, *others) = random_scene(5, 1, seed=3), random_scene(5, 1, seed=3).fields().values()
    with torch.autograd.forward_ad.dual_level():
        dual = Gaussians(torch.autograd.forward_ad.make_dual(moving, torch.ones_like(moving)), *others)
        for draw in (
            lambda: render(dual, cameras()).image,
            lambda: encode(dual, PANEL, rig(PANEL), output="float64"),
            lambda: encode(dual, PANEL, rig(PANEL), "sorted", output="float64"),
            lambda: Encoder(PANEL, rig(PANEL), output="float64")(dual),
        ):
            with pytest.raises(InputError, match="no derivatives in forward mode"):
                draw()
        assert torch.isfinite(render(scene, cameras()).image).all()


def test_an_encoder_is_copied_without_the_frame_before():
    encoder, scene = Encoder(PANEL, rig(PANEL)), random_scene(5, 1, seed=3)
    image = encoder(scene)
    for other in (copy.deepcopy(encoder), pickle.loads(pickle.dumps(encoder))):
        assert torch.equal(other(scene), image)


def test_poses_are_as_exact_as_they_are_written_and_moved():
    """By hand with three decimals, and by checks of gradients, which move every number of the matrix."""
    cos, sin = 0.707, 0.707
    by_hand = torch.tensor([[[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 4], [0, 0, 0, 1]]], dtype=torch.float64)
    assert torch.isfinite(render(random_scene(5, 1, seed=3), cameras(by_hand)).image).all()
    scene, pose = random_scene(5, 1, seed=3), cameras().world_to_camera.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: render(scene, cameras(p)).image, pose, eps=1e-6, atol=1e-5, rtol=1e-4)


POSES = {
    "transpose": lambda pose: pose.mT,
    "a rotation times 2": lambda pose: torch.cat([2 * pose[:, :3], pose[:, 3:]], 1),
    "mirrored": lambda pose: pose @ torch.diag(torch.tensor([-1.0, 1, 1, 1], dtype=pose.dtype)),
    "not orthonormal.*svd": lambda pose: pose + 0.1 * torch.eye(4, dtype=pose.dtype).roll(1, 1).triu(),
    "divide the matrix by its last number": lambda pose: pose + torch.eye(4, dtype=pose.dtype)[3],
}


@pytest.mark.parametrize("words", POSES)
def test_matrices_that_are_no_poses_are_refused(words):
    pose = cameras().world_to_camera
    pose[:, :3, 3] += 0.5
    with pytest.raises(InputError, match=f"world_to_camera.0.: expected a rotation .*{words}"):
        cameras(POSES[words](pose))


def test_records_of_tensors_are_equal_to_themselves_alone():
    scene, seen, fan = random_scene(3, 1, seed=1), cameras(), rig(PANEL)
    for record, other in ((scene, scene.to(torch.float64)), (seen, cameras()), (fan, rig(PANEL))):
        assert record == record and record != other and len({record, other}) == 2


def test_colours_that_are_no_harmonics_are_named():
    fields = random_scene(4, 1, seed=1).fields() | {"sh": torch.rand(4, 3, dtype=torch.float64)}
    with pytest.raises(InputError, match=r"sh: expected shape \[4, K, 3\] .*0.28209479"):
        Gaussians(**fields).validate()
