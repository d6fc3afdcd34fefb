"""Depths of live pictures: by a network, by two eyes and by a half of the picture; steady, and new at a cut."""

from collections.abc import Iterable

import numpy as np
import pytest
import torch
from depth_weights import moge_2, video_depth_anything
from live_sources import Clock
from rgbd_scene import textured

from lightfield_gs.app.options import AUTO, LookOptions, PhotoOptions, RenderOptions
from lightfield_gs.base.cli_messages import capturable_streams
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import Picture
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.health import Health
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.sources import Frame
from lightfield_gs.panels.panel import Panel
from lightfield_gs.scene.gaussians import Gaussians

pytest.importorskip("av", reason="live sources need the extra `video`")
PANEL = Panel.load("toy-8v")
ROWS, COLUMNS = np.mgrid[:96, :192]


def live(pictures: Iterable[np.ndarray], photo: PhotoOptions) -> tuple[LiveScenes, list[Gaussians]]:
    """The scenes of pictures, uint8 [H, W, 3]."""
    frames = [Frame(n, 0.0, lambda scaling, p=p: Picture(p)) for n, p in enumerate(pictures)]
    how = RenderOptions(), LookOptions(), PANEL, "cpu", Detail(30, 1_000_000), Health()
    scenes = LiveScenes(Clock(1, 1), photo, *how)
    with capturable_streams(), torch.inference_mode():
        scenes.settle(iter(frames))
        return scenes, [scene for _, scene in scenes(iter(frames))]


def noisy(picture: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 3, picture.shape)
    return (picture + noise).clip(0, 255).astype(np.uint8)


def photo_depths(scene: Gaussians) -> torch.Tensor:
    """The depths of the pixels, which come first."""
    return scene.means[: ROWS.size, 2]


def view_px(scenes: LiveScenes, z: torch.Tensor) -> torch.Tensor:
    """Where points in the middle are in the picture of the right-most view, pixels of the panel."""
    camera = scenes.rig.cameras(PANEL, [0])
    points = torch.stack([torch.zeros_like(z), torch.zeros_like(z), z, torch.ones_like(z)], 1).double()
    seen = points @ camera.world_to_camera[0].T.double()
    return camera.focal_px[0, 0] * seen[:, 0] / seen[:, 2] + camera.principal_point_px[0, 0]


SCENE = np.stack([COLUMNS, 2 * ROWS, 128 + 100 * np.sin(COLUMNS / 9)], 2).clip(0, 255).astype(np.uint8)
CUT = np.ascontiguousarray(255 - SCENE[::-1])


def test_a_networks_depths_are_steady_and_begin_anew_with_the_first_picture_after_a_cut(tmp_path):
    photo = PhotoOptions(depth=AUTO, depth_model=str(moge_2(tmp_path / "net")))
    still = [noisy(SCENE, number) for number in range(8)]
    scenes, made = live([*still, CUT], photo)
    places = [view_px(scenes, photo_depths(scene)) for scene in made[:8]]
    steps = [float((after - before).abs().mean()) for before, after in zip(places, places[1:])]
    assert np.mean(steps) <= 0.3, steps
    _, alone = live([still[0], CUT], photo)
    assert torch.equal(made[8].means, alone[1].means)


def test_a_network_that_waits_for_the_next_pictures_is_refused(tmp_path):
    photo = PhotoOptions(depth=AUTO, depth_model=str(video_depth_anything(tmp_path / "net")))
    with pytest.raises(InputError, match="single pictures"):
        live([SCENE, SCENE], photo)


def test_two_eyes_side_by_side_give_depths():
    pytest.importorskip("cv2", reason="stereo pairs need the extra `stereo`")
    (left, depth), (right, _) = textured(-0.06), textured(0.06)
    pair = (255 * np.concatenate([left, right], 1)).round().astype(np.uint8)
    scenes, made = live([pair, noisy(pair, 1)], PhotoOptions(stereo_in="sbs"))
    for scene in made:
        found = 1 / scene.means[: depth.size, 2]
        assert np.corrcoef(found.numpy(), (1 / depth).ravel())[0, 1] > 0.9
    assert scenes.detail.scaling.is_nearest is False


def test_a_half_of_the_picture_is_its_depth():
    nearness = np.where((ROWS - 48) ** 2 + (COLUMNS - 96) ** 2 < 900, 255, 51).astype(np.uint8)
    picture = np.concatenate([SCENE, np.repeat(nearness[..., None], 3, 2)], 1)
    scenes, (scene,) = live([picture], PhotoOptions(rgbd="right", depth_range=(1.0, 2.0)))
    z = photo_depths(scene).reshape(ROWS.shape)
    assert float(z[48, 96]) == pytest.approx(1.0, rel=1e-3)
    assert float(z[5, 5]) == pytest.approx(1 / (0.5 + 0.2 * 0.5), rel=1e-3)
    assert scenes.detail.scaling.is_nearest


WALL = np.stack([96 + 60 * np.sin(COLUMNS / 5), 128 + 70 * np.cos(ROWS / 4), 60 + (7 * COLUMNS + 11 * ROWS) % 97], 2)


def passing(number: int, wall: np.ndarray = WALL) -> tuple[np.ndarray, np.ndarray]:
    """A picture with its nearness beside it, of a ball that passes before a wall; and where the ball is, bool."""
    ball = (ROWS - 48) ** 2 + (COLUMNS - 30 - 12 * number) ** 2 < 22**2
    colours = np.where(ball[..., None], (230, 40, 30), wall).clip(0, 255).astype(np.uint8)
    nearness = np.where(ball, 255, 40).astype(np.uint8)
    return np.concatenate([colours, np.repeat(nearness[..., None], 3, 2)], 1), ball


def behind(scene: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """The colours 0..255 of the layer behind, of 2 x 2 pixels each, and where it is, bool."""
    rows, columns = ROWS.shape[0] // 2, ROWS.shape[1] // 2
    layer = slice(ROWS.size, ROWS.size + rows * columns)
    colours = 255 * (0.5 + 0.28209479177387814 * scene.sh[layer, 0].reshape(rows, columns, 3).numpy())
    return colours, (scene.opacities[layer] > 0).reshape(rows, columns).numpy()


def halved(values: np.ndarray) -> np.ndarray:
    return values.reshape(values.shape[0] // 2, 2, values.shape[1] // 2, 2, -1).mean((1, 3))


def test_what_was_seen_stays_behind_what_passes_until_the_camera_moves_or_the_picture_is_cut():
    photo = PhotoOptions(rgbd="right", depth_range=(1.0, 2.0))
    clip = [passing(number) for number in range(11)]
    _, made = live([picture for picture, _ in clip], photo)
    covered = halved(clip[-1][1])[..., 0] == 1
    colours, is_there = behind(made[-1])
    seen = covered & is_there
    assert seen.sum() > 0.5 * covered.sum()
    assert np.abs(colours - halved(WALL))[seen].mean() < 3  # the texture, not a smooth guess
    guess, _ = behind(live([clip[-1][0]], photo)[1][0])
    assert np.abs(guess - halved(WALL))[seen].mean() > 15
    moved = [passing(number, np.roll(WALL, 6 * number, 1))[0] for number in range(11)]
    cut = [*(picture for picture, _ in clip[:10]), passing(10, 255 - WALL[::-1])[0]]
    for pictures in (moved, cut):
        anew, _ = behind(live(pictures, photo)[1][-1])
        alone, _ = behind(live(pictures[-1:], photo)[1][0])
        np.testing.assert_array_equal(anew, alone)
