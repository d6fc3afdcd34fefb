"""Each stage of the native rasterizer by itself, on NumPy arrays; the same picture from every set of CPU vectors."""

import numpy as np
import pytest
import torch
from rasterizer_cases import PANELS, dense_views, panel, random_scene, rig, stacked

from lightfield_gs import _core, encode, reference, render
from lightfield_gs.panels.panel import panel_lens
from lightfield_gs.rasterizer.quality import EXACT
from lightfield_gs.reference.blend import Eye, Projection, Scene
from lightfield_gs.scene.cameras import Cameras

HALF_LOG2E = 0.5 / np.log(2)
FIELDS = ("u0", "du", "v0", "log2_opacity", "S0", "S1", "S2", "tau", "c0", "c1", "reach_y", "depth")
DTYPES = {"float32": (np.float32, 2e-6), "float64": (np.float64, 1e-12)}


def projected(projection, index, offset):
    """Mean u, v and covariance xx, xy, yy, low pass included, as the oracle has them."""
    u, v, across, down = (value.numpy() for value in projection.footprint(index, offset))
    return u, v, (across**2).sum(0) + 0.3, (across * down).sum(0), (down**2).sum(0) + 0.3


def address(array: np.ndarray | None) -> int:
    assert array is None or array.flags.c_contiguous
    return 0 if array is None else array.ctypes.data


class Stages:
    """The stages in one precision, with the buffers of `images` times `count` splats."""

    def __init__(self, precision: str, images: int, count: int, colour_order: int = 0, lens: bool = False):
        self.core, self.dtype = getattr(_core, precision), DTYPES[precision][0]
        self.table = np.zeros((images, count, _core.SPLAT_FIELDS), self.dtype)
        self.colours = np.zeros((images, count, colour_order + 1, _core.COLOUR_STRIDE), self.dtype)
        self.orders = np.zeros((images, count), np.int32) if lens else None
        self.splats = self.core.Splats(
            images, count, colour_order, address(self.table), address(self.colours), address(self.orders)
        )

    def field(self, name: str) -> np.ndarray:
        return self.table[..., FIELDS.index(name)]

    def gaussians(self, scene):
        self.scene_arrays = [np.ascontiguousarray(field.numpy(), self.dtype) for field in scene.fields().values()]
        return self.core.Gaussians(scene.count, scene.sh_degree, *map(address, self.scene_arrays))

    def project_dense(self, scene, width, height, *views):
        self.camera_arrays = [np.ascontiguousarray(view.numpy(), self.dtype) for view in views]
        batch, per_scene = views[0].shape[:2]
        self.cameras = self.core.Cameras(batch, per_scene, width, height, *map(address, self.camera_arrays))
        self.core.project_images(self.gaussians(scene), self.cameras, self.splats, 2)

    def project_lens(self, scene, shown, fan, continuous=False, tolerance=1e-4):
        self.lens = native_lens(shown, fan, continuous)
        (fx, fy), (cx, cy) = fan.focal_px, fan.principal_point_px
        view = _core.Rig(
            world_to_camera=list(np.asarray(fan.world_to_camera).ravel()),
            intrinsics=[fx, fy, cx, cy],
            limits=[*reference.rig_eye(shown, fan).limits.tolist(), 0.0],
            zero_depth=fan.zero_depth,
            lens=self.lens,
        )
        return self.core.project_direct(self.gaussians(scene), view, self.lens, EXACT.native, tolerance, self.splats, 2)

    def colours_at(self, s):
        """The colours [N, 3] of the first image from the place s of the rig: polynomials, or on circles near it."""
        table = self.colours[0].astype(np.float64)
        terms, on_circle = table[..., :3], self.orders[0] < 0
        colours = (terms * (s ** np.arange(terms.shape[1]))[:, None]).sum(1)
        if on_circle.any():  # see csrc/math/colour_circle.h
            c, place, distance = terms[on_circle], table[on_circle, 1, 3], table[on_circle, 2, 3]
            t, h = ((part / np.hypot(s - place, distance))[:, None] for part in (s - place, distance))
            powers = [t**0, t, t**2, t**3, h, h * t, h * t**2]
            colours[on_circle] = sum(c[:, k] * power for k, power in enumerate(powers))
        return colours.clip(min=0)

    def order_and_bin(self, height):
        images, count, _ = self.table.shape
        self.sorted, self.drawn = np.full((images, count), -1, np.int32), np.zeros(images, np.int64)
        self.core.order(self.splats, address(self.sorted), address(self.drawn), 2)
        self.offsets = np.zeros(images * _core.band_count(height) + 1, np.int64)
        counting = _core.Bins(address(self.offsets), 0)
        total = self.core.bin_count(self.splats, address(self.sorted), address(self.drawn), height, counting, 2)
        self.members = np.full(total, -1, np.int32)
        self.bins = _core.Bins(address(self.offsets), address(self.members))
        self.core.bin_fill(self.splats, address(self.sorted), address(self.drawn), height, self.bins, 2)


