"""Views rendered from meshes: true to a brute-force oracle, to the packs and to stored pictures; always the same."""

import dataclasses
import importlib.util
import io
import tarfile
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from mesh_packs import Mesh, cube, write_packs
from PIL import Image
from training_runs import run_config

from lightfield_gs import InputError
from training import train
from training.data.batches import Batch, make_batch
from training.data.plan import Augmentation, BatchPlanner
from training.data.resident import ResidentViews
from training.data.sampler import ViewSampler
from training.data.textures import SKIN, Photographs
from training.data.transfer import packed
from training.distributed import Team
from training.loop import make_planner, plans
from training.meshes.pack import Meshes, ResidentMeshes, read_meshes
from training.meshes.rasterize import list_draws, project, rasterize
from training.meshes.render import Scene, Shadows, render_images, render_pictures, render_shadow_maps
from training.meshes.scenes import MeshOptions, MeshScenes, light_axes, standard_light, to_light
from training.meshes.shade import LIGHT
from training.trainer import Trainer

CONE_DEG = (25.0, 12.0)


def _resident(folder: Path, *meshes: Mesh) -> ResidentMeshes:
    write_packs(folder, {"train": list(meshes)})
    return ResidentMeshes(read_meshes(folder))


def _scene(meshes: Meshes, objects: list[int], cameras: torch.Tensor, intrinsics: list[float], size_px: int) -> Scene:
    """A view [3,4] of each object alone, under the light of the project's sets, y up."""
    draws = list_draws(meshes, np.array(objects), np.arange(len(objects)), len(objects))
    light = torch.from_numpy(standard_light(cameras[:, :, :3].double().numpy())).float()
    return Scene(draws, cameras, torch.tensor([intrinsics] * len(objects)), light, size_px)


def _facing(distance: float) -> torch.Tensor:
    """A camera on the axis z, y up."""
    return torch.tensor([[[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, distance]]])


def _oracle(corners: np.ndarray, intrinsics: np.ndarray, x: float, y: float) -> tuple[int, np.ndarray, float, float]:
    """The nearest triangle of corners [T,3,3] at a place, its weights, z, and how far the place is from any outline."""
    fx, fy, cx, cy = intrinsics
    ray = np.array([(x - cx) / fx, (y - cy) / fy, 1])
    best, margin = (-1, np.zeros(3), np.inf), np.inf
    for number, points in enumerate(corners):
        weights = np.linalg.solve(points.T, ray)  # ray = sum of weights * corners: z = 1 / their sum
        margin = min(margin, np.abs(weights / np.abs(weights).sum()).min())
        if (weights > 0).all() and 1 / weights.sum() < best[2]:
            best = number, weights / weights.sum(), 1 / weights.sum()
    return *best, margin


def test_the_nearest_triangle_is_seen_with_its_depth_and_weights(tmp_path):
    """Against rays in double precision, but for samples on outlines."""
    rng = np.random.default_rng(0)
    mesh = Mesh(rng.uniform(-0.5, 0.5, (18, 3)), np.arange(18).reshape(6, 3))
    meshes = _resident(tmp_path, mesh)
    camera, intrinsics, size = _facing(1.3), [14.0, 13.0, 5.2, 6.1], 12
    pictures = _Samples(meshes, camera, intrinsics, size)
    points = meshes.positions[meshes.corners.long()].double().numpy() * (1, -1, -1) + (0, 0, 1.3)
    tested = 0
    for row, column in np.ndindex(size, size):
        triangle, weights, z, margin = _oracle(points, np.array(intrinsics), column + 0.5, row + 0.5)
        if margin < 1e-4:
            continue
        tested += triangle >= 0
        assert pictures.winner[row, column] == triangle
        if triangle >= 0:
            found, depth = pictures.at(row, column)
            np.testing.assert_allclose(found, weights, atol=2e-4)
            assert depth == pytest.approx(z, abs=1e-4)
    assert tested > 30


