"""`render` and `encode` under torch.compile, torch.export and torch.func, and of tensors without values."""

import io
from dataclasses import replace

import pytest
import torch
from rasterizer_cases import panel, random_scene, rig
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.func import grad, vmap

import lightfield_gs as lf

WHOLE_GRAPHS = pytest.mark.skipif(
    torch.__version__ < (2, 11), reason="render and encode in graphs of torch.compile need torch 2.11 or later"
)
COUNT, WIDTH, HEIGHT = 8, 20, 16
EVERYTHING = dict(alpha=True, depth=True, radii=True, render_mode="RGB+ED", normals=True, median_depth=True)
EVERYTHING |= dict(means2d=True, conics=True, tiles=True, near_plane=0.1, far_plane=50.0, radius_clip=0.5)


def cameras(count=2, dtype=torch.float64, **changes):
    poses = torch.eye(4, dtype=dtype).repeat(count, 1, 1)
    poses[:, 2, 3], poses[:, 0, 3] = 3, torch.linspace(-0.3, 0.3, count)
    optics = torch.tensor([[20.0, 20.0], [WIDTH / 2, HEIGHT / 2]], dtype=dtype)
    return lf.Cameras(poses, *(row.repeat(count, 1) for row in optics), WIDTH, HEIGHT, **changes)


def fields(dtype=torch.float64):
    return [t.detach() for t in random_scene(COUNT, 1, seed=3, dtype=dtype).fields().values()]


def images(drawn):
    return tuple(t for t in drawn.named().values() if t is not None)


def plain(*given):
    return images(lf.render(lf.Gaussians(*given), cameras()))


def single(*given):  # recentres
    return images(lf.render(lf.Gaussians(*given), cameras(dtype=torch.float32), background=(0.1, 0.2, 0.3)))


def everything(*given):
    features = given[1] * 2
    chosen = dict(features=features, colors=features[:, 1:], masks=given[3] > 0.1)
    return images(lf.render(lf.Gaussians(*given), cameras(model="fisheye"), **chosen, **EVERYTHING))


def by_torch(*given):
    spread = given[1][:, :3, None] * given[1][:, None, :3] + torch.eye(3).to(given[1])
    return images(lf.render(lf.Gaussians(*given), cameras(), covars=0.01 * spread, alpha=True))


def gradients(outputs, given):
    loss = sum(t.square().sum() for t in outputs if t.requires_grad)
    return torch.autograd.grad(loss, given, allow_unused=True)


@WHOLE_GRAPHS
@pytest.mark.parametrize("draw", [plain, single, everything, by_torch])
def test_compiled_images_and_gradients_are_the_same(draw):
    given = [t.requires_grad_() for t in fields(torch.float32 if draw is single else torch.float64)]
    found = torch.compile(draw, fullgraph=True, backend="aot_eager")(*given)
    want = draw(*given)
    for have, true in zip((*found, *gradients(found, given)), (*want, *gradients(want, given))):
        torch.testing.assert_close(have, true, rtol=0, atol=0)


class Fit(torch.nn.Module):
    """Gaussians that are parameters, seen by the cameras of an argument."""

    def __init__(self):
        super().__init__()
        self.fields = torch.nn.ParameterList(torch.nn.Parameter(t) for t in fields())

    def forward(self, poses, focal):
        seen = lf.Cameras(poses, focal, focal / 2, WIDTH, HEIGHT)
        return images(lf.render(lf.Gaussians(*self.fields), seen, alpha=True, radii=True))


@pytest.mark.parametrize("strict", [False, pytest.param(True, marks=WHOLE_GRAPHS)])
def test_an_exported_render_takes_any_number_of_cameras(strict):
    fit, some, more = Fit(), cameras(2), cameras(5)
    number = torch.export.Dim("cameras")
    shapes = {"poses": {0: number}, "focal": {0: number}}
    given = some.world_to_camera, some.focal_px
    exported = torch.export.export(fit, given, dynamic_shapes=shapes, strict=strict)
    file = io.BytesIO()
    torch.export.save(exported, file)
    file.seek(0)
    loaded = torch.export.load(file).module()
    for have, true in zip(loaded(more.world_to_camera, more.focal_px), fit(more.world_to_camera, more.focal_px)):
        assert torch.equal(have, true)
    poses = more.world_to_camera.clone().requires_grad_()
    (found,) = torch.autograd.grad(loaded(poses, more.focal_px)[0].sum(), poses)
    (want,) = torch.autograd.grad(fit(poses, more.focal_px)[0].sum(), poses)
    assert torch.equal(found, want)