def native_lens(shown, fan, continuous=False):
    start = float(reference.lens_offsets(shown, fan, np.array(0.0)))
    end = float(reference.lens_offsets(shown, fan, np.array(float(shown.views))))
    return panel_lens(shown, continuous, start, (end - start) / shown.views).native()


@pytest.mark.parametrize("name", PANELS)
def test_lens_phase_is_that_of_the_panel(name):
    shown = panel(name)
    native, views = native_lens(shown, rig(shown)), shown.view_map()
    random = np.random.default_rng(1)
    for row, column, channel in zip(
        random.integers(0, shown.height_px, 300), random.integers(0, shown.width_px, 300), random.integers(0, 3, 300)
    ):
        assert native.view_at(row, native.subpixel_index(row, column, channel)) == views[row, column, channel]


@pytest.mark.parametrize("precision", DTYPES)
def test_project_dense_gives_the_conditional_form(precision):
    dtype, tolerance = DTYPES[precision]
    batch, per_scene, width, height = 2, 3, 90, 60
    scenes = [random_scene(50, 2, seed, extent=0.5) for seed in range(batch)]
    views = dense_views(batch, per_scene, width, height)
    stages = Stages(precision, batch * per_scene, 50)
    stages.project_dense(stacked(scenes), width, height, *views)
    zero = torch.zeros((), dtype=torch.float64)
    for image in range(batch * per_scene):
        b, v = divmod(image, per_scene)
        eye = Eye(views[0][b, v], views[1][b, v], views[2][b, v, :4], 0.0)
        projection = Projection(Scene.from_gaussians(scenes[b]), eye)
        index = torch.arange(50)
        u, row, xx, xy, yy = projected(projection, index, zero)
        drawn = stages.field("reach_y")[image] >= 0
        assert drawn.any()
        expected = {
            "u0": u,
            "v0": row,
            "S0": (xx - xy**2 / yy) / HALF_LOG2E,
            "tau": HALF_LOG2E / yy,
            "c0": xy / yy,
            "log2_opacity": np.log2(scenes[b].opacities.numpy()),
            "depth": projection.position[:, 2].numpy(),
        }
        for name, value in expected.items():
            scale = np.abs(value[drawn]).max()
            np.testing.assert_allclose(stages.field(name)[image][drawn], value[drawn], atol=tolerance * scale, rtol=0)
        colour = projection.colour(index, torch.zeros(50, dtype=torch.float64)).numpy()
        np.testing.assert_allclose(stages.colours[image, drawn, 0, :3], colour[drawn], atol=10 * tolerance)

        # What is culled must not reach any pixel centre.
        reach_x = np.sqrt(2 * xx * np.log(255 * scenes[b].opacities.numpy()))
        inside = (u - reach_x < width - 1) & (u + reach_x > 1)
        reach_y = np.sqrt(2 * yy * np.log(255 * scenes[b].opacities.numpy()))
        touched = inside & (row - reach_y < height - 1) & (row + reach_y > 1)
        corner = (np.abs(u - width / 2) > width / 2) & (np.abs(row - height / 2) > height / 2)
        assert not (touched & ~corner & ~drawn & (projection.position[:, 2].numpy() > 0.01)).any()


