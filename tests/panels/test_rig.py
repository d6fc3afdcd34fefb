"""The fan of cameras and the automatic framing."""

import math

import numpy as np
import pytest
import torch
from panel_cases import plain_panel

from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians

PANEL = plain_panel(480, 240, viewing_distance_mm=1000, pixel_pitch_mm=0.18)


def some_rig(**changes) -> Rig:
    return Rig(
        **{
            **dict(world_to_camera=np.eye(4), focal_px=(480, 500), principal_point_px=(230, 110), zero_depth=2),
            **changes,
        }
    )


def scene(means, scales=0.01, opacities=0.9) -> Gaussians:
    means = torch.tensor(means, dtype=torch.float32)
    count = len(means)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), scales),
        torch.as_tensor(opacities, dtype=torch.float32).expand(count).clone(),
        torch.zeros(count, 1, 3),
    )


def project(rig: Rig, panel: Panel, point, s: float = 0.0) -> np.ndarray:
    """Pixel of a world point in the view with offset s (docs/design.md, "Where the cameras stand")."""
    x, y, z = rig.world_to_camera[:3, :3] @ point + rig.world_to_camera[:3, 3]
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    return np.array([fx * (x - s) / z + cx + fx * s / rig.zero_depth, fy * y / z + cy])


def test_offsets_follow_the_formula():
    rig = some_rig()
    full = 2 * 2 * math.tan(math.radians(20))
    assert rig.offset(0, PANEL) == pytest.approx(full / 2)  # view 0: right-most
    assert rig.offset(8, PANEL) == pytest.approx(-full / 2)
    assert rig.offset(np.array([4.0, 2.0]), PANEL) == pytest.approx([0, full / 4])
    assert rig.offset_range(PANEL) == pytest.approx((-full / 2, full / 2))
    inverted = Panel(**{**PANEL.to_dict(), "invert_views": True})
    assert rig.offset(0, inverted) == pytest.approx(-full / 2)
    assert some_rig(cone_deg=10).half_width(PANEL) == pytest.approx(2 * math.tan(math.radians(5)))


def test_jacobian_limits():
    rig = some_rig()
    widen = math.tan(math.radians(20))
    assert rig.jacobian_limits(PANEL) == pytest.approx(
        (
            -230 / 480 - 0.15 - widen,
            250 / 480 + 0.15 + widen,
            -110 / 500 - 0.15 * 240 / 500,
            130 / 500 + 0.15 * 240 / 500,
        )
    )


def test_cameras_share_the_zero_plane():
    pytest.importorskip("lightfield_gs.scene.cameras")
    rig = some_rig()
    cameras = rig.cameras(PANEL, [0, 3, 7])
    on_plane = np.array([0.3, -0.2, 2.0])
    for number, matrix, focal, centre in zip(
        [0, 3, 7], cameras.world_to_camera.numpy(), cameras.focal_px.numpy(), cameras.principal_point_px.numpy()
    ):
        s = rig.offset(number + 0.5, PANEL)
        assert np.linalg.inv(matrix)[:3, 3] == pytest.approx([s, 0, 0])
        for point in (on_plane, np.array([0.1, 0.1, 3.0])):
            x, y, z = matrix[:3, :3] @ point + matrix[:3, 3]
            pixel = focal * [x / z, y / z] + centre
            assert pixel == pytest.approx(project(rig, PANEL, point, s))
        x, y, z = matrix[:3, :3] @ on_plane + matrix[:3, 3]
        assert focal * [x / z, y / z] + centre == pytest.approx(project(rig, PANEL, on_plane))
    assert cameras.jacobian_limits[:, 4].numpy() == pytest.approx(rig.offset(np.array([0.5, 3.5, 7.5]), PANEL))
    assert len(rig.cameras(PANEL).world_to_camera) == 8
    for views in ([8], [-1]):
        with pytest.raises(InputError, match="views"):
            rig.cameras(PANEL, views)


def test_yaml_round_trip(tmp_path):
    angle = 0.3
    turned = np.eye(4)
    turned[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    turned[:3, 3] = 1e-17, 2e-5, 1 / 3
    for rig in (some_rig(world_to_camera=turned, cone_deg=53), some_rig()):
        rig.to_yaml(tmp_path / "r.yaml")
        again = Rig.from_yaml(tmp_path / "r.yaml")
        assert np.array_equal(again.world_to_camera, rig.world_to_camera)
        assert again.to_dict() == rig.to_dict()


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(world_to_camera=[[1, 0], [0, 1]]), "4 rows"),
        (dict(world_to_camera="eye"), "4 rows"),
        (dict(world_to_camera=np.full((4, 4), math.nan)), "finite"),
        (dict(world_to_camera=2 * np.eye(4)), "last row"),
        (dict(world_to_camera=np.diag([2.0, 2, 2, 1])), "rotation"),
        (dict(world_to_camera=np.diag([-1.0, 1, 1, 1])), "rotation"),
        (dict(focal_px=(0, 1)), "focal_px"),
        (dict(focal_px=480), "two numbers"),
        (dict(focal_px=(1, "a")), "number"),
        (dict(focal_px=(math.inf, 1)), "focal_px"),
        (dict(principal_point_px=(1, 2, 3)), "two numbers"),
        (dict(principal_point_px=(math.nan, 2)), "principal_point_px"),
        (dict(zero_depth=0), "zero_depth"),
        (dict(zero_depth=-2), "zero_depth"),
        (dict(zero_depth=None), "zero_depth"),
        (dict(cone_deg=180), "cone_deg"),
        (dict(cone_deg=math.nan), "cone_deg"),
    ],
)
def test_nonsense_is_refused(change, words):
    with pytest.raises(InputError, match=words):
        some_rig(**change)