def test_transforms_of_render_are_those_of_each_row():
    given = fields()
    rows = torch.stack([given[0], given[0] + 0.1])
    loss = lambda *t: sum(image.square().sum() for image in everything(*t))
    want = [grad(loss)(row, *given[1:]) for row in rows]
    leaves = [t.clone().requires_grad_() for t in given]
    torch.testing.assert_close(want[0], gradients(everything(*leaves), leaves)[0])
    by_row = vmap(grad(loss), (0, *(None,) * 4))(rows, *given[1:])
    torch.testing.assert_close(by_row, torch.stack(want))
    # one camera each: the gradient of every image on its own
    poses, seen = cameras().world_to_camera, cameras(1)
    one = lambda means, pose: images(
        lf.render(lf.Gaussians(means, *given[1:]), lf.Cameras(pose[None], seen.focal_px, seen.principal_point_px, 9, 8))
    )[0].sum()
    found = vmap(grad(one), (None, 0))(given[0], poses)
    torch.testing.assert_close(found, torch.stack([grad(one)(given[0], pose) for pose in poses]))


def test_tensors_without_values_draw_shapes():
    want = [image.shape for image in everything(*fields())]
    with FakeTensorMode():
        assert [image.shape for image in everything(*fields())] == want
    scene = lf.Gaussians(*(t.to("meta") for t in fields()))
    drawn = lf.render(scene, cameras().to("meta"), background=torch.zeros(3, device="meta"), **EVERYTHING)
    assert drawn.image.is_meta and drawn.image.shape == (2, HEIGHT, WIDTH, 4) and drawn.radii.shape == (2, COUNT)
    with pytest.raises(lf.InputError, match="expected tensors with values"):
        scene.validate()
    with pytest.raises(lf.InputError, match="background"):  # without values beside Gaussians that have them
        lf.render(lf.Gaussians(*fields()), cameras(), background=torch.zeros(3, device="meta"))


@WHOLE_GRAPHS
def test_equirectangular_images_are_refused_while_compiling():
    seen = lf.Cameras.equirectangular(cameras().world_to_camera, 32)
    with pytest.raises(Exception, match="expected another than equirectangular"):
        torch.compile(lambda *t: lf.render(lf.Gaussians(*t), seen), fullgraph=True, backend="eager")(*fields())


# ---- light-field images

SHOWN = panel("default lens", width_px=9, height_px=5)
FAN = rig(SHOWN, 0.1, -0.15, (0.53, 0.44))
LENS = dict(views="continuous", view_filter=0.5, antialiased=True, background=(0.0, 0.5, 1.0))


def light_field(*given, shown=SHOWN, fan=FAN, **options):
    return lf.encode(lf.Gaussians(*given), shown, fan, output="float64", **options)


def test_compilers_may_break_graphs():
    for draw in (plain, lambda *t: (light_field(*t),)):
        given = [t.requires_grad_() for t in fields()]
        found, want = torch.compile(draw, backend="eager")(*given), draw(*given)
        for have, true in zip((*found, *gradients(found, given)), (*want, *gradients(want, given)), strict=True):
            assert torch.equal(have, true)


@WHOLE_GRAPHS
@pytest.mark.parametrize("options", [{}, LENS])
def test_a_compiled_encode_is_the_same(options):
    given = [t.requires_grad_() for t in fields()]
    found = torch.compile(light_field, fullgraph=True, backend="aot_eager")(*given, **options)
    want = light_field(*given, **options)
    assert torch.equal(found, want)
    for have, true in zip(gradients([found], given), gradients([want], given)):
        assert torch.equal(have, true)
    in_bytes = lambda *t: lf.encode(lf.Gaussians(*t), SHOWN, FAN)
    assert torch.equal(torch.compile(in_bytes, fullgraph=True, backend="aot_eager")(*given), in_bytes(*given))