@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("precision", DTYPES)
@pytest.mark.parametrize("name", ["default lens", "very wide cone", "inverted"])
def test_project_lens_holds_for_all_offsets(name, precision, continuous):
    dtype, tolerance = DTYPES[precision]
    shown, scene, order = panel(name), random_scene(60, 3, 2, extent=0.5), 12
    fan = rig(shown, 0.1, 0.2)
    stages = Stages(precision, 1, 60, order, lens=True)
    bound = stages.project_lens(scene, shown, fan, continuous, tolerance=5e-5)
    projection = Projection(Scene.from_gaussians(scene), reference.rig_eye(shown, fan))
    index, drawn = torch.arange(60), stages.field("reach_y")[0] >= 0
    reach = stages.lens.reach()
    assert reach == pytest.approx(fan.half_width(shown))
    for s in np.linspace(-1, 1, 7):
        offset = torch.full((60,), s * reach, dtype=torch.float64)
        u, row, xx, xy, yy = projected(projection, index, offset)
        got = {name: stages.field(name)[0].astype(np.float64) for name in FIELDS}
        pairs = {
            "mean": (got["u0"] + s * got["du"], u),
            "slope": (got["c0"] + s * got["c1"], xy / yy),
            "S": (got["S0"] + s * got["S1"] + s**2 * got["S2"], (xx - xy**2 / yy) / HALF_LOG2E),
        }
        for have, want in pairs.values():
            np.testing.assert_allclose(have[drawn], want[drawn], atol=5 * tolerance * np.abs(want[drawn]).max(), rtol=0)
        colour = projection.colour(index, offset).numpy()
        # What is left is rounding, of float32 that of powers of s as well.
        rounding = 6e-5 if dtype == np.float32 else 1e-12
        assert np.abs(stages.colours_at(s) - colour)[drawn].max() <= bound + rounding


def test_float32_drops_orders_that_are_not_needed():
    shown, scene = panel(cone_deg=2.0), random_scene(60, 3, 2)
    stages = Stages("float32", 1, 60, 12, lens=True)
    stages.project_lens(scene, shown, rig(shown))
    assert stages.orders.max() < 6
    exact = Stages("float64", 1, 60, 12, lens=True)
    exact.project_lens(scene, shown, rig(shown))
    assert (exact.orders[exact.table[..., FIELDS.index("reach_y")] >= 0] == 12).all()


def test_the_bound_of_the_colour_fit_falls_with_its_order():
    shown, scene = panel("very wide cone"), random_scene(60, 3, 2)
    bounds = []
    for order in (2, 4, 6):  # which have no room for a colour on a circle
        stages = Stages("float64", 1, 60, order, lens=True)
        bounds.append(stages.project_lens(scene, shown, rig(shown)))
        projection = Projection(Scene.from_gaussians(scene), reference.rig_eye(shown, rig(shown)))
        drawn = torch.from_numpy(np.flatnonzero(stages.field("reach_y")[0] >= 0))
        worst = 0.0
        for s in np.linspace(-1, 1, 41):
            offset = torch.full((len(drawn),), s * stages.lens.reach(), dtype=torch.float64)
            worst = max(worst, np.abs(stages.colours_at(s)[drawn] - projection.colour(drawn, offset).numpy()).max())
        assert worst <= bounds[-1]
    assert bounds[0] > bounds[1] > bounds[2]