class _Samples:
    """One sample a pixel of the first object: winner [S,S], and the weights and z of a place."""

    def __init__(self, meshes: ResidentMeshes, camera: torch.Tensor, intrinsics: list[float], size: int) -> None:
        draws = list_draws(meshes.meshes, np.array([0]), np.array([0]), 1)
        self.projected = project(meshes, draws, camera, torch.tensor([intrinsics]))
        points, view = self.projected.points[self.projected.corners], draws.view[self.projected.draw]
        self.winner = rasterize(points, view, 1, (size, size))[0].view(size, size)

    def at(self, row: int, column: int) -> tuple[np.ndarray, float]:
        points = self.projected.points[self.projected.corners[self.winner[row, column]]].double().numpy()
        matrix = np.concatenate([points[:, :2].T, np.ones((1, 3))])
        screen = np.linalg.solve(matrix, [column + 0.5, row + 0.5, 1]) * points[:, 2]
        return screen / screen.sum(), 1 / screen.sum()


def test_neighbouring_triangles_share_no_sample_and_leave_none(tmp_path):
    """A square of many thin and small triangles: one at a time, they cover each sample once."""
    rng = np.random.default_rng(1)
    side = np.linspace(-0.5, 0.5, 8)
    places = np.stack([*np.meshgrid(side, side), np.zeros((8, 8))], -1)
    places[1:-1, 1:-1, :2] += rng.uniform(-0.06, 0.06, (6, 6, 2))
    first = (np.arange(7)[:, None] * 8 + np.arange(7)).reshape(-1, 1)
    triangles = np.concatenate([first + [0, 1, 8], first + [9, 8, 1]])
    meshes = _resident(tmp_path, Mesh(places.reshape(-1, 3), triangles))
    draws = list_draws(meshes.meshes, np.array([0]), np.array([0]), 1)
    projected = project(meshes, draws, _facing(1.0), torch.tensor([[40.0, 40.0, 24.3, 24.3]]))
    count = torch.zeros(48 * 48, dtype=torch.int64)
    for row in range(len(triangles)):
        points = projected.points[projected.corners[row : row + 1]]
        count += rasterize(points, torch.zeros(1, dtype=torch.int64), 1, (48, 48))[0] >= 0
    inside = torch.zeros(48, 48, dtype=torch.int64)
    inside[4:44, 4:44] = 1
    torch.testing.assert_close(count.view(48, 48), inside)


def _square(rectangle: tuple[int, int, int, int], texture: np.ndarray, repeats: float, cut: bool = False) -> Mesh:
    """A square that faces +z with a texture, which repeats so often along each side."""
    corners = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
    uvs = repeats * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    return Mesh(
        corners,
        np.array([[0, 1, 2], [0, 2, 3]]),
        uvs=uvs,
        colours=[(255, 255, 255)],
        rectangle=rectangle,
        cut=cut,
        texture=texture,
    )


def test_a_texture_repeats_inside_its_rectangle(tmp_path):
    """Beside a border of the rectangle the neighbour is the texel at the other end, never one beyond the rectangle."""
    texture = np.full((4, 6, 4), 255, np.uint8)
    texture[..., :3] = 255, 0, 255  # beyond the rectangle
    own = np.random.default_rng(2).integers(0, 200, (2, 3, 3))
    texture[1:3, 2:5, :3] = own
    meshes = _resident(tmp_path, _square((2, 1, 3, 2), texture, 2.0))
    scene = _scene(meshes.meshes, [0], _facing(1.0), [24.0, 24.0, 12.0, 12.0], 24)
    light = torch.zeros_like(scene.lights)
    light[:, :3] = 1
    found = render_images(meshes, dataclasses.replace(scene, lights=light))[0].double()
    sample = (np.arange(48) + 0.5) / 48 * 2  # uv of the samples
    expected = np.zeros((48, 48, 3))
    for row, column in np.ndindex(48, 48):
        x, y = 3 * (sample[column] % 1) - 0.5, 2 * (sample[row] % 1) - 0.5
        for down, right in np.ndindex(2, 2):
            weight = (1 - abs(x - np.floor(x) - right)) * (1 - abs(y - np.floor(y) - down))
            expected[row, column] += weight * own[int(np.floor(y) + down) % 2, int(np.floor(x) + right) % 3] / 255
    expected = expected.reshape(24, 2, 24, 2, 3).mean((1, 3)).transpose(2, 0, 1)
    np.testing.assert_allclose(found[:3], expected, atol=2e-4)
    assert (found[3] == 1).all()


