"""The light-field image: every sub-pixel of usual and unusual panels against the oracle, and method against method."""

import numpy as np
import pytest
import torch
from rasterizer_cases import PANELS, all_subpixels, hard_scene, panel, random_scene, rig

from lightfield_gs import Encoder, encode, interlace, reference, render
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench.scenes import cloud, load_scene, sheet
from lightfield_gs.scene.gaussians import Gaussians

BACKGROUND = (0.1, 0.6, 0.3)
SETTLED = 2e-3  # samples whose decisions came nearer to a threshold than this may differ in float32
METHODS = ("direct", "sorted", "classic")
VIEWS = ("integer", "continuous")


def oracle(gaussians, panel, rig, continuous=False, background=BACKGROUND):
    colours, margins = reference.subpixel_colours(
        gaussians, panel, rig, *all_subpixels(panel), continuous=continuous, background=background, return_margin=True
    )
    shape = panel.height_px, panel.width_px, 3
    return colours.reshape(shape), margins.reshape(shape)


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize("name", PANELS)
def test_every_subpixel_of_unusual_panels(name, views):
    shown, gaussians = panel(name), random_scene(60, seed=len(name))
    fan = rig(shown, 0.1, -0.15, (0.53, 0.44))
    want, margin = oracle(gaussians, shown, fan, views == "continuous")
    exact = encode(gaussians, shown, fan, views=views, background=BACKGROUND, output="float64")
    assert exact.dtype == torch.float64 and exact.shape == want.shape
    error = np.abs(exact.numpy() - want)
    assert error[margin > 1e-9].max() < 1e-9
    single = encode(gaussians.to(torch.float32), shown, fan, views=views, background=BACKGROUND, output="float32")
    assert single.dtype == torch.float32
    error = np.abs(single.numpy() - want)
    assert error[margin > SETTLED].max() < 4e-4


@pytest.mark.parametrize("name", ["default lens", "very wide cone", "inverted", "narrower than a pixel", "wide lenses"])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_follow_the_view(name, degree):
    shown, gaussians = panel(name), random_scene(50, degree, seed=degree)
    fan = rig(shown, -0.2, 0.1)
    want, margin = oracle(gaussians, shown, fan)
    stats = {}
    exact = encode(gaussians, shown, fan, background=BACKGROUND, output="float64", stats=stats).numpy()
    assert stats["colour_error"] <= 2e-4
    assert np.abs(exact - want)[margin > 1e-9].max() < 2 * stats["colour_error"] + 1e-9
    single = encode(gaussians.to(torch.float32), shown, fan, background=BACKGROUND, output="float32").numpy()
    assert np.abs(single - want)[margin > SETTLED].max() < 5e-4
    assert np.abs(encode_black(gaussians, shown, fan) - want).max() > 0.05  # harmonics matter in this scene


def encode_black(gaussians, shown, fan):
    plain = Gaussians(*(field for name, field in gaussians.fields().items() if name != "sh"), gaussians.sh[:, :1])
    return encode(plain, shown, fan, background=BACKGROUND, output="float64").numpy()


@pytest.mark.parametrize("kind", ["clamped", "needles", "huge", "opaque", "specks", "near and far"])
def test_gaussians_that_are_hard(kind):
    scene = hard_scene(kind, 40, seed=3)
    shown = panel("very wide cone")
    fan = rig(shown, 0.1)
    want, margin = oracle(scene, shown, fan)
    exact = encode(scene, shown, fan, background=BACKGROUND, output="float64").numpy()
    assert np.abs(exact - want)[margin > 1e-7].max() < 1e-5
    single = encode(scene.to(torch.float32), shown, fan, background=BACKGROUND, output="float32").numpy()
    assert np.abs(single - want)[margin > 5e-3].max() < 2e-3


@pytest.mark.parametrize("method", METHODS)
def test_eight_bits_are_the_rounded_floats(method):
    shown, gaussians = panel(), random_scene(80, 1, seed=4).to(torch.float32)
    fan = rig(shown)
    floats = encode(gaussians, shown, fan, method, output="float32")
    bytes8 = encode(gaussians, shown, fan, method)
    assert bytes8.dtype == torch.uint8
    step = (255 * floats.clamp(0, 1) - bytes8.float()).abs()
    assert step.max() <= 0.5 + 1e-4