@pytest.mark.parametrize("count", [0, 1, 2, 1000, 70_000])
@pytest.mark.parametrize("precision", DTYPES)
def test_order_is_by_depth_then_index(precision, count):
    stages = Stages(precision, 3, count)
    random = np.random.default_rng(4)
    # Few different depths: many ties. Some are culled.
    stages.field("depth")[:] = random.integers(1, 50, (3, count)) / 7
    stages.field("reach_y")[:] = np.where(random.random((3, count)) < 0.3, -1, 5)
    stages.field("v0")[:] = 8
    stages.order_and_bin(16)
    for image in range(3):
        drawn = np.flatnonzero(stages.field("reach_y")[image] >= 0)
        expected = drawn[np.argsort(stages.field("depth")[image][drawn], kind="stable")]
        assert stages.drawn[image] == len(drawn)
        np.testing.assert_array_equal(stages.sorted[image, : len(drawn)], expected)


@pytest.mark.parametrize("height", [1, 15, 16, 17, 100])
@pytest.mark.parametrize("precision", DTYPES)
def test_bins_hold_who_touches_a_band_near_ones_first(precision, height):
    stages = Stages(precision, 2, 300)
    random = np.random.default_rng(5)
    stages.field("depth")[:] = random.random((2, 300))
    stages.field("v0")[:] = random.uniform(-30, height + 30, (2, 300))
    stages.field("reach_y")[:] = np.where(random.random((2, 300)) < 0.1, -1, random.exponential(8, (2, 300)))
    stages.order_and_bin(height)
    bands = _core.band_count(height)
    assert bands == -(-height // _core.BAND_ROWS)
    assert stages.offsets[0] == 0 and stages.offsets[-1] == len(stages.members)
    for image in range(2):
        v, reach = stages.field("v0")[image], stages.field("reach_y")[image]
        for band in range(bands):
            rows = np.arange(band * _core.BAND_ROWS, min((band + 1) * _core.BAND_ROWS, height)) + 0.5
            away = np.abs(rows[:, None] - v).min(0)
            at = image * bands + band
            members = stages.members[stages.offsets[at] : stages.offsets[at + 1]]
            assert len(set(members)) == len(members)
            assert set(np.flatnonzero(away <= reach)) <= set(members) <= set(np.flatnonzero(away <= reach + 0.02))
            assert (np.diff(stages.field("depth")[image][members]) >= 0).all()

    # Where the gradients of a splat's bands begin: splat after splat, as many places as it has bands.
    first = np.zeros((2, 300), np.int64)
    stages.core.first_intersections(stages.splats, height, stages.bins, address(first), 2)
    times = [
        np.bincount(stages.members[stages.offsets[i * bands] : stages.offsets[(i + 1) * bands]], minlength=300)
        for i in range(2)
    ]
    np.testing.assert_array_equal(first.ravel(), np.cumsum(np.concatenate(times)) - np.concatenate(times))


@pytest.mark.parametrize("precision", DTYPES)
def test_composite_dense_of_two_round_spots(precision):
    width, height = 37, 21
    stages = Stages(precision, 1, 2)
    spots = ((11.3, 8.8, 9.0, 0.7, 2.0), (14.0, 10.1, 16.0, 0.9, 1.0))
    for index, (u, v, variance, opacity, depth) in enumerate(spots):
        stages.table[0, index] = [
            u,
            0,
            v,
            np.log2(opacity),
            variance / HALF_LOG2E,
            0,
            0,
            HALF_LOG2E / variance,
            0,
            0,
            np.sqrt(2 * variance * np.log(255 * opacity)),
            depth,
        ]
    stages.colours[0, :, 0, :3] = [[1, 0, 0], [0, 1, 0.5]]
    stages.order_and_bin(height)
    background = np.array([0, 0.2, 1], stages.dtype)
    pictures = [np.full((height, width, *rest), np.nan, stages.dtype) for rest in ((3,), (), ())]
    identity = [torch.eye(4)[None, None], torch.ones(1, 1, 4), torch.ones(1, 1, 5)]
    arrays = [np.ascontiguousarray(array.numpy(), stages.dtype) for array in identity]
    cameras = stages.core.Cameras(1, 1, width, height, *map(address, arrays))
    counters = stages.core.composite_images(
        stages.splats, stages.bins, cameras, address(background), stages.core.Images(*map(address, pictures)), 2
    )
    row, column = np.mgrid[:height, :width] + 0.5

    def alpha(u, v, variance, opacity):
        value = opacity * np.exp(-((column - u) ** 2 + (row - v) ** 2) / (2 * variance))
        return np.where(value < 1 / 255, 0, value)

    far, near = alpha(11.3, 8.8, 9, 0.7), alpha(14.0, 10.1, 16, 0.9)
    left = (1 - near) * (1 - far)
    image = near[..., None] * [0, 1, 0.5] + ((1 - near) * far)[..., None] * [1, 0, 0] + left[..., None] * background
    atol = 1e-5 if precision == "float32" else 1e-9
    np.testing.assert_allclose(pictures[0], image, atol=atol)
    np.testing.assert_allclose(pictures[1], 1 - left, atol=atol)
    np.testing.assert_allclose(pictures[2], near * 1 + (1 - near) * far * 2, atol=atol)
    assert counters.evaluations >= np.count_nonzero(near) and counters.intersections > 0


TARGETS = _core.simd_targets()


@pytest.fixture
def simd_target(request):
    _core.set_simd_target(request.param)
    yield request.param
    _core.set_simd_target("")


@pytest.mark.parametrize("simd_target", TARGETS, indirect=True)
def test_every_vector_set_draws_the_same_light_field(simd_target):
    for name in ("default lens", "narrow cone", "narrower than a pixel", "wide lenses", "one column"):
        shown, scene = panel(name), random_scene(50, 1, seed=6)
        fan = rig(shown, 0.1)
        rows, columns, channels = (index.ravel() for index in np.indices((shown.height_px, shown.width_px, 3)))
        want, margin = reference.subpixel_colours(scene, shown, fan, rows, columns, channels, return_margin=True)
        if simd_target == TARGETS[0]:  # of double precision there is one, whatever the target
            got = encode(scene, shown, fan, output="float64").numpy().ravel()
            assert np.abs(got - want)[margin > 1e-9].max() < 1e-5
        got = encode(scene.to(torch.float32), shown, fan, output="float32").numpy().ravel()
        assert np.abs(got - want)[margin > 2e-3].max() < 5e-4


@pytest.mark.parametrize("simd_target", TARGETS, indirect=True)
@pytest.mark.parametrize("size", [(1, 1), (3, 50), (50, 3), (33, 47)])
def test_every_vector_set_draws_the_same_image_and_gradients(simd_target, size):
    width, height = size
    scene = random_scene(40, 1, seed=7)
    pose, camera, limits = (view[0] for view in dense_views(1, 2, width, height))
    results = []
    for dtype in (torch.float32, torch.float64):
        fields = [field.to(dtype, copy=True).requires_grad_() for field in scene.fields().values()]
        cameras = Cameras(pose.to(dtype), camera[:, :2].to(dtype), camera[:, 2:].to(dtype), width, height)
        image = render(type(scene)(*fields), cameras).image
        image.sin().sum().backward()
        results.append([image.detach(), *(field.grad for field in fields)])
    background = torch.ones(1, 2, 3, dtype=torch.float64)
    fields = [field[None].clone().requires_grad_() for field in scene.fields().values()]
    image, _, _ = reference.dense_torch(*fields, background, pose[None], camera[None], limits[None], width, height)
    image.sin().sum().backward()
    for got, want in zip(results[1], [image.detach()[0], *(field.grad[0] for field in fields)]):
        torch.testing.assert_close(got, want, rtol=1e-7, atol=1e-7)
    for single, exact in zip(*results):
        scale = exact.abs().max().clamp(min=1)
        assert (single.double() - exact).abs().max() < 2e-3 * scale


def test_unknown_vector_sets_are_refused():
    with pytest.raises(ValueError, match="AVX9"):
        _core.set_simd_target("AVX9")
    assert TARGETS