def test_transparent_texels_are_holes_where_the_material_is_cut(tmp_path):
    """Through them lies the cube behind; other materials ignore alpha."""
    texture = np.full((2, 2, 4), 255, np.uint8)
    texture[:, 1, 3] = 0
    squares = [_square((0, 0, 2, 2), texture, 1.0, cut) for cut in (True, False)]
    meshes = _resident(tmp_path, *squares)
    scene = _scene(meshes.meshes, [0, 1], _facing(1.0).expand(2, -1, -1), [16.0, 16.0, 8.0, 8.0], 16)
    cut, whole = render_images(meshes, scene)[:, 3]
    assert (whole == 1).all()
    assert (cut[:, 1:7] == 1).all() and (cut[:, 9:15] == 0).all()


def test_pictures_have_depth_normals_and_numbers_of_objects(tmp_path):
    meshes = _resident(tmp_path, cube(), _square((0, 0, 0, 0), np.full((1, 1, 4), 255, np.uint8), 1.0))
    draws = list_draws(meshes.meshes, np.array([0, 1]), np.array([0, 0]), 1)
    cameras = torch.cat([_facing(1.0), _facing(2.0)])
    light = torch.from_numpy(standard_light(_facing(1.0)[:, :, :3].double().numpy())).float()
    scene = Scene(draws, cameras, torch.tensor([[20.0, 20.0, 16.0, 16.0]]), light, 32)
    pictures = render_pictures(meshes, scene)
    torch.testing.assert_close(pictures.images, render_images(meshes, scene))
    assert pictures.draws[0, 16, 16] == 0 and pictures.depth[0, 16, 16] == pytest.approx(1 - 0.5 / 3**0.5, abs=1e-4)
    # Beside the cube, the square behind it at twice the distance ends 5 px from the middle
    assert pictures.draws[0, 0, 0] == -1 and pictures.depth[0, 0, 0] == 0 and pictures.images[0, 3, 0, 0] == 0
    torch.testing.assert_close(pictures.normals[0, :, 16, 16], torch.tensor([0.0, 0.0, -1.0]))


def test_the_key_light_throws_shadows(tmp_path):
    """A small square before a wall, lit from the right: its shadow lies to the left on the wall, soft at the rim."""
    white = np.full((1, 1, 4), 255, np.uint8)
    meshes = _resident(tmp_path, _square((0, 0, 0, 0), white, 1.0))
    small = torch.diag(torch.tensor([0.2, 0.2, 1])) @ _facing(1.1)
    small[:, 0, 3] = 0.1
    cameras = torch.cat([0.7 * _facing(1.3 / 0.7), small])
    direction = torch.tensor([0.6, 0, -0.8])
    light = torch.zeros(1, sum(LIGHT.values()))
    light[:, :3], light[:, 3:6], light[:, 6:9] = 0.3, direction, 0.5
    draws = list_draws(meshes.meshes, np.array([0, 0]), np.array([0, 0]), 1)
    axes = light_axes(direction[None].double().numpy())
    matrices = torch.from_numpy(to_light(axes, cameras.double().numpy())).float()
    maps = render_shadow_maps(meshes, Shadows(draws, matrices))
    from_camera = torch.from_numpy(to_light(axes, np.eye(4)[None, :3])).float()
    intrinsics = torch.tensor([[83.2, 83.2, 32.0, 32.0]])  # 64 px a unit on the wall
    scene = Scene(draws, cameras, intrinsics, light, 64, None, from_camera, torch.zeros(1, dtype=torch.int64))
    row = render_images(meshes, scene, maps)[0, 0, 32]
    # 0.2 before the wall, it throws its shadow 0.15 to the left: to -0.05, 0.1 to either side
    lit, dark = 0.3 + 0.5 * 0.8, 0.3
    torch.testing.assert_close(row[12:21], torch.full((9,), lit))
    torch.testing.assert_close(row[24:31], torch.full((7,), dark))
    assert (row[21:24].diff() <= 0).all()
    torch.testing.assert_close(row[36:40], torch.full((4,), lit))  # the small square itself
    without = render_images(meshes, dataclasses.replace(scene, shadow=torch.full((1,), -1)), maps)
    torch.testing.assert_close(without, render_images(meshes, scene))
    assert not torch.equal(without[0, 0, 32], row)


def test_normals_turn_to_the_camera(tmp_path):
    """A square is lit alike from either side."""
    meshes = _resident(tmp_path, _square((0, 0, 0, 0), np.full((1, 1, 4), 255, np.uint8), 1.0))
    behind = _facing(1.0) * torch.tensor([-1.0, 1, -1, 1])
    cameras = torch.cat([_facing(1.0), behind])
    scene = _scene(meshes.meshes, [0, 0], cameras, [16.0, 16.0, 8.0, 8.0], 16)
    light = scene.lights[:1].expand(2, -1)
    front, back = render_images(meshes, dataclasses.replace(scene, lights=light))
    torch.testing.assert_close(front, back)