@pytest.mark.parametrize("scene, cone", [("sheet", 5.0), ("sheet", 40.0), ("cloud", 5.0), ("cloud", 40.0)])
def test_direct_and_classic_give_the_same_picture(scene, cone):
    shown = panel(width_px=480, height_px=240, cone_deg=cone)
    gaussians = sheet(64) if scene == "sheet" else cloud(8000)
    fan = rig(shown)
    direct, classic = (
        encode(gaussians, shown, fan, method, output="float32").numpy() for method in ("direct", "classic")
    )
    off = np.argwhere(np.abs(direct - classic) > 1 / 255)
    if len(off):
        _, margin = reference.subpixel_colours(gaussians, shown, fan, *off.T, return_margin=True)
        assert margin.max() < SETTLED
    assert len(off) <= 1e-5 * direct.size


@pytest.mark.parametrize("scene", ["sheet:64", "cloud:4000"])
@pytest.mark.parametrize("cone", [2.0, 5.0, 10.0, 40.0])
def test_short_cuts_for_narrow_cones_do_not_show(scene, cone):
    shown = panel(width_px=480, height_px=240, cone_deg=cone)
    single, exact = (encode(load_scene(scene), shown, rig(shown), output=f"float{bits}").numpy() for bits in (32, 64))
    error = np.abs(single - exact)
    assert error.mean() < 1e-6 and error.max() < 1 / 255  # at 8 bits a mean error of 2.5e-6 becomes 80 dB


def test_direct_and_classic_give_the_same_harmonics():
    shown, gaussians = panel("very wide cone"), random_scene(50, 3, seed=9)
    direct, classic = (
        encode(gaussians, shown, rig(shown), method, output="float64") for method in ("direct", "classic")
    )
    assert (direct - classic).abs().max() < 1e-5


@pytest.mark.parametrize("name", PANELS)
def test_interlace_takes_each_subpixel_from_its_view(name):
    shown = panel(name)
    shown = panel(name, views=min(shown.views, 9))
    random = np.random.default_rng(0)
    views = random.integers(0, 256, (shown.views, shown.height_px, shown.width_px, 3), np.uint8)
    expected = np.take_along_axis(views, shown.view_map()[None].astype(np.int64), 0)[0]
    assert np.array_equal(interlace(torch.from_numpy(views), shown).numpy(), expected)
    floats = views.astype(np.float32) / 255
    assert np.array_equal(interlace(torch.from_numpy(floats), shown).numpy(), expected.astype(np.float32) / 255)


def test_classic_is_render_and_interlace():
    shown = panel(views=7)
    fan, gaussians = rig(shown, 0.1), random_scene(40, 2, seed=5)
    views = render(gaussians, fan.cameras(shown), background=BACKGROUND).image
    classic = encode(gaussians, shown, fan, "classic", background=BACKGROUND, output="float64")
    assert (interlace(views, shown) - classic).abs().max() < 1e-12


@pytest.mark.parametrize("views", VIEWS)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["none", "behind", "outside", "faint"])
def test_nothing_to_draw_leaves_the_background(method, views, kind):
    shown, scene = panel(), random_scene(0 if kind == "none" else 30, 1)
    if kind == "behind":
        scene.means[:, 2] -= 9
    elif kind == "outside":
        scene.means[:, 1] += 50
    elif kind == "faint":
        scene.opacities[:] = 0.003
    stats = {}
    image = encode(scene, shown, rig(shown), method, views=views, background=BACKGROUND, output="float64", stats=stats)
    assert torch.equal(image, torch.tensor(BACKGROUND, dtype=torch.float64).expand_as(image))
    assert stats["pairs"] == 0 and stats["evaluations"] == 0 and stats["gaussians_culled"] == scene.count
    if method == "direct":
        reasons = {"behind": 0, "faint": 0, "pruned": 0, "outside": 0} | ({kind: 30} if kind != "none" else {})
        assert stats["skipped"]["gaussians"] == reasons and stats["skipped"]["tiles"]["drawn"] == 0
        assert stats["skipped"]["tiles"]["empty"] > 0 and stats["skipped"]["samples_stopped"] == 0


@pytest.mark.parametrize("views", VIEWS)
@pytest.mark.parametrize("method", METHODS)
def test_one_gaussian(method, views):
    shown, scene = panel(), random_scene(1, 2, seed=1, extent=0.1, size=0.3)
    want, margin = oracle(scene, shown, rig(shown), views == "continuous")
    image = encode(scene, shown, rig(shown), method, views=views, background=BACKGROUND, output="float64").numpy()
    assert np.abs(image - want)[margin > 1e-9].max() < 1e-6 and np.ptp(image) > 0.1


