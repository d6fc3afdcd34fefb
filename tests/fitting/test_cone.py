"""Fits for a panel against closed forms: its cone in a capture, weights of photographs, and pruning."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_scene import known_cameras, known_scene, photograph_scene
from rasterizer_cases import panel, random_scene

import lightfield_gs as lf
from lightfield_gs import InputError, Panel, Rig, cli, encode
from lightfield_gs.fitting.cone import FALL_DEG, FLOOR, MARGIN_DEG, Display, cone_weights, place_cone, read_cone
from lightfield_gs.fitting.evaluate import evaluate, scores_by_angle
from lightfield_gs.fitting.panel_pruning import (
    NEAR_FRACTION,
    PanelWindow,
    mask_to_window,
    photo_visibility,
    prune_for_panel,
)
from lightfield_gs.fitting.posed_images import Normalization
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.io.captures.capture import Capture
from lightfield_gs.io.captures.photograph import Photograph
from lightfield_gs.io.scenes.files import read_scene

MIDDLE = np.array([3.0, -2.0, 7.0])  # what the cameras of a ring look at
RADIUS = 4.0


def ring(angles_deg, points: np.ndarray | None = None) -> Capture:
    """Photographs from a ring about MIDDLE, upright, named by their places; points of the scene, or none."""
    poses = []
    for angle in np.radians(angles_deg):
        pose = np.eye(4)
        pose[:3, :3] = [[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]]
        pose[:3, 3] = np.array([0, 0, RADIUS]) - pose[:3, :3] @ MIDDLE
        poses.append(pose)
    count = len(poses)
    points = np.empty((0, 3)) if points is None else points
    sizes, intrinsics = np.tile([64, 48], (count, 1)), np.tile([70.0, 71.0, 33.0, 23.0], (count, 1))
    names, colours = [f"{index:02d}.png" for index in range(count)], np.zeros((len(points), 3), np.uint8)
    return Capture(Path(), names, np.stack(poses), intrinsics, sizes, points, colours, [])


# --- Geometry


def test_the_cone_of_a_ring_has_its_angles():
    angles = np.array([-60, -18, -9, 0, 9.5, 18, 30, 90, 170.0])
    capture = ring(angles)
    cone = place_cone(capture, 30)  # those within 15 + 5 degrees count fully
    assert cone.name == "03.png" and cone.zero_depth == pytest.approx(RADIUS)
    np.testing.assert_allclose(cone.pivot, MIDDLE, atol=1e-9)
    np.testing.assert_allclose(cone.angles_deg, abs(angles), atol=1e-9)
    assert cone.inside.tolist() == [False, False, True, True, True] + 4 * [False]
    assert place_cone(capture, 30, "06.png").angles_deg[1] == pytest.approx(48)
    beyond = (30 - 15 - MARGIN_DEG) / FALL_DEG
    expected = FLOOR + (1 - FLOOR) * math.cos(math.pi / 2 * beyond) ** 2
    np.testing.assert_allclose(cone_weights(cone.angles_deg, 30), [FLOOR, 1, 1, 1, 1, 1, expected, FLOOR, FLOOR])
    assert cone_weights(np.array([20.0, 20 + FALL_DEG / 2]), 30).tolist() == pytest.approx([1, (1 + FLOOR) / 2])


def test_the_zero_plane_is_in_the_surface_that_the_centre_photograph_shows():
    flat = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3)) * [1, 1, 0]
    capture = ring([-5, 0, 5], MIDDLE + flat - [0, 0, 0.5])
    cone = place_cone(capture, 30, "01.png")
    assert cone.zero_depth == pytest.approx(RADIUS - 0.5)
    np.testing.assert_allclose(cone.pivot, MIDDLE - [0, 0, 0.5], atol=1e-9)
    aside = math.atan2(RADIUS * math.sin(math.radians(5)), RADIUS * math.cos(math.radians(5)) - 0.5)
    assert cone.angles_deg[2] == pytest.approx(math.degrees(aside))


def test_captures_without_a_middle_are_refused():
    parallel = replace(ring([0, 0, 0]), world_to_camera=np.stack([np.eye(4)] * 3))
    with pytest.raises(InputError, match="axes of 3 cameras meet nowhere"):
        place_cone(parallel, 30)
    with pytest.raises(InputError, match="centre photograph x.png: expected the name of one of the 3"):
        place_cone(ring([0, 20, 40]), 30, "x.png")
    with pytest.raises(InputError, match="cone must be 1..179"):
        place_cone(ring([0, 20, 40]), 180)
    with pytest.raises(InputError, match="centre: 00.png is the middle of a cone, and there is none"):
        lf.fit(ring([0, 20, 40]), centre="00.png", progress=False)


def test_the_rig_sees_the_pivot_from_half_the_cone_to_either_side():
    capture, shown = ring([-20, -9, 0, 9, 20]), panel(width_px=300, height_px=100, cone_deg=34.0)
    display = Display.place(capture, shown, "02.png")
    rig = display.rig
    cameras = rig.cameras_at(shown, [0.0, shown.views / 2, float(shown.views)])
    poses = cameras.world_to_camera.numpy()
    places = poses[:, :3, :3] @ MIDDLE + poses[:, :3, 3]
    assert cameras.principal_point_px is not None
    pixels = cameras.focal_px.numpy() * places[:, :2] / places[:, 2:] + cameras.principal_point_px.numpy()
    scale = 100 / 48  # the whole photograph, in the middle of the panel
    np.testing.assert_allclose(pixels, np.tile([150 + scale * 1, 50 - scale * 1], (3, 1)), atol=1e-9)
    assert rig.focal_px == pytest.approx((70 * scale, 71 * scale))
    centres = -np.einsum("cij,ci->cj", poses[:, :3, :3], poses[:, :3, 3])
    right, middle, left = (centre - MIDDLE for centre in centres)
    np.testing.assert_allclose(centres[1], capture.centres[2], atol=1e-12)
    for end in (right, left):
        angle = math.degrees(math.acos(end @ middle / np.linalg.norm(end) / np.linalg.norm(middle)))
        assert angle == pytest.approx(34 / 2)


def stored_sideways(capture: Capture, tags: list[int]) -> Capture:
    """The same photographs, each stored so that its Exif orientation turns it upright: 3, 6 or 8; 1 is as it is."""
    poses, intrinsics, sizes = capture.world_to_camera.copy(), capture.intrinsics.copy(), capture.sizes_px.copy()
    photographs = []
    for index, tag in enumerate(tags):
        for _ in range({1: 0, 8: 1, 3: 2, 6: 3}[tag]):  # stored a quarter turn clockwise each time
            right, down = poses[index, 0].copy(), poses[index, 1].copy()
            poses[index, :2] = -down, right
            (fx, fy, cx, cy), (width, height) = intrinsics[index], sizes[index]
            intrinsics[index], sizes[index] = (fy, fx, height - cy, cx), (height, width)
        size, numbers = tuple(sizes[index].tolist()), tuple(intrinsics[index].tolist())
        photographs.append(Photograph(Path(capture.names[index]), size, size, numbers, orientation=tag))
    return replace(capture, world_to_camera=poses, intrinsics=intrinsics, sizes_px=sizes, photographs=photographs)


@pytest.mark.parametrize(
    "tags, words",
    [
        ([6] * 5, "turned by 90 degrees clockwise from 02.png as stored (Exif orientation 6), so that 5 of 5"),
        ([8] * 5, "turned by 90 degrees counter-clockwise"),
        ([3] * 5, "turned by 180 degrees"),
        ([6, 1, 1, 8, 1], "not turned from 02.png as stored (Exif orientation 1), so that 5 of 5 photographs stand"),
    ],
)
def test_a_rig_stands_upright_though_photographs_are_stored_on_their_side(tags, words):
    """Phones store the picture of their sensor, and the way they were held in the Exif orientation."""
    capture, shown = ring([-20, -9, 0, 9, 20]), panel(width_px=300, height_px=100, cone_deg=34.0)
    upright = Display.place(capture, shown, "02.png").rig
    display = Display.place(stored_sideways(capture, tags), shown, "02.png")
    np.testing.assert_allclose(display.rig.world_to_camera, upright.world_to_camera, atol=1e-12)
    np.testing.assert_allclose(display.rig.focal_px, upright.focal_px)
    np.testing.assert_allclose(display.rig.principal_point_px, upright.principal_point_px)
    assert [line for line in display.messages if words in line]


def test_most_photographs_say_where_up_is():
    """The centre photograph lost its Exif orientation, as editors leave it."""
    capture, shown = ring([-20, -9, 0, 9, 20]), panel(width_px=300, height_px=100, cone_deg=34.0)
    upright = Display.place(capture, shown, "02.png")
    stored = stored_sideways(capture, [6] * 5)
    stored.photographs[2] = replace(stored.photographs[2], orientation=1)
    display = Display.place(stored, shown, "02.png")
    np.testing.assert_allclose(display.rig.world_to_camera, upright.rig.world_to_camera, atol=1e-12)
    assert [line for line in display.messages if "so that 4 of 5 photographs stand upright" in line]
    assert not [line for line in upright.messages if "Exif" in line]


def test_a_cone_is_a_panel_or_an_angle():
    assert read_cone("25")[0] == replace(Panel.load("65in-8k-96v"), cone_deg=25.0) == read_cone(25)[0]
    assert read_cone("toy-8v")[0] == Panel.load("toy-8v")
    for wrong in ("0.5", 200.0, "nan", "no-such-panel"):
        with pytest.raises(InputError):
            read_cone(wrong)


# --- Weights


def test_photographs_come_as_often_as_their_weights_say():
    weights, epochs = [1.0, 0.05, 0.5, 1.0, 0.3, 0.05], 1000
    steps = int(epochs * sum(weights))
    order = Schedule.make(FitSettings(steps=steps, seed=3), len(weights), "cpu", weights).order[:, 0]
    counts = torch.bincount(order, minlength=len(weights)).double()
    assert abs(counts[0] - epochs) < 15 and abs(counts[3] - counts[0]) <= 1  # in every epoch, of 2 or 3 photographs
    deviation = torch.tensor([math.sqrt(epochs * s * (1 - s)) for s in weights])
    assert ((counts - counts[0] * torch.tensor(weights)).abs() <= 4 * deviation + 2).all()
    assert (order == 0).nonzero()[:, 0].diff().max() <= 5
    again = Schedule.make(FitSettings(steps=steps, seed=3), len(weights), "cpu", weights).order[:, 0]
    assert torch.equal(order, again)


def test_equal_weights_change_nothing():
    settings = FitSettings(steps=100, batch_size=2)
    plain, equal = (Schedule.make(settings, 7, "cpu", weights).order for weights in (None, [1.0] * 7))
    assert torch.equal(plain, equal)
    epochs = plain.flatten()[:196].view(28, 7)
    assert torch.equal(epochs.sort(1).values, torch.arange(7).expand(28, 7))
    with pytest.raises(InputError, match="the largest of them 1"):
        Schedule.make(settings, 2, "cpu", [0.5, 0.5])


# --- Pruning for a panel


def small_display(distance: float = 2.0) -> Display:
    """A panel before the scenes of random_scene, its centre camera at the origin of a capture that is its world."""
    shown = panel(width_px=96, height_px=48, cone_deg=30.0)
    capture = replace(ring([-9, 0, 9]), world_to_camera=known_cameras(3).world_to_camera.double().numpy())
    display = Display.place(capture, shown, "01.png")
    return replace(display, rig=Rig(np.eye(4), (60.0, 60.0), (48.0, 24.0), distance, 30.0))


def at(scene: lf.Gaussians, place: list[float], size: float) -> lf.Gaussians:
    """The scene and a round Gaussian at this place."""
    one = {"means": place, "quaternions": [1.0, 0, 0, 0], "scales": [size] * 3}
    fields = scene.fields()
    added = {name: torch.tensor([value]) for name, value in one.items()}
    added |= {"opacities": torch.tensor([0.9]), "sh": torch.full_like(fields["sh"][:1], 0.3)}
    return lf.Gaussians(**{name: torch.cat([field, added[name]]) for name, field in fields.items()})


@pytest.mark.parametrize("cut", [0.0, 1e-3, 0.05])
def test_pruning_keeps_the_light_field_within_what_it_says(cut):
    scene = random_scene(200, extent=1.4, size=0.1, dtype=torch.float32)
    display, world = small_display(), Normalization((0.5, 0.0, -1.0), 1.0)
    moved = replace(scene, means=scene.means - torch.tensor(world.centre))  # coordinates of the fit
    found = prune_for_panel(moved, world, display, photograph_scene(known_scene()), cut)
    assert found.unseen > 10 and found.contribution <= cut and (cut == 0) == (found.faint == 0)
    left = lf.Gaussians(*(field[found.kept] for field in scene.fields().values()))
    assert left.count == found.count == 200 - found.unseen - found.faint
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 1.0)):
        whole, fewer = (
            encode(s, display.panel, display.rig, background=background, output="float32") for s in (scene, left)
        )
        error = float((whole - fewer).abs().mean())
        assert error <= found.contribution + 1e-4 and (cut > 0 or error < 1e-6)


def test_what_floats_before_the_eyes_goes_if_no_photograph_shows_it():
    display, images = small_display(), photograph_scene(known_scene())
    near = 0.9 * NEAR_FRACTION * display.rig.zero_depth
    rotation, shift = images.world_to_camera[2, :3, :3], images.world_to_camera[2, :3, 3]
    ahead = rotation.T @ (torch.tensor([0.0, 0.0, 0.4]) - shift)  # of the only photograph that is fitted to
    scene = at(at(known_scene(), [0.3, 0.0, near], 0.02), ahead.tolist(), 0.02)
    found = prune_for_panel(scene, Normalization((0.0, 0.0, 0.0), 1.0), display, only(images, 2), 0.0)
    assert photo_visibility(scene, only(images, 2))[-2:].gt(1).tolist() == [False, True]
    assert found.floating == 2 and found.unfounded == 1 and found.kept[-2:].tolist() == [False, True]
    assert found.contribution > 0


def test_pixels_in_the_frame_are_those_whose_rays_go_through_it():
    display, world = small_display(), Normalization((0.5, 0.0, -1.0), 2.0)
    images = photograph_scene(known_scene(), known_cameras(5))
    r = np.random.default_rng(0)
    u, v = r.uniform((-48, -24), (144, 72), (3000, 2)).T  # the panel is 96 x 48: some beyond its edges
    points = world.points(np.stack([(u - 48) / 60 * 2, (v - 24) / 60 * 2, np.full_like(u, 2)], -1))
    for pose, intrinsics in zip(images.world_to_camera, images.intrinsics):
        seen = PanelWindow.locate(display, world).mask(pose, intrinsics, 48, 32).numpy()
        x, y, z = pose.double().numpy()[:3] @ np.concatenate([points, np.ones((3000, 1))], 1).T
        (fx, fy, cx, cy), edge = intrinsics.tolist(), 6  # panel pixels within which it may be either
        column, row = np.floor(fx * x / z + cx).astype(int), np.floor(fy * y / z + cy).astype(int)
        inside = np.minimum.reduce([u, 96 - u, v, 48 - v])
        at = (z > 0) & (column >= 0) & (column < 48) & (row >= 0) & (row < 32) & (abs(inside) > edge)
        assert (inside[at] > 0).any() and np.array_equal(seen[row[at], column[at]], inside[at] > 0)
    flipped = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])).double() @ images.world_to_camera[2].double()
    assert not PanelWindow.locate(display, world).mask(flipped, images.intrinsics[2], 48, 32).any()  # it looks away


# At 31 dB, 0.1 dB are 3e-4 in the root of the mean square. The mean error may be 1e-4 and the cut.
@pytest.mark.parametrize("cut, most_db", [(0.0, 0.01), (1e-4, 0.1)])
def test_what_is_pruned_for_a_panel_costs_photographs_nothing_in_its_frame(cut, most_db):
    scene, world = random_scene(600, extent=1.4, size=0.1, dtype=torch.float32), Normalization((0.0, 0.0, 0.0), 1.0)
    display = small_display()
    places = display.rig.cameras_at(display.panel, [0.5, 4.0, float(display.panel.views)])
    poses = places.world_to_camera.float()
    middle = torch.tensor([[48.0, 32.0]]).expand(3, 2).contiguous()
    wide = lf.Cameras(poses, torch.full((3, 2), 60.0), middle, 96, 64)  # looks past the frame
    images = photograph_scene(scene, wide)
    other = replace(scene, sh=scene.sh + 0.1)
    found = prune_for_panel(other, world, display, images, cut)
    left = lf.Gaussians(*(field[found.kept] for field in other.fields().values()))
    result = mask_to_window(images, PanelWindow.locate(display, world), [True, False, True])
    assert result is not None and result[0].names == ["00.png", "02.png"] and 0.3 < result[1] < 0.8
    black = (0.0, 0.0, 0.0)
    whole, fewer = (evaluate(s, result[0], black).mean_psnr_db for s in (other, left))
    assert abs(whole - fewer) < most_db
    assert evaluate(other, images, black).mean_psnr_db - evaluate(left, images, black).mean_psnr_db > 1
    assert mask_to_window(images, PanelWindow.locate(display, world), [False] * 3) is None


def only(images, place: int):
    """One of the images."""
    tensors = (images.photos, images.world_to_camera, images.intrinsics, images.limits)
    photos, *cameras = (t[place : place + 1] for t in tensors)
    return type(images)([images.names[place]], photos, None, *cameras, [images.sizes[place]])


def test_weights_in_photographs_are_those_of_the_pictures():
    images, scene = photograph_scene(known_scene(40)), known_scene(40)
    white = replace(scene, sh=torch.zeros_like(scene.sh))  # colours of 0.5: the picture is half of all weights
    cameras = known_cameras()
    picture = lf.render(white, cameras, background=(0.0, 0.0, 0.0)).image
    assert float(photo_visibility(scene, images).sum()) == pytest.approx(float(picture.sum()) / 3 / 0.5, rel=1e-4)


# --- Scores


def test_scores_are_parted_by_angle():
    rows = scores_by_angle([0.0, 5.0, 12.6, 90.0, 180.0], [10, 20, 30, 40, 50], [0.1, 0.2, 0.3, 0.4, 0.5], 25.0)
    assert [(row["views"], row["photographs"], row["psnr_db"]) for row in rows] == [
        ("inside the cone", 2, 15),
        ("outside", 3, 40),
        ("0-5 degrees", 1, 10),
        ("5-10 degrees", 1, 20),
        ("10-15 degrees", 1, 30),
        ("90-180 degrees", 2, 45),
    ]
    assert rows[1]["ssim"] == pytest.approx(0.4)


# --- All of it


@dataclass
class Photo:
    """A photograph in memory."""

    pixels: np.ndarray
    orientation: int = 1
    may_be_masked: bool = False

    def image(self) -> np.ndarray:
        return self.pixels

    def mask(self) -> None:
        return None


def known_capture(count: int = 7) -> Capture:
    cameras, images = known_cameras(count), photograph_scene(known_scene(), known_cameras(count))
    photos = [Photo(pixels) for pixels in images.photos.numpy()]
    points = known_scene().means[:150].double().numpy()
    poses, sizes = cameras.world_to_camera.double().numpy(), np.array(images.sizes)
    intrinsics, colours = cameras.intrinsics().double().numpy(), np.zeros((150, 3), np.uint8)
    return Capture(Path(), images.names, poses, intrinsics, sizes, points, colours, photos)


def test_a_fit_for_a_panel_leaves_a_scene_that_encode_shows(tmp_path, capsys):
    file, scene = tmp_path / "panel.yaml", tmp_path / "scene.ply"
    panel(width_px=96, height_px=64, cone_deg=30.0).to_yaml(file)
    options = dict(steps=60, cap_max=400, test_every=3, cone=file, progress=False, folder=tmp_path / "run")
    result = lf.fit(known_capture(), **options)
    result.save(scene)
    assert (
        result.pruning is not None
        and result.gaussians.count == result.pruning.count == read_scene(scene).gaussians.count
    )
    said = json.loads((tmp_path / "run/scores.json").read_text())
    assert said["pruned"]["gaussians"] == result.pruning.count and said["angles"]["cone_deg"] == 30
    assert said["angles"]["rows"][0]["views"] == "inside the cone"
    assert 0 < said["frame"]["share"] <= 1 and "the panel's frame" in said["frame"]["protocol"]
    assert said["frame"]["views"][0]["name"] == said["pruned"]["views"][0]["name"]
    pictures = []
    for options in (["--rig", str(tmp_path / "scene.rig.yaml")], []):  # the rig beside it, and the framing within
        out = tmp_path / f"{len(pictures)}.png"
        assert cli.main(["encode", str(scene), "-o", str(out), "--panel", str(file), *options]) == 0
        pictures.append(out)
    from lightfield_gs.io.images import read_picture

    first, second = (read_picture(path).pixels for path in pictures)
    assert np.array_equal(first, second) and first.std() > 0.02


def test_a_fit_for_all_is_judged_in_the_same_cone():
    options, shown = dict(steps=3, cap_max=200, test_every=3, progress=False), panel(cone_deg=20.0)
    cone, whole = (lf.fit(known_capture(), **options, **how) for how in ({"cone": shown}, {"score_cone": 20.0}))
    assert cone.angles == whole.angles and whole.display is None and whole.pruning is None
    assert whole.angles is not None and len(whole.angles.angles_deg) == 2


def test_a_fit_for_no_panel_opens_from_the_most_central_photograph(tmp_path, capsys):
    capture, scene = known_capture(), tmp_path / "scene.ply"
    lf.fit(capture, steps=3, cap_max=200, progress=False).save(scene)
    panel(width_px=96, height_px=64).to_yaml(tmp_path / "panel.yaml")
    rig = tmp_path / "rig.yaml"
    words = ["encode", scene, "-o", tmp_path / "a.png", "--panel", tmp_path / "panel.yaml", "--save-rig", rig]
    assert cli.main([str(word) for word in words]) == 0
    centre = place_cone(capture, 40.0).centre
    assert np.allclose(Rig.from_yaml(rig).world_to_camera, capture.world_to_camera[centre], atol=1e-6)
    assert not rig.with_name("scene.rig.yaml").exists()