def test_packs_are_read_as_their_own_reader_reads_them(shared_dir):
    folder = shared_dir / "data/meshes"
    if not folder.is_dir():
        pytest.skip(f"no mesh packs at {folder}")
    spec = importlib.util.spec_from_file_location("read_meshes_oracle", folder / "read_meshes.py")
    oracle = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(oracle)
    pack = oracle.Pack(folder / "val_00.npz")
    meshes = read_meshes(folder, "val")
    assert len(meshes) == len(pack)
    for number in range(0, len(pack), 3):
        theirs = pack[number]
        vertices, triangles, materials = (
            slice(*getattr(meshes, name)[number : number + 2]) for name in ("vertices", "triangles", "materials")
        )
        assert meshes.names[number] == theirs["name"]
        np.testing.assert_allclose(meshes.positions[vertices], theirs["pos"], atol=1e-7)
        np.testing.assert_allclose(meshes.normals[vertices], theirs["nrm"], atol=1e-6)
        np.testing.assert_array_equal(meshes.corners[triangles], theirs["tri"])
        np.testing.assert_array_equal(meshes.material_of[triangles], theirs["mat"])
        np.testing.assert_allclose(meshes.base_colours[materials], theirs["rgba"][:, :3], atol=1e-6)
        np.testing.assert_array_equal(meshes.cut[materials], theirs["cut"])
        np.testing.assert_array_equal(meshes.rectangles[materials, 2:], theirs["rect"])
        if theirs["uv"] is not None:
            np.testing.assert_allclose(meshes.uvs[vertices], theirs["uv"], atol=1e-6)
        if theirs["col"] is not None:
            np.testing.assert_allclose(meshes.colours[vertices] / 255, theirs["col"][:, :3], atol=1e-6)
        if theirs["tex"] is not None:
            textured = meshes.rectangles[materials]
            first, stride = textured[textured[:, 4] > 0][0, :2]
            height, width = theirs["tex"].shape[:2]
            assert stride == width
            np.testing.assert_array_equal(meshes.texels[first : first + height * width], theirs["tex"].reshape(-1, 4))


def test_materials_without_a_texture_take_no_texel(tmp_path):
    """Of a folder with a texture in another pack, or with none: every texel that is looked up exists."""
    texture = np.full((3, 3, 4), 9, np.uint8)
    for number, held_back in enumerate(([cube()], [_square((0, 0, 3, 3), texture, 1.0)])):
        write_packs(tmp_path / str(number), {"train": [cube(), *held_back, cube()]})
        meshes = read_meshes(tmp_path / str(number))
        first, stride, x, y, width, height = meshes.rectangles.T
        assert (first[width == 0] == 0).all() and (stride[width == 0] == 0).all()
        assert (first + (y + np.maximum(height - 1, 0)) * stride + x + np.maximum(width - 1, 0)).max() < len(
            meshes.texels
        )


def test_train_and_val_share_no_object(shared_dir):
    folder = shared_dir / "data/meshes"
    if not folder.is_dir():
        pytest.skip(f"no mesh packs at {folder}")
    names = read_meshes(folder, "val", names=["cc0_mixed__box-wide"]).names
    assert names == ["cc0_mixed__box-wide"]
    with pytest.raises(InputError, match="split train"):
        read_meshes(folder, "train", names=names)


