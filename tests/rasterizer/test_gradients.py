"""Gradients of both sensors: against finite differences, and against autograd through the oracle."""

import pytest
import torch
from rasterizer_cases import dense_views, panel, projected, random_scene, rig, stacked

from lightfield_gs import InputError, encode, reference
from lightfield_gs.panels.rig import lenticular_camera
from lightfield_gs.scene.gaussians import Gaussians

GAUSSIANS = ("means", "quaternions", "scales", "opacities", "sh")


def leaves(tensors):
    return [tensor.detach().clone().requires_grad_() for tensor in tensors]


def background_of(*shape, dtype=torch.float64):
    return torch.rand(*shape, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)).to(dtype)


# ---- ordinary images


def dense_inputs(batch, views, count, degree, width, height, dtype=torch.float64, **scene):
    scenes = stacked([random_scene(count, degree, seed=10 + b, dtype=dtype, **scene) for b in range(batch)])
    pose, camera, limits = (view.to(dtype) for view in dense_views(batch, views, width, height))
    moving = [*scenes.fields().values(), background_of(batch, views, dtype=dtype), pose]
    return leaves(moving), (camera, limits, width, height)


def dense(*arguments):
    return torch.ops.lightfield_gs.render_images(*arguments)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_dense_gradcheck_of_every_output(degree):
    moving, fixed = dense_inputs(1, 1, 3, degree, 7, 5)
    assert torch.autograd.gradcheck(lambda *m: dense(*m, *fixed), moving, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("size", [(37, 21), (18, 50)])
def test_dense_gradcheck_over_tiles_scenes_and_cameras(size):
    moving, fixed = dense_inputs(2, 2, 5, 1, *size)
    draw = projected(lambda *m: dense(*m, *fixed), count=3)
    assert torch.autograd.gradcheck(draw, moving, eps=1e-6, atol=1e-5, rtol=1e-5)


def test_dense_gradcheck_where_the_jacobian_is_clamped():
    moving, (camera, limits, width, height) = dense_inputs(1, 2, 6, 1, 12, 9, extent=2.5, size=0.6)
    position = moving[0].detach()[0] @ moving[6].detach()[0, 0, :3, :3].T + moving[6].detach()[0, 0, :3, 3]
    slope = position[:, :2] / position[:, 2:]
    low, high = limits[0, 0, [0, 2]], limits[0, 0, [1, 3]]
    assert ((slope < low) | (slope > high)).any() and ((slope > low) & (slope < high)).any()
    draw = projected(lambda *m: dense(*m, camera, limits, width, height))
    assert torch.autograd.gradcheck(draw, moving, eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("antialiased", [False, True])
def test_dense_gradcheck_of_intrinsics_and_limits(antialiased):
    moving, (intrinsics, limits, width, height) = dense_inputs(1, 2, 6, 1, 12, 9, extent=2.5, size=0.6)
    limits = torch.cat([limits[..., :4], torch.full_like(limits[..., :1], 0.1)], -1)  # a camera of a rig
    fields = [tensor.detach() for tensor in moving]
    draw = projected(lambda *m: dense(*fields, *m, width, height, antialiased))
    assert torch.autograd.gradcheck(draw, leaves([intrinsics, limits]), eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["plain", "opaque", "dark", "clamped"])
def test_dense_gradients_are_those_of_the_oracle(kind):
    width, height = 50, 40
    scene = {"clamped": dict(extent=3.0, size=0.4)}.get(kind, {})
    moving, fixed = dense_inputs(2, 2, 60, 3, width, height, **scene)
    with torch.no_grad():
        if kind == "opaque":  # alpha at its maximum, samples that stop
            moving[3][:] = 1
            moving[2] *= 3
        if kind == "dark":  # colours clamped at zero
            moving[4][:, :, 0] -= 1.5
    got, want = (
        torch.autograd.grad(loss(function(*moving, *fixed)), moving) for function in (dense, reference.dense_torch)
    )
    for name, have, true in zip((*GAUSSIANS, "background", "world_to_camera"), got, want):
        assert true.abs().max() > 0, name
        torch.testing.assert_close(
            have, true, rtol=1e-6, atol=1e-8 * float(true.abs().max()), msg=lambda text, name=name: f"{name}: {text}"
        )


def loss(outputs):
    """A number in which every pixel counts, each differently."""
    return sum(
        (output * torch.linspace(-1, 2, output.numel(), dtype=output.dtype).view_as(output)).sin().sum()
        for output in outputs
    )


def test_float32_gradients_are_near_the_exact_ones():
    width, height = 64, 48
    gradients = {}
    for dtype in (torch.float64, torch.float32):
        moving, fixed = dense_inputs(1, 2, 200, 2, width, height, dtype=dtype)
        image, alpha, depth = dense(*moving, *fixed)
        gradients[dtype] = torch.autograd.grad((image.square().sum() + alpha.sum() + depth.sum()), moving)
    for single, exact in zip(gradients[torch.float32], gradients[torch.float64]):
        assert (single.double() - exact).norm() < 2e-3 * exact.norm()


def test_gradients_are_the_same_bits_in_every_run_and_on_any_number_of_threads():
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3, 2):
            torch.set_num_threads(threads)
            moving, fixed = dense_inputs(2, 3, 500, 2, 70, 50, dtype=torch.float32)
            image, alpha, depth = dense(*moving, *fixed)
            results.append(torch.autograd.grad(image.square().sum() + (alpha * depth).sum(), moving))
    finally:
        torch.set_num_threads(before)
    for again in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], again))


