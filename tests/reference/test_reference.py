"""The float64 oracle against closed forms, and against an oracle written by others."""

import math
import sys

import numpy as np
import pytest
import torch
from panel_cases import template_panel

from lightfield_gs import reference
from lightfield_gs.base.harmonics import harmonics, rotations
from lightfield_gs.bench.scenes import cloud, sheet
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.reference.blend import Projection, Scene
from lightfield_gs.scene.gaussians import Gaussians

PANEL = template_panel(64, 48, 8, phase=-3.25)
RIG = Rig(np.eye(4), (64, 70), (30.5, 25.25), 2.0)
SH_CONSTANT = math.sqrt(1 / (4 * math.pi))


def balls(*rows) -> Gaussians:
    """Round grey Gaussians: rows of x, y, z, standard deviation, opacity, colour."""
    table = torch.tensor(rows, dtype=torch.float64)
    sh = ((table[:, 5] - 0.5) / SH_CONSTANT)[:, None, None].expand(-1, 1, 3)
    return Gaussians(
        table[:, :3],
        torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(len(rows), 4),
        table[:, 3:4].expand(-1, 3),
        table[:, 4],
        sh,
    )


def at(gaussians, row, column, channel=0, **options):
    return reference.subpixel_colours(gaussians, PANEL, RIG, [row], [column], [channel], **options)[0]


def seen_from(place, row, column):
    """The view offset of a sub-pixel by the printed formula, in floating point."""
    across = 3 * column + 3 * row * PANEL.slant_tan + place + PANEL.phase
    view = math.floor((across / PANEL.line_number) % 1 * PANEL.views)
    return 2 * RIG.zero_depth * math.tan(math.radians(20)) * (0.5 - (view + 0.5) / PANEL.views)


@pytest.mark.parametrize("depth", [1.5, 2.0, 3.1])
def test_a_ball_on_the_axis_is_a_round_spot_moved_by_its_parallax(depth):
    row, column, channel, sigma, opacity, colour = 24, 33, 2, 0.05, 0.8, 0.3
    s = seen_from(channel, row, column)
    u = 64 * (0 - s) / depth + 30.5 + 64 * s / 2.0
    tx = -s
    xx = (64 / depth * sigma) ** 2 * (1 + (tx / depth) ** 2) + 0.3
    yy = (70 / depth * sigma) ** 2 + 0.3
    alpha = opacity * math.exp(-0.5 * ((column + 0.5 - u) ** 2 / xx + (row + 0.5 - 25.25) ** 2 / yy))
    expected = alpha * colour + (1 - alpha) if alpha >= 1 / 255 else 1.0
    assert at(balls((0, 0, depth, sigma, opacity, colour)), row, column, channel) == pytest.approx(expected, abs=1e-12)


def test_blending_goes_from_near_to_far_and_stops_before_it_is_opaque():
    # Balls wide enough to have one alpha everywhere: transmittance falls to 0.02, 4e-4, and would fall to 8e-6.
    wide = [(0, 0, z, 1e4, 0.98, colour) for z, colour in ((3.0, 0.1), (1.0, 0.9), (2.0, 0.5))]
    expected = 0.98 * 0.9 + 0.02 * 0.98 * 0.5 + 4e-4 * 0.2
    assert at(balls(*wide), 20, 20, background=(0.2, 0.2, 0.2)) == pytest.approx(expected, abs=1e-6)


def test_alpha_is_at_most_099():
    assert at(balls((0, 0, 2, 1e4, 1.0, 0)), 20, 20) == pytest.approx(0.01, abs=1e-9)


@pytest.mark.parametrize(
    "row, drawn",
    [
        ((0, 0, 0.0099, 0.5, 0.9, 0), False),
        ((0, 0, 0.0101, 0.5, 0.9, 0), True),
        ((0, 0, 2, 50, 0.0039, 0), False),
        ((0, 0, 2, 50, 0.004, 0), True),
        ((0, 0, -2, 0.5, 0.9, 0), False),
    ],
)
def test_what_is_too_near_or_too_faint_is_not_drawn(row, drawn):
    assert (at(balls(row), 25, 30) < 1) == drawn


def test_equal_depths_keep_their_order():
    colour = [at(balls((0, 0, 2, 1, 0.6, a), (0, 0, 2, 1, 0.6, b)), 25, 30) for a, b in ((0.0, 1.0), (1.0, 0.0))]
    assert colour[0] < colour[1]