def test_views_are_those_that_are_stored(shared_dir):
    """Objects of val/cone at two stored poses, in the project's light."""
    stored, folder = shared_dir / "data/objects/val.tar.gz", shared_dir / "data/meshes"
    if not (stored.is_file() and folder.is_dir()):
        pytest.skip(f"no {stored} and {folder}")
    names = ["cc0_kenney_city__grass", "cc0_kenney_racing__track-bump", "cc0_mixed__alien"]
    wanted = [f"val/cone/{name}/{part}" for name in names for part in _FILES]
    files = {}
    with tarfile.open(stored) as archive:
        for member in archive:
            if member.name in wanted:
                files[member.name] = archive.extractfile(member).read()
            if len(files) == len(wanted):
                break
    meshes = ResidentMeshes(read_meshes(folder, "val", names))
    for name in names:
        pose, poses = f"val/cone/{name}/pose", []
        for view in _VIEWS:
            poses.append(np.array(files[f"{pose}/{view}.txt"].split(), float).reshape(4, 4))
        cameras = torch.from_numpy(np.linalg.inv(poses)[:, :3]).float()
        number = meshes.meshes.names.index(name)
        scene = _scene(meshes.meshes, [number] * 2, cameras, [262.5, 262.5, 128.0, 128.0], 256)
        for view, image in zip(_VIEWS, render_images(meshes, scene)):
            data = io.BytesIO(files[f"val/cone/{name}/rgb/{view}.webp"])
            truth = np.asarray(Image.open(data).convert("RGBA")).astype(np.float64).transpose(2, 0, 1) / 255
            on_white = truth[:3] * truth[3] + 1 - truth[3]
            error = np.square((image[:3] + 1 - image[3]).double().numpy() - on_white).mean()
            assert -10 * np.log10(error) >= 35, (name, view)


_VIEWS = ("000000", "000004")
_FILES = [f"{part}/{view}.{kind}" for view in _VIEWS for part, kind in (("pose", "txt"), ("rgb", "webp"))]


@pytest.fixture(scope="module")
def packs(tmp_path_factory) -> Path:
    """Three small objects, one of them grey, and one that is held back."""
    folder = tmp_path_factory.mktemp("meshes") / "packs"
    texture = np.random.default_rng(3).integers(0, 255, (8, 8, 4)).astype(np.uint8)
    grey = cube(colours=[(128, 128, 128)])
    colourful = cube(material_triangles=[5, 7], colours=[(250, 40, 40), (30, 60, 200)])
    write_packs(folder, {"train": [colourful, grey, _square((0, 0, 8, 8), texture, 1.5)], "val": [cube()]})
    return folder


def _planner(packs: Path, seed: int = 0, **options) -> BatchPlanner:
    meshes = MeshScenes(ResidentMeshes(read_meshes(packs)), MeshOptions(str(packs), **options), CONE_DEG)
    sampler = ViewSampler([], *CONE_DEG, targets=2, seed=seed)
    return BatchPlanner(ResidentViews([]), sampler, Augmentation(noise=0.05, outline_px=1.0), meshes=meshes)


def _example(batch: Batch, number: int) -> list[torch.Tensor]:
    return [values[number] for values in vars(batch).values()]


def test_examples_depend_on_seed_step_and_number_alone(packs):
    whole, again, others = (
        make_batch(planner.plan(step, 0, 4, 16, 24), planner.views)
        for planner, step in ((_planner(packs), 5), (_planner(packs), 5), (_planner(packs, seed=1), 5))
    )
    for one, other in zip(vars(whole).values(), vars(again).values()):
        assert torch.equal(one, other)
    assert not torch.equal(whole.source, others.source)
    planner = _planner(packs)
    assert not torch.equal(whole.source, make_batch(planner.plan(6, 4, 4, 16, 24), planner.views).source)
    half = make_batch(planner.plan(5, 0, 4, 16, 24, slice(2, 4)), planner.views)
    for number in range(2):
        for one, other in zip(_example(half, number), _example(whole, 2 + number)):
            torch.testing.assert_close(one, other)


def test_plans_go_to_a_device_in_one_piece(packs):
    planner = _planner(packs, shadows=1.0)
    plan = planner.plan(1, 0, 3, 16)
    there = make_batch(packed(plan, torch.device("cpu")), planner.views)
    for one, other in zip(vars(there).values(), vars(make_batch(plan, planner.views)).values()):
        assert torch.equal(one, other)


def test_examples_show_scenes_in_the_cone_framed_as_photos_are(packs):
    planner = _planner(packs, random_light=1.0, patterned=0.5, shadows=0.5)
    planner.augmentation = Augmentation(source_jitter=0.0, target_zoom=(1.0, 1.0))
    batch = make_batch(planner.plan(0, 0, 16, 32), planner.views)
    assert batch.source.shape == (16, 4, 32, 32) and batch.targets.shape == (16, 3, 4, 32, 32)
    assert (batch.source[:, :3] <= batch.source[:, 3:] + 1e-6).all()  # premultiplied
    for alpha in (batch.source[:, 3], batch.targets[:, 1, 3]):
        # A margin of 8 % of the longer side all round, and the object in the middle
        rows, columns = ((alpha > 0.1).any(dim).int() for dim in (2, 1))
        longer = torch.maximum(rows.sum(1), columns.sum(1))
        assert ((longer - 32 / 1.16).abs() <= 1.6).all()
    torch.testing.assert_close(batch.targets[:, 0], batch.source)
    forward = batch.world_to_camera[:, :, 2, :3]
    azimuth = torch.rad2deg(torch.atan2(forward[..., 0], forward[..., 2])).abs()
    assert (azimuth[:, 0] < 1e-3).all() and 15 < azimuth.max() < 40