def test_only_what_asks_for_gradients_gets_them():
    moving, fixed = dense_inputs(1, 1, 5, 1, 12, 9)
    for index in range(7):
        some = [tensor.detach().requires_grad_(k == index) for k, tensor in enumerate(moving)]
        dense(*some, *fixed)[0].square().sum().backward()
        assert [tensor.grad is not None for tensor in some] == [k == index for k in range(7)]


def test_nothing_to_draw_has_zero_gradients():
    moving, fixed = dense_inputs(1, 2, 5, 1, 12, 9)
    with torch.no_grad():
        moving[0][..., 2] -= 9
    dense(*moving, *fixed)[0].sum().backward()
    assert all(not tensor.grad.any() for index, tensor in enumerate(moving) if index != 5)
    torch.testing.assert_close(moving[5].grad, torch.full_like(moving[5], 12 * 9))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dense_op_is_registered_as_torch_wants_it(dtype):
    moving, fixed = dense_inputs(2, 2, 6, 1, 12, 9, dtype=dtype)
    for name in ("render_images", "render_images_with_state"):
        torch.library.opcheck(getattr(torch.ops.lightfield_gs, name), (*moving, *fixed))


def test_a_state_of_another_render_is_refused():
    moving, fixed = dense_inputs(1, 2, 5, 1, 12, 9)
    *images, splats, colours, lists = torch.ops.lightfield_gs.render_images_with_state(*moving, *fixed)
    for state in [
        (splats[:1], colours, lists),
        (splats, colours[:1], lists),
        (splats, colours, lists[:8]),
        (splats, colours, lists.int()),
    ]:
        with pytest.raises(InputError, match="state"):
            torch.ops.lightfield_gs.render_images_backward(
                *moving, *fixed, False, 0, *images, *state, *images, 0, True, False
            )


# ---- light-field images


def lens_inputs(name, count, degree, *, continuous=False, dtype=torch.float64, scene=None, **changes):
    shown = panel(name, **changes)
    fan = rig(shown, 0.1, -0.15, (0.53, 0.44))
    gaussians = random_scene(count, degree, seed=20, dtype=dtype, **(scene or {}))
    moving = [*gaussians.fields().values(), background_of(dtype=dtype)]
    return leaves(moving), lenticular_camera(shown, fan, continuous).numbers(), (shown, fan)


def lens(*arguments):
    return torch.ops.lightfield_gs.render_direct(*arguments)