def test_margin_tells_how_near_a_threshold_is():
    for opacity, margin in ((1.01 / 255, 0.01), (0.5, 0.1)):
        _, found = reference.subpixel_colours(
            balls((0, 0, 2, 1e4, opacity, 0)), PANEL, RIG, [25], [30], [0], return_margin=True
        )
        assert found[0] == pytest.approx(margin, abs=1e-4)


def test_harmonics_are_orthonormal():
    # Gauss-Legendre in z times the trapezium rule in azimuth integrates products up to degree 6 exactly.
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    ring = np.sqrt(1 - z**2)[:, None]
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), z[:, None] + 0 * angle], -1).reshape(-1, 3)
    basis = harmonics(torch.from_numpy(points), 16).numpy()
    gram = (basis * np.repeat(weight, 16)[:, None] * 2 * np.pi / 16).T @ basis
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)
    # The signs of 3DGS: (-1)^m, orders from -l to l.
    signs = harmonics(torch.tensor([[1.0, 2.0, 4.0]], dtype=torch.float64) / math.sqrt(21), 16)[0].sign()
    assert signs.tolist() == [1, -1, 1, -1, 1, -1, 1, -1, -1, 1, 1, -1, 1, -1, -1, 1]


def test_footprint_is_the_jacobian_of_the_projection():
    torch.manual_seed(3)
    scene = Scene(
        torch.tensor([[0.3, -0.2, 1.7]], dtype=torch.float64),
        torch.randn(1, 4, dtype=torch.float64),
        torch.rand(1, 3, dtype=torch.float64),
        torch.ones(1),
        torch.zeros(1, 1, 3),
    )
    eye = reference.rig_eye(PANEL, RIG)
    s = torch.tensor([0.21], dtype=torch.float64)

    def image(point):
        x, y, z = point
        return torch.stack([64 * (x - s[0]) / z + 30.5 + 32 * s[0], 70 * y / z + 25.25])

    projection = Projection(scene, eye)
    jacobian = torch.autograd.functional.jacobian(image, scene.means[0])
    rotation = rotations(scene.quaternions)[0]
    covariance = jacobian @ rotation @ torch.diag(scene.scales[0] ** 2) @ rotation.T @ jacobian.T
    u, v, across, down = (value[..., 0] for value in projection.footprint(torch.tensor([0]), s))
    xx, xy, yy = (float(a @ b) for a, b in ((across, across), (across, down), (down, down)))
    assert (u, v) == pytest.approx(tuple(image(scene.means[0]).tolist()))
    assert (xx, xy, yy) == pytest.approx((covariance[0, 0].item(), covariance[0, 1].item(), covariance[1, 1].item()))


def test_jacobian_is_clamped_against_the_union_of_the_frusta():
    # Far outside, to the right: t_x is held at 30 % of the half width beyond the widest view's frustum.
    scene = Scene.from_gaussians(balls((30.0, 0, 1.0, 0.4, 0.9, 0)))
    projection = Projection(scene, reference.rig_eye(PANEL, RIG))
    limit = (64 - 30.5) / 64 + 0.15 + math.tan(math.radians(20))
    _, _, across, _ = projection.footprint(torch.tensor([0]), torch.tensor([0.25], dtype=torch.float64))
    assert float(across[:, 0] @ across[:, 0]) == pytest.approx((64 * 0.4) ** 2 * (1 + (limit - 0.25) ** 2))


def test_lens_views_of_the_toy_panel():
    toy = Panel(
        width_px=8, height_px=7, views=8, line_number=1.002 * 0.6 / (math.cos(math.atan(1 / 6)) * 0.06), slant_tan=1 / 6
    )
    rows, columns, channels = [0, 0, 1, 2, 6], [3, 3, 0, 1, 7], [1, 2, 0, 0, 2]
    x = reference.lens_views(toy, rows, columns, channels, continuous=True)
    np.testing.assert_allclose(x, [7.875401, 0.662941, 0.393770, 3.150160, 4.476042], atol=1e-6)
    first = reference.lens_views(toy, [0] * 6, [0, 0, 0, 1, 1, 1], [0, 1, 2] * 2) - 0.5
    assert first.tolist() == [0, 0, 1, 2, 3, 3]


