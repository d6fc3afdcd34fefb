"""An Encoder on CUDA: graphs that are replayed, and stages that are not repeated. Needs a GPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_cuda import BACKGROUND, LENS, most_apart, on_gpu, rig, scene_of

from lightfield_gs import Encoder, Gaussians, Panel, encode
from lightfield_gs.base.device import free_memory
from lightfield_gs.rasterizer import frame_cuda


@pytest.fixture(autouse=True)
def no_room_of_other_tests() -> None:
    frame_cuda._known.clear()


@pytest.fixture(params=[0, 1, 3])
def scene(request) -> Gaussians:
    return scene_of(request.param)


@pytest.mark.parametrize("views", ["integer", "continuous"])
def test_an_encoder_replays_frames(scene, views):
    panel, scene = Panel(**LENS), on_gpu(scene)
    encoder = Encoder(panel, rig(panel), views=views, background=BACKGROUND)
    options = dict(views=views, background=BACKGROUND)
    assert torch.equal(encoder(scene), encode(scene, panel, rig(panel), **options))
    graph = encoder._frames.captured.graph
    scene.opacities.mul_(0.9)  # the same tensors with other values, that take no more room: replayed
    assert torch.equal(encoder(scene), encode(scene, panel, rig(panel), **options))
    assert encoder._frames.captured.graph is graph
    fewer = Gaussians(*(t[::2].contiguous() for t in scene.fields().values()))
    assert torch.equal(encoder(fewer), encode(fewer, panel, rig(panel), **options))


def test_an_encoder_makes_room_when_a_scene_grows(scene):
    panel, scene = Panel(**LENS), on_gpu(scene)
    encoder = Encoder(panel, rig(panel))
    scene.scales.mul_(0.1)
    encoder(scene)
    scene.scales.mul_(30)
    for _ in range(3):
        image = encoder(scene)
        torch.cuda.synchronize()
        assert most_apart(image, encode(scene, panel, rig(panel))) <= 1  # a frame of the same kind, that makes room
    frame = encoder._frames.captured.frame
    assert frame.capacity >= frame.state()["intersections"]


@pytest.mark.parametrize("versioned", [False, True])
def test_an_encoder_repeats_what_may_have_changed(scene, versioned):
    panel, scene = Panel(**LENS), on_gpu(scene)
    encoder = Encoder(panel, rig(panel), background=BACKGROUND, versioned=versioned)
    lists, everything = {"order", "bin"}, {"project", "order", "bin", "composite"}

    def spared() -> set[str]:
        before = dict(encoder.stats["reused"])
        image = encoder(scene)
        torch.cuda.synchronize()
        expected = encode(scene, panel, encoder.rig, background=BACKGROUND)
        orders = [known.colour_order for known in (encoder._frames.frames, next(reversed(frame_cuda._known.values())))]
        if orders[0] > orders[1]:  # frames of a moving zero plane keep the highest so far: other roundings, no more
            assert most_apart(image, expected) <= 1
            assert (image != expected).float().mean() < 255 * 4 * frame_cuda._COLOUR_TOLERANCE
        else:
            assert torch.equal(image, expected)
        return {stage for stage, n in encoder.stats["reused"].items() if n > before[stage]}

    def expect(stages: set[str]) -> None:
        assert spared() == (stages if versioned else set())

    assert spared() == set()
    expect(everything)
    scene.sh.mul_(0.5)
    expect(lists)
    scene.sh[:, :, 0].mul_(0.9)
    expect(lists)
    scene.opacities.mul_(0.9)
    expect(set())
    encoder._frames.image[0].fill_(7)  # drawn over by the user
    expect(lists)
    for depth in (1.9, 1.8, 1.7):  # a moving zero plane, by launches
        encoder.rig = replace(encoder.rig, zero_depth=depth)
        expect(set())
    graph = encoder._frames.captured.graph
    scene.sh.mul_(0.9)
    expect(set())  # captured, now that the rig has come again
    assert encoder._frames.captured.graph is not graph
    expect(everything)
    scene.scales.data.mul_(0.9)  # not counted
    encoder.forget()
    expect(set())


def test_lists_of_another_geometry_are_not_kept(scene):
    panel, scene = Panel(**LENS), on_gpu(scene)
    encoder = Encoder(panel, rig(panel), versioned=True)
    encoder(scene)
    first = encoder.rig
    encoder.rig = replace(first, zero_depth=1.9)
    scene.means[:, 0].add_(0.05)
    encoder(scene)  # by launches; the captured frame knows nothing of the means
    encoder.rig = first
    scene.sh.mul_(0.5)
    assert torch.equal(encoder(scene), encode(scene, panel, first))


def test_what_torch_does_not_count_is_drawn_again(scene):
    panel = Panel(**LENS)
    with torch.inference_mode():
        uncounted = Gaussians(*(t.clone() for t in on_gpu(scene).fields().values()))
    encoder = Encoder(panel, rig(panel), versioned=True)
    for _ in range(2):
        encoder(uncounted)
    with torch.inference_mode():
        uncounted.opacities.mul_(0.5)  # takes no more room
    assert torch.equal(encoder(uncounted), encode(uncounted, panel, rig(panel)))
    assert not any(encoder.stats["reused"].values())


def test_memory_that_data_has_exchanged_is_read(scene):
    panel, scene = Panel(**LENS), on_gpu(scene)
    encoder = Encoder(panel, rig(panel))
    encoder(scene)
    scene.opacities.data = 0.5 * scene.opacities  # the same tensor, in another place; takes no more room
    assert torch.equal(encoder(scene), encode(scene, panel, rig(panel)))


def test_a_background_on_the_host_may_change_in_place(scene):
    panel, scene, background = Panel(**LENS), on_gpu(scene), np.array([0.2, 0.4, 0.6])
    encoder = Encoder(panel, rig(panel), background=background)
    encoder(scene)
    graph = encoder._frames.captured.graph
    encoder(scene)
    assert encoder._frames.captured.graph is graph
    background[:] = 1.0
    assert torch.equal(encoder(scene), encode(scene, panel, rig(panel), background=(1.0, 1.0, 1.0)))


def test_memory_that_torch_keeps_counts_as_room():
    device = torch.device("cuda", 0)
    before = free_memory(device)
    kept = torch.empty(1 << 30, dtype=torch.uint8, device=device)
    del kept
    assert free_memory(device) > before - (1 << 28)


TWO_GPUS = pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")


@TWO_GPUS
def test_scenes_on_another_device_than_the_current_one(scene):
    panel, images = Panel(**LENS), []
    for device in ("cuda:0", "cuda:1"):
        there = scene.to(device=device)
        images.append(Encoder(panel, rig(panel))(there).cpu())
        leaf = there.means.clone().requires_grad_()
        encode(replace(there, means=leaf), panel, rig(panel), output="float32").sum().backward()
        assert torch.cuda.current_device() == 0
    assert torch.equal(*images)
