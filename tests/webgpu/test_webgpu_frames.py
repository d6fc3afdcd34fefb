"""Runs of frames by WebGPU: what the host sends and how often, and frames that need more than the one before."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_cases import panel, random_scene, rig

from lightfield_gs import Encoder, encode
from lightfield_gs.webgpu.pipelines import WORKGROUPS_ACROSS
from lightfield_gs.webgpu.plans import CHUNK, MOST_PAIRS, Counters, Pass, Room

# The drivers of GPUs are not ours, and what is drawn on the CPU is tested elsewhere
pytestmark = pytest.mark.not_sanitized


@pytest.mark.parametrize("degree", [0, 2])
def test_a_run_of_frames_sends_the_scene_once_and_waits_once_a_frame(frames, degree):
    shown, gaussians = panel(), random_scene(60, degree, dtype=torch.float32)
    encoder = Encoder(shown, rig(shown), device="webgpu")
    encoder(gaussians)
    frames.rate = 1e12  # of a GPU: programs of the CPU need several submissions
    for k in range(1, 4):
        encoder.rig = rig(shown, 0.02 * k)
        submissions, uploaded = frames.submissions, frames.buffers.uploaded_bytes
        image = encoder(gaussians)
        assert frames.submissions == submissions + 1 and frames.buffers.uploaded_bytes < uploaded + 2048
        assert torch.equal(image, encode(gaussians, shown, encoder.rig, device="webgpu"))
        assert (image.int() - encode(gaussians, shown, encoder.rig).int()).abs().max() <= 1
        encoder.forget()
        encoder(gaussians)  # in place of the scene that encode has put there


def test_a_frame_that_lacks_room_is_drawn_again(frames):
    """From far away lists are short; near by they have ten times the entries, and colours more vectors."""
    shown, gaussians = panel(), random_scene(400, 2, dtype=torch.float32)
    fan = rig(shown)
    far = replace(fan, world_to_camera=np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 30], [0, 0, 0, 1]]))
    encoder = Encoder(shown, far, device="webgpu")
    encoder(gaussians)
    for other in (fan, far, fan):
        encoder.rig = other
        assert (encoder(gaussians).int() - encode(gaussians, shown, other).int()).abs().max() <= 1


def test_places_are_the_floats_of_double_precision(frames):
    """Columns, parallax and rows of a turned rig before a panel of 8K, where a digit of a float is 5e-4 pixels."""
    shown, gaussians = panel(width_px=7680, height_px=32), random_scene(500, seed=6, dtype=torch.float32)
    fan = replace(rig(shown, 0.3, 0.2), focal_px=(5432.1, 5432.1), principal_point_px=(3840.3, 16.7))
    frames.tiling = 0
    encode(gaussians, shown, fan, device="webgpu")
    splats, reach = (
        np.frombuffer(frames.device.queue.read_buffer(frames.buffers[name], 0, 16 * 500), np.float32).reshape(-1, 4)
        for name in ("splat_a", "splat_c")
    )
    x, y, z, _ = np.asarray(fan.world_to_camera) @ np.c_[gaussians.means.double().numpy(), np.ones(500)].T
    sweep = float(fan.offset(0, shown))
    parallax = abs(sweep) * fan.focal_px[0] * (1 / fan.zero_depth - 1 / z)
    places = np.stack([fan.focal_px[0] * x / z + 3840.3, parallax, fan.focal_px[1] * y / z + 16.7], 1)
    drawn = reach[:, 2] >= 0
    expected = places[drawn].astype(np.float32)
    assert drawn.sum() > 20 and (splats[drawn, :3] == expected).mean() > 0.99
    np.testing.assert_array_max_ulp(splats[drawn, :3], expected, 1)


def test_depths_that_are_nearly_one_fall_into_the_order_of_the_cpu(frames):
    """On a plane that only a turned camera sees as parallel, depths differ by rounding alone."""
    count, shown = 900, panel()
    gaussians = random_scene(count, seed=4, dtype=torch.float32)
    fan = rig(shown, 0.3, 0.2)
    inverse = np.linalg.inv(np.asarray(fan.world_to_camera))
    place = np.random.default_rng(0).uniform(-0.7, 0.7, (count, 3)) * (1, 1, 0) + (0, 0, 2)
    gaussians.means[:] = torch.from_numpy(place @ inverse[:3, :3].T + inverse[:3, 3]).float()
    gaussians.scales[:] = 0.1
    drawn, expected = (encode(gaussians, shown, fan, device=where).int() for where in ("webgpu", None))
    assert expected.float().std() > 10 and (drawn - expected).abs().max() <= 1


def test_the_chunks_of_too_many_pairs_fit_into_one_dispatch():
    """Depths of a photo in the default panel: the pass is split, and only then do its lists have room."""
    room = Room([Pass(0, 240)])
    found = Counters(188_000_000, 40_000, 0, 188_135, 0, 0, 0.0, 0, ())
    room.grow(found, MOST_PAIRS)
    assert MOST_PAIRS // CHUNK < room.chunks <= WORKGROUPS_ACROSS
