"""Anti-aliased scenes: opacities compensated for the blur of 0.3 px^2, against the float64 oracle."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from rasterizer_cases import all_subpixels, dense_views, panel, projected, random_scene, rig, stacked

from lightfield_gs import Encoder, InputError, cli, encode, prune, reference, render
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.panels.rig import Rig, lenticular_camera
from lightfield_gs.rasterizer.quality import QUALITIES
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.preview import contact_sheet, look_around

BACKGROUND = (0.1, 0.6, 0.3)
SHAPES = {"specks": (1, 1, 1), "wires": (0.1, 30, 0.1), "discs": (10, 10, 1e-5), "mixed": (0.3, 4, 20)}


def fine_scene(shape: str = "mixed", count: int = 80, degree: int = 0, seed: int = 4) -> Gaussians:
    """Gaussians that are smaller than a pixel some way, so that the blur is much of what is seen of them."""
    scene = random_scene(count, degree, seed=seed, size=0.012)
    scene.scales *= torch.tensor(SHAPES[shape])
    scene.opacities[::2] = 1
    return scene


def psnr(image: torch.Tensor | np.ndarray, want: np.ndarray) -> float:
    return -10 * math.log10(max(float(((np.asarray(image, np.float64) - want) ** 2).mean()), 1e-30))


def oracle(scene: Gaussians, shown, fan, **options) -> tuple[np.ndarray, np.ndarray]:
    size = shown.height_px, shown.width_px, 3
    colours, margins = reference.subpixel_colours(
        scene, shown, fan, *all_subpixels(shown), background=BACKGROUND, antialiased=True, return_margin=True, **options
    )
    return colours.reshape(size), margins.reshape(size)


def test_the_oracle_keeps_the_light_of_a_ball_smaller_than_a_pixel():
    shown, sigma, depth = panel(views=1, width_px=64, height_px=64, cone_deg=1.0), 0.004, 2.0
    fan = rig(shown)
    ball = Gaussians(
        *(
            torch.tensor(field, dtype=torch.float64)
            for field in ([[0, 0, depth]], [[1.0, 0, 0, 0]], [[sigma] * 3], [0.9], [[[-0.5 / 0.28209479177387814] * 3]])
        )
    )
    (fx, fy), blur = fan.focal_px, 0.3
    xx, yy = (fx / depth * sigma) ** 2, (fy / depth * sigma) ** 2
    dark = 1 - reference.subpixel_colours(ball, shown, fan, *all_subpixels(shown), antialiased=True)
    peak = 0.9 * math.sqrt(xx * yy / ((xx + blur) * (yy + blur))) * math.exp(-0.125 / (xx + blur) - 0.125 / (yy + blur))
    assert dark.max() == pytest.approx(peak, rel=1e-9)


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_subpixel_is_that_of_the_oracle(shape, views):
    shown, scene = panel(), fine_scene(shape)
    fan = rig(shown, 0.1, -0.15, (0.53, 0.44))
    want, margin = oracle(scene, shown, fan, continuous=views == "continuous")
    options = dict(views=views, background=BACKGROUND, antialiased=True)
    exact = encode(scene, shown, fan, output="float64", **options)
    assert np.abs(exact.numpy() - want)[margin > 1e-9].max() < 1e-9
    for method in ("direct", "sorted", "classic"):
        single = encode(scene.to(torch.float32), shown, fan, method, output="float32", **options)
        assert psnr(single, want) > 80, method
    without = encode(scene, shown, fan, output="float64", views=views, background=BACKGROUND)
    assert psnr(without, want) < 45


@pytest.mark.parametrize(
    "name",
    [
        "very wide cone",
        "leaning the other way, BGR",
        "narrower than a pixel",
        "one view",
        "lenses as wide as the panel",
        "cells",
        "cells of narrow lenses",
    ],
)
def test_unusual_panels_and_harmonics(name):
    shown, scene = panel(name), fine_scene(degree=2)
    fan = rig(shown, -0.2, 0.1)
    want, margin = oracle(scene, shown, fan)
    stats = {}
    exact = encode(scene, shown, fan, output="float64", background=BACKGROUND, antialiased=True, stats=stats).numpy()
    assert np.abs(exact - want)[margin > 1e-9].max() < 2 * stats["colour_error"] + 1e-9
    single = encode(scene.to(torch.float32), shown, fan, output="float32", background=BACKGROUND, antialiased=True)
    assert psnr(single, want) > 80


@pytest.mark.parametrize("quality", [name for name in QUALITIES if name != "exact"])
def test_qualities_keep_what_they_promise(quality):
    shown, scene = panel(width_px=200, height_px=120), fine_scene().to(torch.float32)
    fan = rig(shown)
    exact, found = (
        encode(scene, shown, fan, background=BACKGROUND, antialiased=True, quality=q).numpy() / 255
        for q in ("exact", quality)
    )
    assert psnr(found, exact) > {"high": 50, "fast": 40, "draft": 33}[quality]


def test_gaussians_larger_than_pixels_hardly_change():
    shown, scene = panel(), random_scene(60, seed=1, size=0.4)
    fan = rig(shown)
    images = [encode(scene, shown, fan, output="float64", antialiased=aa).numpy() for aa in (False, True)]
    assert 30 < psnr(images[0], images[1]) < 200


def dense_inputs(scene: Gaussians, width: int, height: int) -> tuple[list[torch.Tensor], tuple]:
    pose, camera, limits = dense_views(1, 2, width, height)
    fields = [*stacked([scene]).fields().values(), torch.full((1, 2, 3), 0.3, dtype=torch.float64), pose]
    return [t.clone().requires_grad_() for t in fields], (camera, limits, width, height, True)


def lens_inputs(scene: Gaussians, **changes) -> tuple[list[torch.Tensor], tuple]:
    shown = panel(**changes)
    arguments = lenticular_camera(shown, rig(shown, 0.1, -0.15), True).numbers()
    fields = [*scene.fields().values(), torch.tensor(BACKGROUND, dtype=torch.float64)]
    return [t.clone().requires_grad_() for t in fields], (*arguments, True)


# Thin enough for much compensation, not so thin that central differences of 1e-6 see its bend
GRADCHECK = dict(eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("shape", ["specks", "mixed"])
def test_gradcheck_of_both_sensors(shape):
    scene = fine_scene(shape, 4, degree=1)
    scene.scales *= 2
    moving, fixed = dense_inputs(scene, 21, 17)
    draw = projected(lambda *m: torch.ops.lightfield_gs.render_images(*m, *fixed))
    assert torch.autograd.gradcheck(draw, moving, **GRADCHECK)
    moving, fixed = lens_inputs(scene, width_px=21, height_px=17)
    draw = projected(lambda *m: [torch.ops.lightfield_gs.render_direct(*m, *fixed)])
    assert torch.autograd.gradcheck(draw, moving, **GRADCHECK)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sensor", ["dense", "lens"])
def test_gradients_are_those_of_the_oracle(sensor, shape):
    scene = fine_scene(shape, 60, degree=1)
    if sensor == "dense":
        moving, fixed = dense_inputs(scene, 50, 40)
        got, want = (
            lambda *m: torch.ops.lightfield_gs.render_images(*m, *fixed),
            lambda *m: reference.dense_torch(*m, *fixed),
        )
    else:
        moving, fixed = lens_inputs(scene, width_px=50, height_px=40, cone_deg=12.0)
        shown = panel(width_px=50, height_px=40, cone_deg=12.0)
        got, want = (
            lambda *m: [torch.ops.lightfield_gs.render_direct(*m, *fixed)],
            lambda *m: [reference.lens_torch(*m, shown, rig(shown, 0.1, -0.15), continuous=True, antialiased=True)],
        )
    results = []
    for draw in (got, want):
        outputs, random = draw(*moving), torch.Generator().manual_seed(7)
        loss = sum((out * torch.randn(out.shape, dtype=torch.float64, generator=random)).sum() for out in outputs)
        results.append(torch.autograd.grad(loss, moving))
    for have, true in zip(*results):
        assert true.abs().max() > 0 and have.isfinite().all()
        torch.testing.assert_close(have, true, rtol=1e-5, atol=1e-6 * float(true.abs().max()))


def test_what_has_no_area_is_not_drawn_and_has_no_gradient():
    scene = fine_scene("specks", 3)
    scene.scales *= torch.tensor([1e-30, 1.0, 1e-30])
    shown = panel()
    leaves = [field.requires_grad_() for field in scene.fields().values()]
    image = encode(Gaussians(*leaves), shown, rig(shown), output="float64", antialiased=True)
    views = render(Gaussians(*leaves), rig(shown).cameras(shown).select([0, 5]), antialiased=True).image
    assert (image == 1).all() and (views == 1).all()
    assert all(not g.any() for g in torch.autograd.grad(image.sum() + views.sum(), leaves))


def test_an_encoder_and_pruning_do_the_same():
    shown, scene = panel(), fine_scene(degree=1).to(torch.float32)
    fan = rig(shown)
    want = encode(scene, shown, fan, antialiased=True)
    encoder = Encoder(shown, fan, antialiased=True)
    assert torch.equal(encoder(scene), want) and torch.equal(encoder(scene), want)
    kept = prune(scene, shown, fan, 1e-3, antialiased=True)
    assert 0 < kept.count < prune(scene, shown, fan, 1e-3).count  # fainter, so that more may go
    pruned = encode(kept, shown, fan, output="float32", antialiased=True)
    assert (pruned - encode(scene, shown, fan, output="float32", antialiased=True)).abs().mean() <= 1e-3 + 1e-4


def test_operators_are_registered_as_torch_wants_them():
    moving, fixed = lens_inputs(fine_scene(count=5), width_px=9, height_px=5)
    torch.library.opcheck(torch.ops.lightfield_gs.render_direct, (*moving, *fixed))
    moving, fixed = dense_inputs(fine_scene(count=5), 9, 5)
    torch.library.opcheck(torch.ops.lightfield_gs.render_images_with_state, (*moving, *fixed))


def test_the_option_is_true_or_false():
    shown, scene = panel(), fine_scene()
    with pytest.raises(InputError, match="antialiased"):
        encode(scene, shown, rig(shown), antialiased=1)


def test_a_3d_filter_is_part_of_its_gaussians(folder, capsys):
    """As Mip-Splatting stores it: wider by the filter, fainter by as much."""
    names = (
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
        "filter_3D",
    )
    rows = np.zeros((2, len(names)), "<f4")
    rows[:, 2], rows[:, 6], rows[:, 10] = 2, (0, 3), 1
    rows[:, 7:10], rows[:, 14] = np.log([[0.03, 0.4, 0.01], [1, 2, 3]]), (0.04, 0)

    def write(name: str) -> None:
        header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
        header += "".join(f"property float {column}\n" for column in names) + "end_header\n"
        (folder / name).write_bytes(header.encode() + rows.tobytes())

    write("mip.ply")
    scene = Gaussians.load("mip.ply")
    wide = [0.05, math.hypot(0.4, 0.04), math.hypot(0.01, 0.04)]
    assert scene.scales.tolist() == [pytest.approx(wide), pytest.approx([1, 2, 3])]
    opacity = 0.5 * 0.03 * 0.4 * 0.01 / math.prod(wide)
    assert scene.opacities.tolist() == pytest.approx([opacity, 1 / (1 + math.exp(-3))])
    assert cli.main("encode mip.ply -o o.png --panel p.yaml --antialiased".split()) == 0
    assert "filter_3D of Mip-Splatting was applied" in capsys.readouterr().err
    rows[1, 14] = np.nan
    write("mip.ply")
    with pytest.raises(InputError, match="filter_3D of Gaussian 1 is nan"):
        Gaussians.load("mip.ply")


def test_the_commands_take_the_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown, scene = panel(width_px=96, height_px=54), fine_scene().to(torch.float32)
    rig(shown).to_yaml("rig.yaml"), shown.to_yaml("panel.yaml"), scene.save("scene.ply")
    stored, fan = Gaussians.load("scene.ply"), Rig.from_yaml("rig.yaml")
    common = "--panel panel.yaml --rig rig.yaml --device cpu --antialiased"
    assert cli.main(f"encode scene.ply -o made.png --preview views {common}".split()) == 0
    made, metadata = read_image("made.png", as_stored=True), read_info("made.png").metadata
    assert np.array_equal(made, encode(stored, shown, fan, antialiased=True).numpy())
    assert json.loads(metadata["encoding"])["antialiased"] is True
    sheets = [contact_sheet(look_around(stored, shown, fan, antialiased=antialiased)) for antialiased in (True, False)]
    assert np.array_equal(read_image("views/views.png", as_stored=True), sheets[0]) and not np.array_equal(*sheets)
    assert cli.main(f"prune scene.ply -o less.ply --contribution-cut 1e-3 {common}".split()) == 0
    assert torch.equal(Gaussians.load("less.ply").means, prune(stored, shown, fan, 1e-3, antialiased=True).means)