@pytest.mark.parametrize("method", METHODS)
def test_same_bits_in_every_run_and_on_any_number_of_threads(method):
    shown, gaussians = panel(), cloud(3000)
    images = [
        encode(gaussians, shown, rig(shown), method, output="float32", threads=threads) for threads in (1, 2, 3, 2)
    ]
    assert all(torch.equal(images[0], image) for image in images[1:])


@pytest.mark.parametrize("method", METHODS)
def test_stats_tell_what_was_done(method):
    shown, gaussians, stats = panel(), cloud(2000), {}
    gaussians.means[:7, 2] = -1
    encode(gaussians, shown, rig(shown), method, stats=stats)
    assert {"plan", "project", "order", "bin", "composite"} <= set(stats["stages_ms"])
    assert ("interlace" in stats["stages_ms"]) == (method == "classic")
    assert all(ms >= 0 for ms in stats["stages_ms"].values())
    assert stats["pairs"] > 0 and stats["work_bytes"] > 0 and stats["evaluations"] > 0
    subpixels = 3 * shown.width_px * shown.height_px
    assert stats["evaluations_per_subpixel"] == pytest.approx(stats["evaluations"] / subpixels)
    if method == "direct":
        assert 7 <= stats["gaussians_culled"] < 2000
        skipped = stats["skipped"]
        assert skipped["gaussians"] == {"behind": 7, "faint": 0, "pruned": 0, "outside": stats["gaussians_culled"] - 7}
        assert skipped["colour_orders"] == [2000 - stats["gaussians_culled"]]
        assert skipped["tiles"]["drawn"] > 0 and skipped["lattices"] == {"fit": 0, "split": 0, "refused": 0}


@pytest.mark.parametrize("output", ["uint8", "float32", "float64"])
def test_an_image_is_drawn_over(output):
    shown, scene = panel(), random_scene(50, 1, dtype=torch.float32)
    expected = encode(scene, shown, rig(shown), output=output)
    out = torch.full_like(expected, 7)
    assert encode(scene, shown, rig(shown), output=output, out=out) is out and torch.equal(out, expected)


def test_stats_count_the_sub_pixels_that_ended_early():
    shown, scene, stats = panel(), random_scene(1, extent=0.01, size=0.3, dtype=torch.float32), {}
    scene.opacities[:], scene.sh[:] = 0.98, -9  # black
    left = encode(scene, shown, rig(shown), output="float64", background=(1, 1, 1))
    four = Gaussians(*(torch.cat([field] * 4) for field in scene.fields().values()))
    encode(four, shown, rig(shown), stats=stats)
    ended = int((left**4 < 1e-4).sum())
    assert ended > 100 and stats["skipped"]["samples_stopped"] == pytest.approx(ended, abs=2)


@pytest.mark.parametrize(
    "change, word",
    [
        ({"method": "sorted-by-hand"}, "method"),
        ({"views": "some"}, "views"),
        ({"output": "int4"}, "output"),
        ({"background": (1, 1)}, "background"),
        ({"background": (1, 1, float("nan"))}, "background"),
        ({"threads": 0}, "threads"),
    ],
)
def test_bad_options_are_named(change, word):
    shown = panel()
    options = {"method": "direct", **change}
    with pytest.raises(InputError, match=word) as error:
        encode(random_scene(3), shown, rig(shown), options.pop("method"), **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "field, value",
    [
        ("means", float("nan")),
        ("scales", -1.0),
        ("opacities", float("inf")),
        ("opacities", 1.5),
        ("quaternions", 0.0),
        ("sh", float("nan")),
    ],
)
def test_bad_gaussians_are_named(field, value):
    scene, shown = random_scene(5), panel()
    scene.fields()[field][3] = value
    for method in METHODS:
        with pytest.raises(InputError, match=field):
            encode(scene, shown, rig(shown), method)


@pytest.mark.parametrize("options", [{}, {"views": "continuous", "background": BACKGROUND, "output": "float32"}])
def test_an_encoder_draws_what_encode_draws(options):
    shown, gaussians = panel("default lens"), random_scene(60)
    fan = rig(shown)
    assert torch.equal(Encoder(shown, fan, **options)(gaussians), encode(gaussians, shown, fan, **options))
    with pytest.raises(InputError, match="views"):
        Encoder(shown, fan, views="some")
