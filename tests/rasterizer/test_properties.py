"""Any valid scene, panel and rig: the public API gives finite numbers, and the oracle's within the stated bounds."""

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rasterizer_cases import all_subpixels, random_scene, turned_pose

from lightfield_gs import Encoder, Gaussians, InputError, Panel, Rig, encode, from_depth, interlace, reference, render
from lightfield_gs.panels.simulate import simulate

EXACT, SINGLE = 1e-8, 5e-4  # bounds of float64 and float32
CERTAIN, SETTLED = 1e-6, 5e-3  # margins from which on every precision decides alike
TRIED = settings(deadline=None, max_examples=60, derandomize=True, suppress_health_check=list(HealthCheck))


def real(low, high):
    return st.floats(low, high, allow_nan=False, width=64)


@st.composite
def scenes(draw, least=0):
    """Of any size, degree, place and shape; some behind, some with a field at an end of its range."""
    scene = random_scene(
        draw(st.integers(least, 30)),
        draw(st.integers(0, 3)),
        draw(st.integers(0, 10**6)),
        depth=draw(real(-1, 6)),
        extent=draw(real(1e-6, 3)),
        size=10 ** draw(real(-6, 1)),
        dtype=torch.float32,
    )
    if draw(st.booleans()):
        scene.opacities[:] = draw(st.sampled_from([0.0, 1e-30, 1 / 255, 0.99, 1.0]))
    if draw(st.booleans()):
        scene.scales[:, draw(st.integers(0, 2))] *= 10 ** draw(real(-6, 2))
    if draw(st.booleans()):
        scene.quaternions *= 10 ** draw(real(-15, 15))
    return scene


@st.composite
def panels(draw, **changes):
    slant = draw(st.one_of(st.just(0.0), real(-3, 3)))
    line_number = draw(st.one_of(real(0.5, 60), real(1e-2, 1e4)))
    return Panel(
        **{
            **dict(
                width_px=draw(st.integers(1, 40)),
                height_px=draw(st.integers(1, 30)),
                views=draw(st.integers(1, 300)),
                line_number=line_number,
                slant_tan=slant,
                phase=draw(real(-1e4, 1e4)),
                cone_deg=draw(real(0.1, 120)),
                subpixel_order=draw(st.sampled_from(["RGB", "BGR"])),
                invert_views=draw(st.booleans()),
            ),
            **changes,
        }
    )


@st.composite
def rigs(draw, shown):
    focal = draw(real(0.3, 4)) * max(shown.width_px, shown.height_px)
    return Rig(
        turned_pose(draw(real(-3, 3)), draw(real(-1, 1))),
        (focal, focal * draw(real(0.5, 2))),
        (shown.width_px * draw(real(-0.5, 1.5)), shown.height_px * draw(real(-0.5, 1.5))),
        draw(real(0.1, 10)),
        draw(st.none() | real(0.1, 120)),
    )


backgrounds = st.tuples(real(0, 1), real(0, 1), real(0, 1))


def compare(found, want, margin, bound, settled):
    found = np.asarray(found)
    assert np.isfinite(found).all()
    assert np.abs(found - want)[margin > settled].max(initial=0) <= bound


def told_apart(scene, fan):
    """Whether no two Gaussians are so near each other in depth that the rounding of single precision may swap them."""
    row, away = fan.world_to_camera[2, :3], fan.world_to_camera[2, 3]
    terms = scene.means.double().numpy() * row
    rounding = 2.0**-21 * (np.abs(terms).sum(1).max(initial=0) + abs(away))
    return np.diff(np.sort(terms.sum(1))).min(initial=np.inf) > rounding


def at_a_border(shown):
    """Sub-pixels less than 2^-45 lens widths below the border of two views (Panel.phase_steps).

    The panel's phases, rounded up, are on the border.
    """
    places = all_subpixels(shown)
    x, view = (reference.lens_views(shown, *places, continuous=continuous) for continuous in (True, False))
    return (np.floor(x) + 1 - x <= shown.views * 2.0**-44) | (np.floor(x) != np.floor(view))


@TRIED
@given(data=st.data())
def test_encode(data):
    scene, shown, background = data.draw(scenes()), data.draw(panels()), data.draw(backgrounds)
    fan, views = data.draw(rigs(shown)), data.draw(st.sampled_from(["integer", "continuous"]))
    want, margin = reference.subpixel_colours(
        scene,
        shown,
        fan,
        *all_subpixels(shown),
        background=background,
        continuous=views == "continuous",
        return_margin=True,
    )
    shared = dict(views=views, background=background)
    margin[at_a_border(shown)] = 0
    settled = SETTLED if told_apart(scene, fan) else np.inf
    # The colours of direct are polynomials over the rig, whose error it estimates
    exact = encode(scene, shown, fan, output="float64", stats=(stats := {}), **shared)
    compare(exact.ravel(), want, margin, EXACT + 4 * stats["colour_error"], CERTAIN)
    single = encode(scene, shown, fan, output="float32", stats=stats, **shared)
    compare(single.ravel(), want, margin, bound := SINGLE + 4 * stats["colour_error"], settled)
    if views == "integer":
        for method in ("sorted", "classic"):
            exact = encode(scene, shown, fan, method, output="float64", **shared)
            compare(exact.ravel(), want, margin, EXACT, CERTAIN)
    image = Encoder(shown, fan, **shared)(scene).ravel()
    compare(image, 255 * want.clip(0, 1), margin, 0.5 + 255 * bound, settled)