def test_bad_yaml(tmp_path):
    path = tmp_path / "r.yaml"
    path.write_text("world_to_camera: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\nfocal: [1, 1]\n")
    with pytest.raises(InputError, match="did you mean 'focal_px'"):
        Rig.from_yaml(path)
    path.write_text("zero_depth: 2\n")
    with pytest.raises(InputError, match="missing world_to_camera, focal_px"):
        Rig.from_yaml(path)


# Framing

RNG = np.random.default_rng(5)
BOX = RNG.uniform(-1, 1, (4000, 3)) * [0.4, 0.5, 0.3] + [3, -2, 7]


@pytest.mark.parametrize("panel", [PANEL, Panel(**{**PANEL.to_dict(), "width_px": 100})])
def test_framing_fits_the_panel(panel):
    rig = Rig.frame(scene(BOX.tolist()), panel)
    pixels = np.array([project(rig, panel, point) for point in BOX])
    low, high = np.percentile(pixels, 1, 0), np.percentile(pixels, 99, 0)
    filled = (high - low) / [panel.width_px, panel.height_px]
    assert 0.8 < filled.max() < 1
    assert (low + high) / 2 == pytest.approx([panel.width_px / 2, panel.height_px / 2], abs=4)
    assert np.array_equal(rig.world_to_camera[:3, :3], np.eye(3)) and rig.focal_px[0] == rig.focal_px[1]


def test_framing_puts_the_zero_plane_at_the_harmonic_mean():
    points = [[0, y, z] for y in (-0.5, 0.5) for z in (1.0, 4.0)] * 50
    rig = Rig.frame(scene(points), PANEL, np.eye(4))
    assert rig.zero_depth == pytest.approx(2 / (1 / 1 + 1 / 4))
    assert np.array_equal(rig.world_to_camera, np.eye(4))


def test_framing_ignores_stray_and_invisible_gaussians():
    stray = np.concatenate([BOX, [[300, 300, -900]] * 10, RNG.uniform(-50, 50, (4000, 3))])
    opacities = np.concatenate([np.full(4010, 0.9), np.full(4000, 0.05)])
    with_stray = Rig.frame(scene(stray.tolist(), opacities=opacities), PANEL)
    without = Rig.frame(scene(BOX.tolist()), PANEL)
    sizes = [np.ptp([project(rig, PANEL, point) for point in BOX], axis=0) for rig in (with_stray, without)]
    assert (sizes[0] > 0.7 * sizes[1]).all()  # at most 15 % of room on each side for the strays
    assert with_stray.zero_depth == pytest.approx(without.zero_depth, rel=0.2)


def test_framing_is_the_same_without_what_is_never_drawn():
    """However much of it there is, and although haze is measured by what is usual."""
    places = np.concatenate([RNG.uniform(-1, 1, (500, 3)), RNG.uniform(-6, 6, (60, 3)), RNG.uniform(-6, 6, (4000, 3))])
    opacities = np.concatenate([np.full(500, 0.9), RNG.uniform(0.07, 0.1, 60), np.full(4000, 0.003)])
    frames = [
        Rig.frame(scene((places[:count] + [0, 0, 7]).tolist(), opacities=opacities[:count]), PANEL)
        for count in (560, 4560)
    ]
    assert frames[0].to_dict() == frames[1].to_dict()


@pytest.mark.parametrize("count, strays", [(20, 0), (20, 2), (3, 0)])
def test_framing_keeps_small_parts(count, strays):
    """A thin stalk high on top of a box is shown whole, also below fewer strays.

    The stalk has a two-hundredth of the scene's Gaussians, or less than a thousandth.
    """
    stalk = RNG.uniform(-1, 1, (count, 3)) * [0.01, 0.05, 0.01] + [3, -2.8, 7]
    rig = Rig.frame(scene(BOX.tolist() + stalk.tolist() + [[3, -40, 7]] * strays), PANEL)
    rows = [project(rig, PANEL, point)[1] for point in stalk]
    assert 0 < min(rows) < 30


def test_framing_natural_field_of_view():
    """A flat scene is seen under the angle that the panel subtends, here 2 atan(240 * 0.5 / 2 / 150) = 43.6 degrees."""
    panel = Panel(**{**PANEL.to_dict(), "pixel_pitch_mm": 0.5, "viewing_distance_mm": 150})
    flat = (BOX * [1, 1, 0]).tolist()
    rig = Rig.frame(scene(flat, scales=1e-6), panel)
    assert math.degrees(2 * math.atan(120 / rig.focal_px[1])) == pytest.approx(43.6, abs=1)


def test_framing_extremes():
    assert Rig.frame(scene([[0, 0, 0]]), PANEL).zero_depth > 0
    assert Rig.frame(scene(BOX.tolist(), opacities=0.01), PANEL).zero_depth > 0
    with pytest.raises(InputError, match="in front"):
        Rig.frame(scene([[0, 0, -1]]), PANEL, np.eye(4))
    with pytest.raises(InputError, match="no Gaussians"):
        Rig.frame(Gaussians(*(torch.zeros(0, *tail) for tail in ((3,), (4,), (3,), (), (1, 3)))), PANEL)
    batch = Gaussians(*(tensor[None] for tensor in scene([[0, 0, 1]]).fields().values()))
    with pytest.raises(InputError, match="batch"):
        Rig.frame(batch, PANEL)