def test_lens_and_cameras_tell_the_same():
    gaussians = cloud(400, seed=5)
    random = np.random.default_rng(6)
    rows, columns, channels = random.integers(0, 48, 300), random.integers(0, 64, 300), random.integers(0, 3, 300)
    lens = reference.subpixel_colours(gaussians, PANEL, RIG, rows, columns, channels)
    view = (reference.lens_views(PANEL, rows, columns, channels) - 0.5).astype(int)
    cameras = RIG.cameras(PANEL)
    for n in range(PANEL.views):
        here = view == n
        dense = reference.pixel_colours(gaussians, cameras, n, rows[here], columns[here], channels[here])
        np.testing.assert_allclose(dense, lens[here], atol=1e-12)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_samples_on_a_gpu_are_those_on_the_cpu():
    random = np.random.default_rng(3)
    places = [random.integers(0, size, 500) for size in (48, 64, 3)]
    gaussians = cloud(300)
    here, there = (reference.subpixel_colours(g, PANEL, RIG, *places) for g in (gaussians, gaussians.to("cuda")))
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-12)


def test_whole_images_agree_with_chosen_samples():
    gaussians = sheet(12)
    fields = [field.double() for field in gaussians.fields().values()]
    image = reference.lens_torch(*fields, torch.ones(3, dtype=torch.float64), PANEL, RIG)
    rows, columns, channels = (index.ravel() for index in np.indices(image.shape))
    chosen = reference.subpixel_colours(gaussians, PANEL, RIG, rows, columns, channels)
    np.testing.assert_allclose(image.numpy().ravel(), chosen, atol=1e-12)


CASES = {
    "plain": ("sheet", 0, {}, None, False),
    "harmonics": ("cloud", 3, {"cone_deg": 53.0}, None, False),
    "leaning the other way, BGR": ("sheet", 1, dict(slant_tan=-0.18, subpixel_order="BGR", phase=-7.25), None, False),
    "inverted, continuous": ("cloud", 2, {"invert_views": True}, None, True),
    "turned, off-centre": ("cloud", 1, {"views": 45, "line_number": 19.17}, (0.1, -0.2), False),
    "one view": ("sheet", 0, {"views": 1}, None, False),
    "few sub-pixels": ("sheet", 2, {"views": 9, "line_number": 2.6}, None, True),
}


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_the_acceptance_oracle(shared_dir, case, monkeypatch):
    monkeypatch.syspath_prepend(str(shared_dir / "acceptance"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    import oracle

    kind, degree, changes, turn, continuous = CASES[case]
    panel = (
        dict(
            width_px=300,
            height_px=160,
            views=96,
            line_number=9.848282191911,
            slant_tan=1 / 6,
            phase=-2161.204484657574,
            subpixel_order="RGB",
            invert_views=False,
            cone_deg=40.0,
        )
        | changes
    )
    gaussians = sheet(32, 4) if kind == "sheet" else cloud(1500, 4)
    torch.manual_seed(7)
    gaussians.sh = torch.cat([gaussians.sh, 0.2 * torch.randn(gaussians.count, (degree + 1) ** 2 - 1, 3)], 1)
    matrix = np.eye(4)
    if turn:
        a, b = turn
        matrix[:3, :3] = np.array(
            [[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]]
        ) @ np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
        matrix[:3, 3] = [0, 0, 2] - matrix[:3, :3] @ [0, 0, 2]
    rig = Rig(matrix, (300, 310), (155, 71), 2.0)

    rows, columns, channels = oracle.random_subpixels(panel, 3000, 9)
    places = channels if panel["subpixel_order"] == "RGB" else 2 - channels
    x = oracle.view_of(panel, rows, columns, places, continuous)
    s = oracle.offset(panel, rig.to_dict(), x if continuous else x + 0.5)
    names = ("means", "quats", "scales", "opacities", "sh")
    theirs = {name: field.double().numpy() for name, field in zip(names, gaussians.fields().values())}
    background = (0.9, 0.4, 0.1)
    want, edge = oracle.colours(theirs, rig.to_dict(), columns + 0.5, rows + 0.5, s, channels, background)
    got, margin = reference.subpixel_colours(
        gaussians,
        Panel(**panel),
        rig,
        rows,
        columns,
        channels,
        continuous=continuous,
        background=background,
        return_margin=True,
    )
    np.testing.assert_allclose(got, want, atol=1e-12)
    # The other oracle does not look as far below the cut at 1/255, so that it may miss a near one.
    assert (margin <= np.minimum(edge, 0.1) + 1e-9).all()
    assert np.mean(np.abs(np.minimum(margin, 0.004) - np.minimum(edge, 0.004)) > 1e-9) < 0.01
