"""Features, plain colours, depths and normals of `render`: by the weights of the image, against the oracle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from rasterizer_cases import dense_views, projected, random_scene, stacked
from test_traced_render import WHOLE_GRAPHS
from torch import Tensor

import lightfield_gs as lf
from lightfield_gs import InputError, reference
from lightfield_gs.base.harmonics import SH_CONSTANT, rotations
from lightfield_gs.rasterizer.render_options import RenderOptions
from lightfield_gs.rasterizer.splat_render import View, draw_splats
from lightfield_gs.reference.blend import Eye, Projection, Samples, Scene
from lightfield_gs.scene.gaussians import Gaussians

WIDTH, HEIGHT, COUNT, VIEWS = 37, 21, 30, 2
BLACK = (0.0, 0.0, 0.0)


def cameras(dtype: torch.dtype = torch.float64, width: int = WIDTH, height: int = HEIGHT) -> lf.Cameras:
    pose, numbers, limits = (t[0].to(dtype) for t in dense_views(1, VIEWS, width, height))
    return lf.Cameras(pose, numbers[:, :2], numbers[:, 2:], width, height, limits)


def random(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def oracle_features(gaussians: Gaussians, seen: lf.Cameras, features: Tensor) -> Tensor:
    """Return features [N, D] or [C, N, D] in 0..1 drawn by the oracle as colours, [C, H, W, D]."""
    width, height = seen.width_px, seen.height_px
    views = [t[None] for t in (seen.world_to_camera, seen.intrinsics(), seen.limits())]
    each = features.expand(seen.count, *features.shape[-2:])
    images = []
    for camera, own in enumerate(each):
        padded = torch.nn.functional.pad(own, (0, -own.shape[1] % 3))
        channels = []
        for three in padded.split(3, 1):
            sh = ((three - 0.5) / SH_CONSTANT)[None, :, None]
            fields = [t[None] for t in list(gaussians.fields().values())[:4]]
            one = [t[:, camera : camera + 1] for t in views]
            zero = torch.zeros(1, 1, 3, dtype=torch.float64)
            channels.append(reference.dense_torch(*fields, sh, zero, *one, width, height)[0][0, 0])
        images.append(torch.cat(channels, -1)[..., : own.shape[1]])
    return torch.stack(images)


def leaves(gaussians: Gaussians) -> Gaussians:
    return Gaussians(*(t.clone().requires_grad_() for t in gaussians.fields().values()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 4, 5, 16, 35])
def test_a_feature_that_is_a_colour_is_the_image_bit_for_bit(dtype, channels):
    scene, seen = random_scene(COUNT, 2, seed=1, dtype=dtype), cameras(dtype)
    colors = random(COUNT, 3, dtype=dtype)
    features = random(COUNT, channels, dtype=dtype, seed=1)
    features[:, -3:] = colors[:, -min(3, channels) :]
    drawn = lf.render(scene, seen, background=BLACK, colors=colors, features=features)
    last = min(3, channels)
    assert torch.equal(drawn.features[..., -last:], drawn.image[..., -last:]) and drawn.image.any()


@pytest.mark.parametrize("own", [False, True])
def test_features_and_their_gradients_are_those_of_the_oracle(own):
    scene, seen = leaves(random_scene(COUNT, 1, seed=2)), cameras()
    features = (0.1 + 0.8 * random(*([VIEWS] if own else []), COUNT, 21)).requires_grad_()
    seen = replace(seen, world_to_camera=seen.world_to_camera.clone().requires_grad_())
    moving = [*list(scene.fields().values())[:4], seen.world_to_camera, features]
    got, want = lf.render(scene, seen, features=features).features, oracle_features(scene, seen, features)
    torch.testing.assert_close(got, want, rtol=0, atol=1e-12)
    weights = torch.linspace(-1, 2, got.numel(), dtype=got.dtype).view_as(got)
    for have, true in zip(*(torch.autograd.grad((weights * t).sin().sum(), moving) for t in (got, want))):
        torch.testing.assert_close(have, true, rtol=1e-6, atol=1e-8 * float(true.abs().max()))


def test_gradcheck_of_everything_that_is_drawn():
    seen, scene = cameras(width=12, height=9), random_scene(4, 1, seed=3)

    def draw(*moving: Tensor) -> list[Tensor]:
        *fields, features, colors, background, pose, screen = moving
        drawn = lf.render(
            Gaussians(*fields),
            replace(seen, world_to_camera=pose),
            background=background,
            features=features,
            colors=colors,
            alpha=True,
            render_mode="RGB+D",
            normals=True,
        )
        return [drawn.image, drawn.alpha, drawn.features, drawn.normals, screen]

    given = [*scene.fields().values(), random(4, 18), random(VIEWS, 4, 3), random(VIEWS, 3), seen.world_to_camera]
    moving = [t.clone().requires_grad_() for t in (*given, torch.zeros(1).double())]
    assert torch.autograd.gradcheck(projected(draw), moving, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_gradients_of_an_image_and_its_features_add_up_as_in_one_image():
    """Half of the light of a loss by the image, half by features that are its colours."""
    scene, seen = random_scene(COUNT, 0, seed=4), cameras()
    found = []
    for with_features in (False, True):
        moving = leaves(scene)
        screen = torch.zeros(VIEWS, COUNT, 2, dtype=torch.float64, requires_grad=True)
        colors = random(COUNT, 3).requires_grad_()
        features = colors if with_features else None
        drawn = lf.render(moving, seen, background=BLACK, colors=colors, features=features, screen=screen)
        images = [drawn.image, drawn.features if with_features else drawn.image]
        sum((image * random(*image.shape, seed=5)).sum() for image in images).backward()
        found.append([t.grad for t in (*list(moving.fields().values())[:4], colors, screen)])
        assert moving.sh.grad is None or not moving.sh.grad.any()
    for have, true in zip(*found):
        torch.testing.assert_close(have, true, rtol=1e-9, atol=1e-12)


def test_plain_colours_are_those_of_harmonics_and_may_have_any_value():
    scene, seen = random_scene(COUNT, 0, seed=5), cameras()
    scene.sh *= 2
    colors = 0.5 + SH_CONSTANT * scene.sh[:, 0]
    plain = lf.render(scene, seen, colors=colors, alpha=True)
    assert (colors < 0).any()
    clamped = lf.render(scene, seen, colors=colors.clamp_min(0))
    torch.testing.assert_close(clamped.image, lf.render(scene, seen).image, rtol=0, atol=1e-14)
    darker = lf.render(scene, seen, colors=colors - 1, alpha=True)
    shift = plain.image - darker.image
    torch.testing.assert_close(shift, darker.alpha[..., None].expand_as(shift), rtol=0, atol=1e-12)


def test_a_lower_degree_leaves_harmonics_out():
    scene, seen = leaves(random_scene(COUNT, 3, seed=6)), cameras()
    for degree in range(4):
        alone = replace(scene, sh=scene.sh[:, : (degree + 1) ** 2])
        assert torch.equal(lf.render(scene, seen, sh_degree=degree).image, lf.render(alone, seen).image)
    lf.render(scene, seen, sh_degree=1).image.sum().backward()
    assert scene.sh.grad[:, :4].any() and not scene.sh.grad[:, 4:].any()
    with pytest.raises(InputError, match="sh_degree: expected 0..1"):
        lf.render(random_scene(COUNT, 1), seen, sh_degree=2)


def test_what_is_left_out_is_not_there():
    scene, seen = random_scene(COUNT, 1, seed=7), cameras()
    depth = (scene.means @ seen.world_to_camera[:, :3, :3].mT)[..., 2] + seen.world_to_camera[:, None, 2, 3]
    radii = lf.render(scene, seen, radii=True).radii
    assert radii is not None
    masks = random(VIEWS, COUNT) > 0.5
    near, far, small = 1.9, 2.3, float(radii.median())
    cases: list[tuple[dict[str, Any], Tensor]] = [
        ({"masks": masks}, masks),
        ({"masks": masks[0]}, masks[:1].expand(VIEWS, -1)),
        ({"near_plane": near}, depth >= near),
        ({"far_plane": far}, depth <= far),
        ({"near_plane": near, "far_plane": far, "masks": masks}, (depth >= near) & (depth <= far) & masks),
        ({"radius_clip": small}, radii > small),
    ]
    for options, kept in cases:
        moving = leaves(scene)
        drawn = lf.render(moving, seen, **options)
        for camera in range(VIEWS):
            alone = Gaussians(*(t[kept[camera]] for t in scene.fields().values()))
            assert torch.equal(drawn.image[camera], lf.render(alone, seen.select([camera])).image[0]), options
        drawn.image.square().sum().backward()
        assert not moving.means.grad[~kept.any(0)].any() and moving.means.grad.any()
        with torch.no_grad():
            assert torch.equal(lf.render(scene, seen, **options).image, drawn.image)


def test_modes_have_the_depths_that_they_name():
    scene, seen = random_scene(COUNT, 1, seed=8), cameras()
    known = lf.render(scene, seen, alpha=True, depth=True)
    assert known.alpha is not None and known.depth is not None
    total = known.depth * known.alpha
    for mode, depth in (("D", total), ("ED", known.depth), ("RGB+D", total), ("RGB+ED", known.depth)):
        drawn = lf.render(scene, seen, render_mode=mode)
        assert torch.equal(drawn.image[..., -1], drawn.depth)
        torch.testing.assert_close(drawn.depth, depth, rtol=1e-12, atol=1e-14)
        assert drawn.image.shape[-1] == (4 if "RGB" in mode else 1)
        assert "RGB" not in mode or torch.equal(drawn.image[..., :3], known.image)


def oracle_blend(scene: Gaussians, seen: lf.Cameras, camera: int):
    """The oracle's projection and weights of all pixels of a camera."""
    eye = Eye(seen.world_to_camera[camera], seen.intrinsics()[camera], seen.limits()[camera, :4])
    rows, columns = (
        t.flatten().double() + 0.5 for t in torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    )
    projection = Projection(Scene.from_gaussians(scene), eye)
    return projection, projection.blend(Samples(columns, rows, torch.zeros_like(rows)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_median_depth_is_where_less_than_half_of_the_light_is_left(dtype):
    scene, seen = random_scene(COUNT, 0, seed=9), cameras()
    drawn = lf.render(scene.to(dtype), seen.to(dtype), median_depth=True, alpha=True)
    assert drawn.median_depth is not None and drawn.alpha is not None
    for camera in range(VIEWS):
        projection, blend = oracle_blend(scene, seen, camera)
        want, left = torch.zeros(WIDTH * HEIGHT).double(), torch.ones(WIDTH * HEIGHT).double()
        sure = torch.ones(WIDTH * HEIGHT).bool()
        for sample, gaussian, weight in zip(blend.sample, blend.gaussian, blend.weight):
            if left[sample] > 0.5 and weight > 0:
                want[sample] = projection.position[gaussian, 2]
            left[sample] -= weight
            sure[sample] &= (left[sample] - 0.5).abs() > 1e-5
        sure &= blend.margin > 1e-4
        found = drawn.median_depth[camera].double().flatten()
        assert sure.float().mean() > 0.9 and (want > 0).any()
        assert (found[sure] - want[sure]).abs().max() < 1e-5
        assert not found[drawn.alpha[camera].flatten() == 0].any()


def test_normals_are_shortest_axes_that_face_the_camera():
    scene, seen = random_scene(COUNT, 0, seed=10), cameras()
    turns, shortest = rotations(scene.quaternions), scene.scales.argmin(-1)
    axes = torch.stack([turn[:, k] for turn, k in zip(turns, shortest)])
    eyes = -(seen.world_to_camera[:, :3, :3].mT @ seen.world_to_camera[:, :3, 3:]).squeeze(-1)
    facing = [torch.stack([a if a @ (eye - m) > 0 else -a for a, m in zip(axes, scene.means)]) for eye in eyes]
    want = oracle_features(scene, seen, 0.5 + 0.5 * torch.stack(facing))
    drawn = lf.render(scene, seen, normals=True, alpha=True)
    torch.testing.assert_close(drawn.normals, 2 * want - drawn.alpha[..., None], rtol=0, atol=1e-12)


def test_places_and_conics_are_those_of_the_footprint():
    scene, seen = random_scene(COUNT, 0, seed=11), cameras()
    drawn = lf.render(scene, seen, means2d=True, conics=True, tiles=True, radii=True)
    assert drawn.radii is not None and drawn.conics is not None and drawn.means2d is not None
    for camera in range(VIEWS):
        eye = Eye(seen.world_to_camera[camera], seen.intrinsics()[camera], seen.limits()[camera, :4])
        projection = Projection(Scene.from_gaussians(scene), eye)
        u, v, across, down = projection.footprint(torch.arange(COUNT), torch.zeros(1).double())
        low_pass = 0.3 * torch.eye(2).double()
        rows = torch.stack([across, down])  # [2, 3, N]
        conics = torch.linalg.inv(torch.einsum("ikn,jkn->nij", rows, rows) + low_pass)
        seen_here = drawn.radii[camera] > 0
        want = torch.stack([u, v], -1), torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], -1)
        for have, true in zip((drawn.means2d[camera], drawn.conics[camera]), want):
            torch.testing.assert_close(have[seen_here], true[seen_here], rtol=1e-9, atol=1e-12)
        assert drawn.tiles is not None and bool(((drawn.tiles[camera] > 0) == seen_here).all())
    tiny = lf.Gaussians(
        torch.tensor([[0.0, 0.0, 2.0]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 1e-3),
        torch.ones(1),
        torch.zeros(1, 1, 3),
    )
    pose, focal = torch.eye(4)[None], torch.full((1, 2), 50.0)
    counts = [
        int(lf.render(tiny, lf.Cameras(pose, focal, torch.tensor([[x, 24.0]]), 64, 48), tiles=True).tiles)  # type: ignore[arg-type]
        for x in (8.0, 16.0, 40.0)
    ]
    assert counts == [1, 2, 1]


def test_sets_of_a_batch_are_drawn_as_each_alone_and_in_chunks(monkeypatch):
    scenes, seen = [random_scene(COUNT, 1, seed=s) for s in (12, 13)], cameras()
    features, masks = random(2, VIEWS, COUNT, 7), random(2, COUNT) > 0.3
    options = dict(normals=True, median_depth=True, radii=True, render_mode="RGB+ED")
    both = lf.render(stacked(scenes), seen, features=features, masks=masks, **options)
    monkeypatch.setattr(lf.rasterizer.image_render, "CHUNK_BYTES", 1)
    for b, scene in enumerate(scenes):
        alone = lf.render(scene, seen, features=features[b], masks=masks[b], **options).named()
        for name, whole in both.named().items():
            assert (whole is None) == (alone[name] is None), name
            assert whole is None or torch.equal(whole[b], alone[name]), name


def test_no_gaussians_and_none_that_is_drawn_leave_the_background():
    seen, scene = cameras(), leaves(random_scene(COUNT, 1, seed=14))
    none = Gaussians(*(t[:0] for t in scene.fields().values()))
    options = dict(normals=True, median_depth=True, radii=True, conics=True, tiles=True, alpha=True)
    for gaussians, masks in ((none, None), (scene, torch.zeros(COUNT).bool())):
        features = random(gaussians.count, 18).requires_grad_()
        drawn = lf.render(gaussians, seen, features=features, masks=masks, **options)
        drawn.features.sum().backward()
        assert features.grad is not None and not features.grad.any() and (drawn.image == 1).all()
        assert not any(drawn.named()[name].any() for name in ("features", "normals", "median_depth", "radii", "alpha"))


def test_all_round_features_are_joined_as_the_image():
    scene = random_scene(COUNT, 0, seed=14)
    seen, colors = lf.Cameras.equirectangular(torch.eye(4, dtype=torch.float64)[None], 64), random(COUNT, 3)
    drawn = lf.render(scene, seen, background=BLACK, colors=colors, features=colors[None], normals=True)
    assert torch.equal(drawn.features, drawn.image) and drawn.normals.shape == drawn.image.shape
    with pytest.raises(InputError, match="conics: equirectangular"):
        lf.render(scene, seen, conics=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_operators_are_registered_as_torch_wants_them(dtype):
    scene = stacked([random_scene(6, 1, seed=s, dtype=dtype) for s in (1, 2)])
    views = [view.to(dtype) for view in dense_views(2, VIEWS, 12, 9)]
    fields = [t.clone().requires_grad_() for t in scene.fields().values()]
    screen = torch.zeros(2, VIEWS, 6, 4, dtype=dtype, requires_grad=True)
    poses = views[0].clone().requires_grad_()
    masks = random(2, VIEWS, 6) > 0.2
    operators, size = torch.ops.lightfield_gs, (12, 9)
    arguments = (*fields, poses, *views[1:], *size, False, 0, screen, masks, 0.5, 9.0, 0.0)
    torch.library.opcheck(operators.project_splats, arguments)
    splats, colours, lists = (t.detach() for t in operators.project_splats(*arguments))
    splats.requires_grad_(), colours.requires_grad_()
    background = random(2, VIEWS, 3, dtype=dtype).requires_grad_()
    torch.library.opcheck(operators.composite_splats, (splats, colours, lists, background, *size, True, True))
    for features in (random(2, 6, 5, dtype=dtype), random(2, VIEWS, 6, 18, dtype=dtype)):
        given = (splats, colours.detach(), lists, features.requires_grad_(), *size)
        torch.library.opcheck(operators.composite_features, given)
    torch.library.opcheck(operators.composite_median_depth, (splats.detach(), colours.detach(), lists, 2, *size))


@WHOLE_GRAPHS
def test_the_stages_compile_into_one_graph():
    scene, seen = leaves(random_scene(6, 1, seed=17)), cameras(width=12, height=9)
    views = [t[None] for t in (seen.world_to_camera, seen.intrinsics(), seen.limits())]
    view = View(torch.ones(1, VIEWS, 3).double(), *views, 12, 9, 0)
    moving = [*scene.fields().values(), random(6, 5).requires_grad_()]

    def draw(*tensors: Tensor) -> list[Tensor]:
        *fields, features = (t[None] for t in tensors)
        options = RenderOptions(features=features[None], normals=True, median_depth=True, masks=mask)
        drawn = draw_splats(fields, view, options, None)
        return [t for t in drawn if t is not None and t.is_floating_point()]

    mask = torch.ones(1, VIEWS, 6).bool()
    found = []
    for call in (draw, torch.compile(draw, fullgraph=True, backend="aot_eager")):
        images = call(*moving)
        loss = sum(t.square().sum() for t in images if t.requires_grad)
        found.append([*images, *torch.autograd.grad(loss, moving)])
    for have, true in zip(*found):
        torch.testing.assert_close(have, true)


def test_a_second_derivative_is_refused():
    scene, seen, features = leaves(random_scene(COUNT)), cameras(), random(COUNT, 5).requires_grad_()
    image = lf.render(scene, seen, features=features).features
    (gradient,) = torch.autograd.grad(image.square().sum(), features, create_graph=True)
    with pytest.raises(InputError, match="differentiable once"):
        gradient.sum().backward()


@pytest.mark.parametrize(
    "options, named",
    [
        (dict(features=torch.zeros(COUNT + 1, 4)), "features: expected"),
        (dict(features=torch.zeros(COUNT, 0)), "features: expected"),
        (dict(features=torch.zeros(COUNT, 4).double()), "features must be torch.float32"),
        (dict(features=torch.full((COUNT, 4), torch.nan)), "features"),
        (dict(features=[1.0]), "features: expected torch.Tensor"),
        (dict(colors=torch.zeros(COUNT, 4)), "colors: expected"),
        (dict(colors=torch.zeros(COUNT, 3), sh_degree=0), "leave sh_degree or colors out"),
        (dict(masks=torch.ones(COUNT)), "masks must be torch.bool"),
        (dict(masks=torch.ones(COUNT, 1).bool()), "masks: expected"),
        (dict(near_plane=0.0), "near_plane must be 0.01"),
        (dict(near_plane=2.0, far_plane=1.0), "far_plane must be 2"),
        (dict(radius_clip=-1), "radius_clip"),
        (dict(render_mode="rgb"), "render_mode: expected one of RGB"),
        (dict(normals=1), "normals"),
        (dict(sh_degree=True), "sh_degree"),
    ],
)
def test_what_is_no_option_is_refused(options, named):
    with pytest.raises(InputError, match=named) as refusal:
        lf.render(random_scene(COUNT, dtype=torch.float32), cameras(torch.float32), **options)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("model", ["pinhole", "orthographic"])
def test_covariances_are_drawn_as_their_scales_and_rotations(model, antialiased):
    scene, seen = random_scene(COUNT, 2, seed=15, size=0.05), cameras()
    if model == "orthographic":
        seen = lf.Cameras(
            seen.world_to_camera, seen.focal_px / 2, seen.principal_point_px, WIDTH, HEIGHT, model="orthographic"
        )
    features, found = random(COUNT, 5), []
    for by_covariances in (False, True):
        moving = leaves(scene)
        poses = seen.world_to_camera.clone().requires_grad_()
        screen = torch.zeros(VIEWS, COUNT, 4, dtype=torch.float64, requires_grad=True)
        stand_ins = torch.ones_like(scene.scales) if by_covariances else moving.scales
        turns = rotations(moving.quaternions) * moving.scales[:, None]
        drawn = lf.render(
            replace(moving, scales=stand_ins),
            replace(seen, world_to_camera=poses),
            covars=turns @ turns.mT if by_covariances else None,
            features=features,
            antialiased=antialiased,
            render_mode="RGB+D",
            screen=screen,
        )
        images = [drawn.image, drawn.features]
        sum((image * random(*image.shape, seed=5)).sum() for image in images).backward()
        found.append([*images, *(t.grad for t in (*moving.fields().values(), poses, screen))])
    for have, true in zip(*found):
        scale = float(true.detach().abs().max())
        torch.testing.assert_close(have.detach(), true.detach(), rtol=1e-7, atol=1e-9 * scale)


def test_a_wider_blur_is_that_of_wider_gaussians():
    """Before an orthographic camera of one pixel per unit a blur is a round Gaussian more in the covariance."""
    scene = random_scene(COUNT, 0, seed=16, extent=12.0, size=2.0)
    scene.means[:, 2] += 20
    pose, one = torch.eye(4, dtype=torch.float64)[None], torch.ones(1, 2, dtype=torch.float64)
    seen = lf.Cameras(pose, one, 20 * one, 40, 40, model="orthographic")
    covars = (factors := rotations(scene.quaternions) * scene.scales[:, None]) @ factors.mT
    wide = lf.render(scene, seen, eps2d=1.3).image
    round_ = lf.render(scene, seen, covars=covars + torch.eye(3).double()).image
    torch.testing.assert_close(wide, round_, rtol=0, atol=1e-12)
    assert (wide - lf.render(scene, seen).image).abs().max() > 1e-3
    with pytest.raises(InputError, match="eps2d: expected cameras of the models"):
        lf.render(scene, lf.Cameras.equirectangular(pose, 64), eps2d=1.0)
    with pytest.raises(InputError, match=r"covars\[3\]: expected a symmetric"):
        covars[3, 0, 1] += 1
        lf.render(scene, seen, covars=covars)