@TRIED
@given(data=st.data())
def test_render_and_interlace(data):
    scene, shown, background = data.draw(scenes()), data.draw(panels(views=3)), data.draw(backgrounds)
    cameras = data.draw(rigs(shown)).cameras(shown)
    image, alpha, depth, _ = render(scene.to(torch.float64), cameras, background=background, alpha=True, depth=True)
    for camera in range(3):
        want, margin = reference.pixel_colours(
            scene, cameras, camera, *all_subpixels(shown), background=background, return_margin=True
        )
        compare(image[camera].ravel(), want, margin, EXACT, CERTAIN)
    assert torch.isfinite(depth).all() and ((0 <= alpha) & (alpha <= 1)).all()
    seen = depth[alpha > 1e-6]
    positions = scene.means.double() @ cameras.world_to_camera[0, :3, :3].T + cameras.world_to_camera[0, :3, 3]
    if len(seen):
        assert positions[:, 2].min() - 1e-6 <= seen.min() and seen.max() <= positions[:, 2].max() + 1e-6
    shown_views = shown.view_map()
    rows, columns, channels = np.indices(shown_views.shape)
    assert np.array_equal(interlace(image, shown).numpy(), image.numpy()[shown_views, rows, columns, channels])


@TRIED
@given(data=st.data())
def test_a_picture_through_the_lenses_lies_within_its_colours(data):
    shown = data.draw(
        panels(
            width_px=60,
            height_px=40,
            line_number=data.draw(real(1.5, 10)),
            viewing_distance_mm=data.draw(real(100, 5000)),
            pixel_pitch_mm=data.draw(real(0.02, 0.5)),
        )
    )
    colours = np.random.default_rng(data.draw(st.integers(0, 99))).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    eye = [data.draw(real(-500, 500)), data.draw(real(-500, 500)), data.draw(real(50, 5000))]
    spread = data.draw(real(0.2, 5))
    try:
        picture = simulate(colours, shown, eye, spread)
    except InputError as error:
        assert "lens gap" in str(error)  # an inverted panel's lenses stand before it: no eye fits between
        return
    assert np.isfinite(picture).all() and picture.min() >= -1e-5 and picture.max() <= 1 + 1e-5
    flat = np.broadcast_to(np.array([0.25, 0.5, 0.75], np.float32), colours.shape)
    assert simulate(flat, shown, eye, spread) == pytest.approx(np.broadcast_to(flat[0, 0], picture.shape), abs=1e-4)


@TRIED
@given(data=st.data())
def test_panels_and_rigs_survive_their_files(data, tmp_path_factory):
    shown, folder = data.draw(panels()), tmp_path_factory.mktemp("files", numbered=True)
    fan = data.draw(rigs(shown))
    shown.to_yaml(folder / "panel.yaml")
    fan.to_yaml(folder / "rig.yaml")
    again = Panel.from_yaml(folder / "panel.yaml")
    assert again == shown == Panel(**shown.to_dict()) and again.phase_steps() == shown.phase_steps()
    assert Rig.from_yaml(folder / "rig.yaml").to_dict() == fan.to_dict()
    view_map, x = shown.view_map(), shown.view_map(continuous=True)
    assert 0 <= view_map.min() and view_map.max() < shown.views and 0 <= x.min() and x.max() < shown.views
    places = all_subpixels(shown)
    want = reference.lens_views(shown, *(part[::17] for part in places), continuous=True)
    turns = np.abs(x.ravel()[::17] - want)
    assert np.minimum(turns, shown.views - turns).max() <= 1e-9 * shown.views


@TRIED
@given(data=st.data())
def test_gaussians_survive_their_file(data, tmp_path_factory):
    scene, path = data.draw(scenes(least=1)), tmp_path_factory.mktemp("files", numbered=True) / "scene.ply"
    scene.opacities.clamp_(1e-6, 1 - 1e-6)  # kept as logits
    scene.save(path)
    for field, value in Gaussians.load(path).fields().items():
        if field == "quaternions":
            unit, value = (q.double() / q.double().norm(dim=1, keepdim=True) for q in (scene.quaternions, value))
            assert value.numpy() == pytest.approx(unit.numpy(), abs=1e-5)
        else:
            assert value.numpy() == pytest.approx(getattr(scene, field).numpy(), rel=1e-5, abs=1e-6)


@TRIED
@given(data=st.data())
def test_a_depth_map_becomes_gaussians_at_its_points(data):
    height, width, seed = data.draw(st.integers(1, 24)), data.draw(st.integers(1, 24)), data.draw(st.integers(0, 10**6))
    random, far = np.random.default_rng(seed), 10 ** data.draw(real(-6, 6))
    image = random.uniform(0, 1, (height, width, data.draw(st.sampled_from([3, 4])))).astype(np.float32)
    depth = (far * random.choice([1.0, 1.1, 5.0, 0.0], (height, width), p=[0.5, 0.3, 0.1, 0.1])).astype(np.float32)
    depth[0, 0], image[0, 0] = far, 1
    focal = data.draw(real(0.5, 4)) * max(width, height)
    scene = from_depth(image, depth, (focal, focal)).validate()
    assert (scene.means[:, 2] > 0).all() and scene.means[:, 2].max() <= 6 * far
    measured = int(((depth > 0) & (image[..., 3] >= 1 / 255 if image.shape[2] == 4 else True)).sum())
    assert 1 <= scene.count and abs(scene.means[0, 2] / far - 1) < 5
    assert scene.count >= 0.5 * measured
    size = dict(width_px=width, height_px=height, views=1, line_number=3.0, slant_tan=0.0)
    seen = encode(scene, Panel(**size), Rig(np.eye(4), (focal, focal), (width / 2, height / 2), far), output="float32")
    assert torch.isfinite(seen).all()