SMALL = dict(width_px=9, height_px=5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("continuous", [False, True])
def test_lens_gradcheck_of_every_subpixel(degree, continuous):
    moving, fixed, _ = lens_inputs("default lens", 3, degree, continuous=continuous, **SMALL)
    assert torch.autograd.gradcheck(lambda *m: lens(*m, *fixed), moving, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(
    "name", ["leaning the other way, BGR", "inverted", "narrower than a pixel", "wide lenses", "one view"]
)
def test_lens_gradcheck_on_unusual_panels(name):
    moving, fixed, _ = lens_inputs(name, 3, 1, **SMALL)
    assert torch.autograd.gradcheck(lambda *m: lens(*m, *fixed), moving, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("size", [(67, 21), (18, 50)])
def test_lens_gradcheck_over_tiles(size):
    moving, fixed, _ = lens_inputs("default lens", 6, 1, width_px=size[0], height_px=size[1])
    draw = projected(lambda *m: [lens(*m, *fixed)], count=1)
    assert torch.autograd.gradcheck(draw, moving, eps=1e-6, atol=1e-5, rtol=1e-5)


def test_lens_gradcheck_where_the_jacobian_is_clamped():
    moving, fixed, _ = lens_inputs(
        "default lens", 6, 1, scene=dict(extent=2.5, size=0.6), cone_deg=20.0, width_px=10, height_px=8
    )
    draw = projected(lambda *m: [lens(*m, *fixed)])
    assert torch.autograd.gradcheck(draw, moving, eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["plain", "opaque", "dark", "clamped"])
@pytest.mark.parametrize("continuous", [False, True])
def test_lens_gradients_are_those_of_the_oracle(kind, continuous):
    scene = dict(extent=3.0, size=0.4) if kind == "clamped" else None
    # A narrow cone, where the polynomial of the colours is exact but for rounding.
    moving, fixed, (shown, fan) = lens_inputs(
        "default lens", 60, 3, continuous=continuous, scene=scene, width_px=50, height_px=40, cone_deg=12.0
    )
    with torch.no_grad():
        if kind == "opaque":
            moving[3][:] = 1
            moving[2] *= 3
        if kind == "dark":
            moving[4][:, 0] -= 1.5
    got = torch.autograd.grad(loss([lens(*moving, *fixed)]), moving)
    want = torch.autograd.grad(loss([reference.lens_torch(*moving, shown, fan, continuous=continuous)]), moving)
    for name, have, true in zip((*GAUSSIANS, "background"), got, want):
        assert true.abs().max() > 0, name
        torch.testing.assert_close(
            have, true, rtol=1e-5, atol=1e-6 * float(true.abs().max()), msg=lambda text, name=name: f"{name}: {text}"
        )


def test_lens_float32_gradients_are_near_the_exact_ones():
    gradients = {}
    for dtype in (torch.float64, torch.float32):
        moving, fixed, _ = lens_inputs("default lens", 200, 2, dtype=dtype)
        gradients[dtype] = torch.autograd.grad(lens(*moving, *fixed).square().sum(), moving)
    for single, exact in zip(gradients[torch.float32], gradients[torch.float64]):
        assert (single.double() - exact).norm() < 2e-3 * exact.norm()


def test_lens_gradients_are_the_same_bits_in_every_run_and_on_any_number_of_threads():
    results, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 3, 2):
            torch.set_num_threads(threads)
            moving, fixed, _ = lens_inputs("default lens", 500, 2, dtype=torch.float32)
            results.append(torch.autograd.grad(lens(*moving, *fixed).square().sum(), moving))
    finally:
        torch.set_num_threads(before)
    for again in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], again))


def test_lens_nothing_to_draw_has_zero_gradients():
    moving, fixed, (shown, _) = lens_inputs("default lens", 5, 1)
    with torch.no_grad():
        moving[0][..., 2] -= 9
    lens(*moving, *fixed).sum().backward()
    assert all(not tensor.grad.any() for tensor in moving[:5])
    torch.testing.assert_close(moving[5].grad, torch.full_like(moving[5], shown.width_px * shown.height_px))


def test_encode_carries_gradients():
    moving, fixed, (shown, fan) = lens_inputs("default lens", 20, 1)
    image = encode(Gaussians(*moving[:5]), shown, fan, background=moving[5], output="float64")
    got = torch.autograd.grad(loss([image]), moving)
    want = torch.autograd.grad(loss([lens(*moving, *fixed)]), moving)
    assert all(torch.equal(a, b) for a, b in zip(got, want))
    assert not encode(Gaussians(*moving[:5]), shown, fan).requires_grad  # 8 bits carry none


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lens_op_is_registered_as_torch_wants_it(dtype):
    moving, fixed, _ = lens_inputs("default lens", 6, 1, dtype=dtype, **SMALL)
    torch.library.opcheck(torch.ops.lightfield_gs.render_direct, (*moving, *fixed))