@WHOLE_GRAPHS
def test_other_panels_and_rigs_need_few_graphs():
    given, graphs = fields(), []
    backend = lambda graph, _: graphs.append(graph) or graph
    call = torch.compile(lambda *t, **of: light_field(*t, **of), fullgraph=True, backend=backend)
    for step in range(8):
        pose = FAN.world_to_camera.copy()
        pose[0, 3] += 0.1 * step
        fan = replace(FAN, world_to_camera=pose, zero_depth=FAN.zero_depth + 0.05 * step)
        shown = replace(SHOWN, phase=0.3 * step, line_number=SHOWN.line_number + 0.01 * step)
        assert torch.equal(call(*given, shown=shown, fan=fan), light_field(*given, shown=shown, fan=fan))
    assert len(graphs) <= 3
    cells = panel("cells", width_px=12, height_px=8)
    assert torch.equal(call(*given, shown=cells), light_field(*given, shown=cells))
    fan.world_to_camera[0, 3] += 0.2  # in place
    assert torch.equal(call(*given, fan=fan), light_field(*given, fan=fan))


def test_sets_of_gaussians_are_drawn_each():
    sets = [torch.stack([t, t * (1 if t.dim() == 1 else 1.1)]) for t in fields()]
    leaves = [t.clone().requires_grad_() for t in sets]
    images = light_field(*leaves, **LENS)
    assert images.shape == (2, 5, 9, 3)
    found = gradients([images], leaves)
    for row in range(2):
        one = [t[row].clone().requires_grad_() for t in sets]
        image = light_field(*one, **LENS)
        assert torch.equal(images[row], image)
        for have, true in zip(found, gradients([image], one)):
            assert torch.equal(have[row], true)
    scenes, out = lf.Gaussians(*sets), torch.empty(2, 5, 9, 3, dtype=torch.uint8)
    assert lf.encode(scenes, SHOWN, FAN, out=out) is out
    assert torch.equal(out[1], lf.encode(scenes.mapped(lambda t: t[1]), SHOWN, FAN))
    for wrong in (dict(stats={}), dict(out=out[:1]), dict(out=out[0])):
        with pytest.raises(lf.InputError, match="sets"):
            lf.encode(scenes, SHOWN, FAN, **wrong)
    with pytest.raises(lf.InputError, match="Encoder takes one scene"):
        lf.Encoder(SHOWN, FAN)(scenes)
    with pytest.raises(lf.InputError, match="at least one set"):
        lf.encode(lf.Gaussians(*(t[:0] for t in sets)), SHOWN, FAN)


class Draw(torch.nn.Module):
    def forward(self, *fields):
        return light_field(*fields, **LENS)


@WHOLE_GRAPHS
def test_strict_exports_of_encode_are_refused():
    with pytest.raises(Exception, match="strict=False"):
        torch.export.export(Draw(), tuple(fields()), strict=True)


def test_an_exported_encode_and_its_transforms_are_the_same():
    given = tuple(fields())
    exported = torch.export.export(Draw(), given, strict=False)
    assert torch.equal(exported.module()(*given), light_field(*given, **LENS))
    loss = lambda *t: light_field(*t, **LENS).square().sum()
    rows = torch.stack([given[0], given[0] + 0.1])
    found = vmap(grad(loss), (0, *(None,) * 4))(rows, *given[1:])
    leaves = [t.clone().requires_grad_() for t in given]
    torch.testing.assert_close(found[0], gradients([light_field(*leaves, **LENS)], leaves)[0])
    scene = lf.Gaussians(*given)
    assert lf.encode(scene.to("meta"), SHOWN, FAN).shape == (5, 9, 3)
    with pytest.raises(lf.InputError, match="method 'sorted' reads values"):
        lf.encode(scene.to("meta"), SHOWN, FAN, "sorted")
