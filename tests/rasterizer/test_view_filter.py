"""Angular anti-aliasing: the footprint swept over the width of a view, against numerical integration and the oracle."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from rasterizer_cases import all_subpixels, panel, projected, random_scene, rig

from lightfield_gs import Encoder, InputError, cli, encode, prune, reference
from lightfield_gs.base.arrays import to_bytes
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.panels.rig import Rig, lenticular_camera, view_aperture
from lightfield_gs.rasterizer.image_render import ImageArguments, ImageBuffers, ImageRender
from lightfield_gs.rasterizer.quality import QUALITIES
from lightfield_gs.rasterizer.workspace import GradientRequest
from lightfield_gs.reference.blend import LOW_PASS_PX2, Projection, Scene, square
from lightfield_gs.reference.light_field import rig_eye
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.page.stage import Controls, Stage, StagedScene
from lightfield_gs.show.preview import contact_sheet, look_around

BACKGROUND = (0.1, 0.6, 0.3)
WIDTH = 12.0  # of the 96 views of panel(), which has few pixels


def deep_scene(count: int = 80, degree: int = 0, size: float = 0.04, seed: int = 6) -> Gaussians:
    """Gaussians of all shapes, far before and behind the zero plane of rig()."""
    scene = random_scene(count, degree, seed=seed, size=size)
    scene.means[:, 2] = torch.linspace(1.2, 6.0, count)
    scene.scales *= torch.tensor([0.3, 1.0, 4.0])
    return scene


def psnr(image: torch.Tensor | np.ndarray, want: np.ndarray) -> float:
    return -10 * math.log10(max(float(((np.asarray(image, np.float64) - want) ** 2).mean()), 1e-30))


def oracle(scene: Gaussians, shown, fan, **options) -> tuple[np.ndarray, np.ndarray]:
    size = shown.height_px, shown.width_px, 3
    options = {"background": BACKGROUND, "return_margin": True, **options}
    colours, margins = reference.subpixel_colours(scene, shown, fan, *all_subpixels(shown), **options)
    return colours.reshape(size), margins.reshape(size)


def test_the_oracle_has_the_second_moments_of_footprints_integrated_over_the_view():
    """Mean, variance and covariance in pixels of footprints averaged over 4001 cameras within a box of forty views."""
    shown, scene = panel(cone_deg=12.0), deep_scene(30)
    fan, width = rig(shown, 0.1, -0.15), 40.0
    projection, everything = (
        Projection(Scene.from_gaussians(scene), rig_eye(shown, fan, width)),
        torch.arange(scene.count),
    )
    middle = 0.3 * fan.half_width(shown)
    box = width * 2 * fan.half_width(shown) / shown.views
    offsets = middle + box * ((torch.arange(4001, dtype=torch.float64) + 0.5) / 4001 - 0.5)
    u, _, across, down = (
        t.expand(*t.shape[:-2], scene.count, 4001) for t in projection.footprint(everything[:, None], offsets[None])
    )
    along = (square(across) + LOW_PASS_PX2).mean(-1) + u.var(-1, correction=0)
    covariance = (across * down).sum(0).mean(-1)
    u0, _, across0, down0 = projection.footprint(everything, offsets.new_tensor(middle))
    torch.testing.assert_close(u.mean(-1), u0)
    torch.testing.assert_close(covariance, (across0 * down0).sum(0))
    inside = _inside_limits(projection)  # beyond them the Jacobian is that of the limit, not of the mean
    found = square(across0) + LOW_PASS_PX2 + projection.swept(everything)
    torch.testing.assert_close(found[inside], along[inside], rtol=1e-6, atol=0)
    assert float((projection.swept(everything) / found).max()) > 0.6 and inside.sum() > 20


def _inside_limits(projection: Projection) -> torch.Tensor:
    low_x, high_x, low_y, high_y = projection.eye.limits
    x, y = (projection.position[:, k] / projection.position[:, 2] for k in (0, 1))
    return (x > low_x) & (x < high_x) & (y > low_y) & (y < high_y)


@pytest.mark.parametrize("name", ["default lens", "very wide cone", "cells"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_every_subpixel_is_that_of_the_oracle(name, antialiased):
    shown, scene = panel(name), deep_scene(degree=1)
    fan = rig(shown, 0.1, -0.15, (0.53, 0.44))
    options = dict(antialiased=antialiased, view_filter=WIDTH)
    want, margin = oracle(scene, shown, fan, **options)
    stats = {}
    exact = encode(scene, shown, fan, output="float64", background=BACKGROUND, stats=stats, **options).numpy()
    assert np.abs(exact - want)[margin > 1e-9].max() < 2 * stats["colour_error"] + 1e-9
    for method in ("direct", "sorted", "classic"):
        single = encode(scene.to(torch.float32), shown, fan, method, output="float32", background=BACKGROUND, **options)
        assert psnr(single, want) > 75, method


def test_continuous_views_by_all_methods():
    shown, scene = panel(), deep_scene(40)
    fan = rig(shown)
    images = [
        encode(scene, shown, fan, method, output="float64", views="continuous", view_filter=WIDTH)
        for method in ("direct", "sorted", "classic")
    ]
    assert (images[1] - images[0]).abs().max() < 1e-9 and (images[2] - images[0]).abs().max() < 1e-9


def test_the_picture_comes_near_the_mean_of_the_pictures_within_a_view():
    """One bright view of sparse splats, against the mean of 41 pinholes across its width: light and place are kept."""
    shown = panel(views=4, cone_deg=16.0, width_px=120, height_px=60)
    scene = deep_scene(40, size=0.01)
    scene.opacities[:] = 0.6
    fan = rig(shown)
    fractions = (np.arange(41) + 0.5) / 41
    cameras = fan.cameras_at(shown, 2 + fractions).to(scene.means)
    tensors = [t.unsqueeze(0) for t in scene.fields().values()]
    views = (cameras.world_to_camera[None], cameras.intrinsics()[None], cameras.limits()[None])
    one = [t[:, 20:21] for t in views]
    size, black = (shown.width_px, shown.height_px), torch.zeros(1, 41, 3, dtype=torch.float64)
    mean = ImageRender.from_arguments(ImageArguments(*tensors, black, *views, *size)).draw().image[0].mean(0)
    sharp, filtered = (
        ImageRender.from_arguments(
            ImageArguments(*tensors, black[:, :1], *one, *size), aperture=view_aperture(shown, fan, width)
        )
        .draw()
        .image[0, 0]
        for width in (0.0, 1.0)
    )
    assert psnr(filtered, mean.numpy()) > psnr(sharp, mean.numpy()) + 6
    assert float(filtered.sum() / mean.sum()) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("quality", [name for name in QUALITIES if name != "exact"])
def test_qualities_keep_what_they_promise(quality):
    shown, scene = panel(width_px=200, height_px=120), deep_scene().to(torch.float32)
    exact, found = (
        encode(scene, shown, rig(shown), background=BACKGROUND, view_filter=WIDTH, quality=q).numpy() / 255
        for q in ("exact", quality)
    )
    assert psnr(found, exact) > {"high": 50, "fast": 40, "draft": 33}[quality]


def test_the_zero_plane_stays_as_it_is_and_off_is_off():
    shown, scene = panel(), random_scene(60, 0, seed=2, size=0.05)
    fan = rig(shown)
    scene.means[:, 2] = fan.zero_depth - fan.world_to_camera[2, 3]
    scene.scales[:, 2] = 1e-6
    scene.quaternions[:] = torch.tensor([1.0, 0, 0, 0])
    off, on = (encode(scene, shown, fan, output="float64", view_filter=width) for width in (0, 4))
    assert torch.equal(off, encode(scene, shown, fan, output="float64"))
    assert (on - off).abs().max() < 1e-6


GRADCHECK = dict(eps=1e-6, atol=1e-5, rtol=1e-4)


def lens_inputs(scene: Gaussians, antialiased: bool, **changes) -> tuple[list[torch.Tensor], tuple]:
    shown = panel(**changes)
    arguments = lenticular_camera(shown, rig(shown, 0.1, -0.15), True, view_filter=WIDTH).numbers()
    fields = [*scene.fields().values(), torch.tensor(BACKGROUND, dtype=torch.float64)]
    return [t.clone().requires_grad_() for t in fields], (*arguments, antialiased)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradcheck_of_the_panel(antialiased):
    moving, fixed = lens_inputs(deep_scene(4, degree=1), antialiased, width_px=21, height_px=17)
    draw = projected(lambda *m: [torch.ops.lightfield_gs.render_direct(*m, *fixed)])
    assert torch.autograd.gradcheck(draw, moving, **GRADCHECK)
    torch.library.opcheck(torch.ops.lightfield_gs.render_direct, (*moving, *fixed))


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_those_of_the_oracle(antialiased):
    changes = dict(width_px=50, height_px=40, cone_deg=12.0)
    moving, fixed = lens_inputs(deep_scene(50, degree=1), antialiased, **changes)
    shown = panel(**changes)
    options = dict(continuous=True, antialiased=antialiased, view_filter=WIDTH)
    results = []
    for image in (
        torch.ops.lightfield_gs.render_direct(*moving, *fixed),
        reference.lens_torch(*moving, shown, rig(shown, 0.1, -0.15), **options),
    ):
        weights = torch.randn(image.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(7))
        results.append(torch.autograd.grad((image * weights).sum(), moving))
    for have, true in zip(*results):
        assert true.abs().max() > 0
        torch.testing.assert_close(have, true, rtol=1e-5, atol=1e-6 * float(true.abs().max()))


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_of_ordinary_images_with_an_aperture(antialiased):
    """By central differences along a random direction, of means, quaternions, scales, opacities and the pose."""
    shown, scene = panel(width_px=40, height_px=30), deep_scene(20, degree=1)
    fan = rig(shown)
    cameras = fan.cameras_at(shown, np.array([1.5, 3.0])).to(scene.means)
    fields = [t.unsqueeze(0) for t in scene.fields().values()]
    pose, fixed = cameras.world_to_camera[None].clone(), (cameras.intrinsics()[None], cameras.limits()[None])
    aperture, background = view_aperture(shown, fan, WIDTH), torch.zeros(1, 2, 3, dtype=torch.float64)
    random = torch.Generator().manual_seed(3)

    def job(fields, pose):
        return ImageRender.from_arguments(
            ImageArguments(*fields, background, pose, *fixed, 40, 30, antialiased), aperture=aperture
        )

    drawn = job(fields, pose).draw()
    weights = torch.randn(drawn.image.shape, dtype=torch.float64, generator=random)
    gradients = job(fields, pose).backward(drawn, ImageBuffers(weights, None, None), GradientRequest(0, True))
    ways = [torch.randn(t.shape, dtype=torch.float64, generator=random) for t in (*fields, pose)]
    ways[-1][..., 3, :] = 0
    found = sum(float((g.view(w.shape) * w).sum()) for g, w in zip((*gradients.fields, gradients.cameras), ways))
    ends = []
    for sign in (1, -1):
        *moved, turned = (t + sign * 1e-7 * w for t, w in zip((*fields, pose), ways))
        ends.append(float((job(moved, turned).draw().image * weights).sum()))
    assert found == pytest.approx((ends[0] - ends[1]) / 2e-7, rel=1e-4)


def test_an_encoder_and_pruning_do_the_same():
    shown, scene = panel(), deep_scene(degree=1).to(torch.float32)
    fan = rig(shown)
    want = encode(scene, shown, fan, view_filter=WIDTH)
    encoder = Encoder(shown, fan, view_filter=WIDTH)
    assert encoder.view_filter == WIDTH
    assert torch.equal(encoder(scene), want) and torch.equal(encoder(scene), want)
    kept = prune(scene, shown, fan, 1e-3, view_filter=WIDTH)
    pruned, whole = (encode(s, shown, fan, output="float32", view_filter=WIDTH) for s in (kept, scene))
    assert 0 < kept.count < scene.count and (pruned - whole).abs().mean() <= 1e-3 + 1e-4


def test_the_page_does_the_same():
    shown, scene = panel(width_px=96, height_px=54), deep_scene().to(torch.float32)
    fan, options = rig(shown), {"background": BACKGROUND, "view_filter": WIDTH}
    stage = Stage(StagedScene(scene, fan, background=BACKGROUND, view_filter=WIDTH), shown)
    assert np.array_equal(stage.native(Controls())[0], encode(scene, shown, stage._rig(Controls()), **options).numpy())
    want = to_bytes(render_views(scene, shown, stage._rig(Controls()), [shown.views / 2], **options))[0]
    assert np.array_equal(stage.eye(Controls(), shown.width_px, still=False).pixels, want)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"view_filter": True}, "must be a number"),
        ({"view_filter": -1}, "must be 0..65536"),
        ({"view_filter": math.nan}, "must be 0..65536"),
        ({"view_filter": 1, "method": "sorted", "cameras": True}, "cameras= take its place"),
    ],
)
def test_what_makes_no_sense_is_refused(given, words):
    shown, scene = panel(), deep_scene(5)
    if "cameras" in given:
        given = {**given, "cameras": rig(shown).cameras(shown)}
    with pytest.raises(InputError, match=words):
        encode(scene, shown, rig(shown), **given)


def test_the_commands_take_the_option(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shown, scene = panel(width_px=96, height_px=54), deep_scene().to(torch.float32)
    rig(shown).to_yaml("rig.yaml"), shown.to_yaml("panel.yaml"), scene.save("scene.ply")
    stored, fan = Gaussians.load("scene.ply"), Rig.from_yaml("rig.yaml")
    common = "--panel panel.yaml --rig rig.yaml --device cpu --view-filter 12"
    assert cli.main(f"encode scene.ply -o made.png --preview views {common}".split()) == 0
    made, metadata = read_image("made.png", as_stored=True), read_info("made.png").metadata
    assert np.array_equal(made, encode(stored, shown, fan, view_filter=WIDTH).numpy())
    assert json.loads(metadata["encoding"])["view_filter"] == WIDTH
    sheets = [contact_sheet(look_around(stored, shown, fan, view_filter=width)) for width in (WIDTH, 0)]
    assert np.array_equal(read_image("views/views.png", as_stored=True), sheets[0]) and not np.array_equal(*sheets)
    assert cli.main(f"prune scene.ply -o less.ply --contribution-cut 1e-3 {common}".split()) == 0
    assert torch.equal(Gaussians.load("less.ply").means, prune(stored, shown, fan, 1e-3, view_filter=WIDTH).means)
    assert cli.main("encode scene.ply -o m.png --cameras c.json --method sorted --view-filter 1".split())
    assert "--view-filter is about a rig" in capsys.readouterr().err


def test_what_limits_the_filter_is_that_splats_are_blended_one_by_one():
    """A swept splat alone takes the right fraction of light, but blending treats several splats as independent.

    Splats one behind the other cover a sample at the same time. Blending then covers too much, by Jensen's inequality,
    for 1 - (1 - a)^k is concave in a. Splats side by side cover the sample in turn. Blending then covers too little.
    """
    shown = panel(views=4, cone_deg=16.0, width_px=120, height_px=60)
    fan = rig(shown)
    one = deep_scene(1, size=0.01)
    one.means[:] = fan_place(fan, 3 * fan.zero_depth)
    one.scales[:], one.opacities[:] = 0.01, 0.6

    def covered(scene: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
        """With the filter [H, W], and within the view [41, H, W]."""
        cameras = fan.cameras_at(shown, np.append(2 + (np.arange(41) + 0.5) / 41, 2.5)).to(scene.means)
        tensors = [t.unsqueeze(0) for t in scene.fields().values()]
        views = (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())
        found = []
        for part, aperture in (
            (slice(41, 42), view_aperture(shown, fan, 1.0)),
            (slice(41), view_aperture(shown, fan, 0)),
        ):
            some = [t[None, part] for t in views]
            black = torch.zeros(1, some[0].shape[1], 3, dtype=torch.float64)
            job = ImageRender.from_arguments(
                ImageArguments(*tensors, black, *some, shown.width_px, shown.height_px), aperture=aperture
            )
            found.append(job.draw().alpha[0])
        return found[0][0], found[1]

    def together(steps_px: list[float]) -> Gaussians:
        """Copies so many pixels further to the right each."""
        fields = {name: torch.cat([field] * len(steps_px)) for name, field in one.fields().items()}
        right = torch.as_tensor(fan.world_to_camera, dtype=torch.float64)[0, :3]
        apart = torch.tensor(steps_px, dtype=torch.float64) * 3 * fan.zero_depth / fan.focal_px[0]
        return Gaussians(**{**fields, "means": fields["means"] + apart[:, None] * right})

    filtered, within = covered(one)
    assert float(filtered.sum() / within.mean(0).sum()) == pytest.approx(1, abs=0.02)
    stacked, of_stack = covered(together([0.0] * 6))
    torch.testing.assert_close(of_stack, 1 - (1 - within) ** 6)
    assert float(stacked.sum() / of_stack.mean(0).sum()) > 1.2
    one.opacities[:] = 0.99
    row, of_row = covered(together([2.0 * k for k in range(-10, 11)]))
    middle = slice(58, 62)
    assert float(row[:, middle].sum() / of_row.mean(0)[:, middle].sum()) < 0.97


def fan_place(fan: Rig, depth: float) -> torch.Tensor:
    """The point of the scene that lies before the centre camera of a rig at a depth."""
    pose = torch.as_tensor(fan.world_to_camera, dtype=torch.float64)
    return (torch.tensor([0, 0, depth], dtype=torch.float64) - pose[:3, 3]) @ pose[:3, :3]
