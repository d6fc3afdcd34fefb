"""Live pictures on a GPU against the CPU's: the same scenes, drawn in turn by one graph. Needs a GPU."""

import time
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from live_sources import Clock
from photo_cases import photo, psnr_db, tiny_net

from benchmarks.live import stand_in
from lightfield_gs import _core
from lightfield_gs.app.options import AUTO, LookOptions, PhotoOptions, RenderOptions
from lightfield_gs.base.cli_messages import capturable_streams
from lightfield_gs.io.images import Picture
from lightfield_gs.live.detail import Detail
from lightfield_gs.live.drawing import LiveRenderer
from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.scenes import LiveScenes
from lightfield_gs.live.sources import Frame
from lightfield_gs.panels.panel import Panel
from lightfield_gs.video.rendering import FrameOptions

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)
pytest.importorskip("av", reason="live sources need the extra `video`")
PANEL = Panel.load("toy-8v")
ROWS, COLUMNS = np.mgrid[:96, :192]


def drawn(pictures: list[np.ndarray], options: PhotoOptions, device: str) -> list[torch.Tensor]:
    """The panel's pictures of pictures that wait for each other, so that none is dropped."""
    detail = Detail(30, 1_000_000, network_px=98)
    scenes = LiveScenes(Clock(1, 1), options, RenderOptions(), LookOptions(), PANEL, device, detail, Health())
    frames = [Frame(number, 0.0, lambda scaling, p=p: Picture(p)) for number, p in enumerate(pictures)]
    images: list[torch.Tensor] = []

    def one_by_one() -> Iterator[Frame]:
        for frame in frames:
            while len(images) < frame.number:
                time.sleep(0.001)
            yield frame

    with capturable_streams(), torch.inference_mode():
        scenes.settle(iter(frames))
        how = scenes.drawn_as
        draw = LiveRenderer(PANEL, FrameOptions("integer", how.background), detail)
        for frame, scene in scenes(one_by_one()):
            image = draw(scene, scenes.rig, frame.number)
            torch.cuda.synchronize()
            images.append(torch.from_numpy(Drawn(image).pixels.copy()))
    return images


def moving(number: int) -> np.ndarray:
    """A ball before a wall, with its nearness beside it."""
    ball = (ROWS - 48) ** 2 + (COLUMNS - 40 - 20 * number) ** 2 < 22**2
    wall = np.stack([96 + 60 * np.sin(COLUMNS / 5), 128 + 70 * np.cos(ROWS / 4), 60 + 0 * ROWS], 2)
    colours = np.where(ball[..., None], (230, 40, 30), wall).clip(0, 255).astype(np.uint8)
    nearness = np.where(ball, 255, 40).astype(np.uint8)
    return np.concatenate([colours, np.repeat(nearness[..., None], 3, 2)], 1)


def test_layers_with_a_remembered_background_are_those_of_the_cpu():
    pictures = [moving(number) for number in range(6)]
    options = PhotoOptions(rgbd="right", depth_range=(1.0, 2.0))
    for image, expected in zip(drawn(pictures, options, "cuda"), drawn(pictures, options, "cpu"), strict=True):
        assert psnr_db(image, expected) > 38


def test_estimated_depths_are_those_of_the_cpu():
    """The network sees pictures that each device makes small in its own way."""
    ways = {}
    for device in ("cuda", "cpu"):
        with stand_in(device):
            options = PhotoOptions(depth=AUTO, depth_model="stand-in")
            pictures = [np.where(moving(n)[:, :192, :1] == 230, (230, 40, 30), (40, 120, 200)) for n in range(4)]
            ways[device] = drawn([picture.astype(np.uint8) for picture in pictures], options, device)
    for image, expected in zip(ways["cuda"], ways["cpu"], strict=True):
        assert psnr_db(image, expected) > 30


def test_objects_are_those_of_the_cpu(tmp_path):
    weights = tmp_path / "tiny.safetensors"
    tiny_net().save(weights)
    pictures = []
    for shift in (0, 5, 9):
        rgba = np.roll(photo(96, 128), shift, 1)
        pictures.append((255 * (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:])).astype(np.uint8))
    options = PhotoOptions(checkpoint=weights, detail="none")
    for image, expected in zip(drawn(pictures, options, "cuda"), drawn(pictures, options, "cpu"), strict=True):
        assert psnr_db(image, expected) > 33