def test_objects_wear_photographs(packs):
    """A photograph of one blue gives all objects shades of its blue."""
    blue = Photographs(torch.tensor([30, 60, 220], dtype=torch.uint8).expand(1, 8, 8, 3).contiguous())
    options = MeshOptions(str(packs), patterned=0.0, photographed=1.0, random_light=0.0)
    scenes = MeshScenes(ResidentMeshes(read_meshes(packs)), options, CONE_DEG, blue)
    sampler = ViewSampler([], *CONE_DEG, targets=1, seed=0)
    planner = BatchPlanner(ResidentViews([]), sampler, Augmentation(), meshes=scenes)
    plan = planner.plan(0, 0, 6, 24)
    looks = plan.meshes.sources.looks
    untouched = dict(tint=torch.zeros(1), order=torch.arange(3.0), gamma=torch.ones(1))
    starts = dict(zip(SKIN, np.cumsum([0, *SKIN.values()])))
    for name, values in untouched.items():
        looks.skins[:, starts[name] : starts[name] + SKIN[name]] = values
    for red, _, shade, alpha in zip(*make_batch(plan, planner.views).source.transpose(0, 1)):
        inside = alpha == 1
        torch.testing.assert_close(red[inside] / shade[inside], torch.full((int(inside.sum()),), 30 / 220))


def test_objects_of_a_scene_lie_apart_in_a_unit_box(packs):
    planner = _planner(packs, objects_per_scene=(0, 0, 0, 1), scale=(1.0, 1.0))
    scene = planner.plan(0, 0, 8, 8).meshes.sources
    meshes = planner.plan(0, 0, 8, 8).meshes.meshes
    assert torch.equal(scene.draws.view, torch.arange(8).repeat_interleave(4))
    scale = scene.to_camera[..., :3].det().abs() ** (1 / 3)
    assert (scale < 1).all()
    centres = scene.to_camera[..., 3].view(8, 4, 3)
    assert ((centres - torch.tensor([0, 0, 1.3])).norm(dim=-1) < 0.5).all()
    assert (torch.cdist(centres, centres) + torch.eye(4) > 0.05).all()
    assert len(meshes.meshes) == 3


def test_examples_of_meshes_join_those_of_stored_views(packs, small_set):
    path = run_config(small_set, "mixed", meshes={"folder": str(packs), "fraction": 0.5}, procedural=0.5)
    config = train.read_config(["--config", str(path)])
    planner = make_planner(config, Team(torch.device("cpu")))
    plan = planner.plan(0, 0, 4, 16)
    assert len(plan.rectangles) + len(plan.meshes.backgrounds) <= 4 and len(plan.meshes.backgrounds) == 2
    assert len(make_batch(plan, planner.views).source) == 4


def test_a_run_takes_steps_on_meshes_alone(packs, small_set):
    path = run_config(small_set, "meshes", data=[], meshes={"folder": str(packs)})
    config = train.read_config(["--config", str(path)])
    alone = Team(torch.device("cpu"))
    trainer, planner = Trainer(config, alone), make_planner(config, alone)
    batches = (make_batch(plan, planner.views) for plan, *_ in islice(plans(planner, trainer), 2))
    values = [trainer.advance(batch).read() for batch in batches]
    assert all(np.isfinite(one["loss"]) and one["gradient_norm"] > 0 for one in values)
    assert config.identity()["meshes"]["folder"] == "packs"


def test_a_run_needs_data_or_meshes(small_set):
    path = run_config(small_set, "nothing", data=[], meshes={"folder": "", "fraction": 1.0})
    with pytest.raises(InputError, match="data: expected"):
        train.read_config(["--config", str(path)])


def test_a_folder_without_an_index_is_named(tmp_path):
    with pytest.raises(InputError, match=r"index\.csv: expected an index of mesh packs"):
        read_meshes(tmp_path)
