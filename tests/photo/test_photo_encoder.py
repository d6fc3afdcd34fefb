"""Photo after photo to the image of a panel: the same as its steps one by one."""

import copy

import numpy as np
import pytest
import torch
from photo_cases import PANEL, photo, psnr_db, tiny_net

from lightfield_gs import InputError, Look, PhotoEncoder, encode
from lightfield_gs.models import SplatterNet
from lightfield_gs.models.splatter_net import PRETRAINED
from lightfield_gs.panels.rig import frame_photo


@pytest.mark.parametrize("shape", [(40, 90), (200, 30)])
@pytest.mark.parametrize("views", ["integer", "continuous"])
def test_image_is_that_of_the_steps(shape, views):
    net, rgba = tiny_net(), photo(*shape)
    encoder = PhotoEncoder(net, PANEL, views=views, background=(0.2, 0.5, 0.9))
    stats = {}
    found = encoder(rgba, stats)
    gaussians = net.predict(rgba)
    rig = frame_photo(gaussians, PANEL)
    assert torch.equal(found, encode(gaussians, PANEL, rig, views=views, background=(0.2, 0.5, 0.9)))
    assert encoder.rig.to_dict() == rig.to_dict() and encoder.gaussians.count == gaussians.count
    assert list(stats["stages_ms"]) == ["crop", "network", "framing", "encode"]
    assert all(ms > 0 for ms in stats["stages_ms"].values())


def test_a_look_changes_the_framing():
    net, rgba = tiny_net(), photo(40, 90)
    encoder = PhotoEncoder(net, PANEL, look=Look(depth_amount=0.5, zoom=1.5))
    found = encoder(rgba)
    gaussians = net.predict(rgba)
    rig = Look(depth_amount=0.5, zoom=1.5).applied(frame_photo(gaussians, PANEL), PANEL)
    assert encoder.rig.to_dict() == rig.to_dict() and torch.equal(found, encode(gaussians, PANEL, rig))
    encoder.look = None
    assert torch.equal(encoder(rgba), PhotoEncoder(net, PANEL)(rgba))


def test_bytes_are_taken_as_they_are():
    as_bytes = np.round(255 * photo(50, 60)).astype(np.uint8)
    encoder = PhotoEncoder(tiny_net(), PANEL, output="float32")
    torch.testing.assert_close(encoder(as_bytes), encoder(as_bytes / np.float32(255)))


def test_later_changes_of_the_network_do_not_show():
    net, rgba = tiny_net(), photo(50, 60)
    encoder = PhotoEncoder(net, PANEL)
    before = encoder(rgba)
    torch.nn.init.normal_(net.head.weight)
    assert torch.equal(encoder(rgba), before)


def test_what_is_not_seen_does_not_move_the_rig():
    net, rgba = tiny_net(), photo(70, 40)
    everything = net.all_gaussians(net.crops(torch.from_numpy(rgba), None)[0], net.photo_intrinsics())
    seen = net.predict(rgba)
    assert seen.count < everything.count
    rigs = [frame_photo(gaussians, PANEL) for gaussians in (everything, seen)]
    assert rigs[0].zero_depth == pytest.approx(rigs[1].zero_depth, rel=1e-5)
    assert rigs[0].focal_px == pytest.approx(rigs[1].focal_px, rel=1e-5)
    images = [encode(gaussians, PANEL, rigs[1]).int() for gaussians in (everything, seen)]
    assert (images[0] - images[1]).abs().max() <= 1


@pytest.mark.parametrize(
    "rgba, word",
    [
        (np.zeros((8, 8, 3), np.float32), "H,W,4"),
        (np.zeros((8, 8, 4), np.int32), "65535"),
        (np.zeros((8, 8, 4), np.uint8), "mask"),
        (np.full((8, 8, 4), np.nan, np.float32), "finite"),
    ],
)
def test_what_is_no_photo_is_refused_and_the_next_is_drawn(rgba, word):
    encoder = PhotoEncoder(tiny_net(), PANEL)
    with pytest.raises(InputError, match=word):
        encoder(rgba)
    assert encoder(photo(20, 20)).shape == (PANEL.height_px, PANEL.width_px, 3)


def test_unknown_options_are_refused():
    for options in ({"views": "all"}, {"output": "float64"}):
        with pytest.raises(InputError, match=next(iter(options.values()))):
            PhotoEncoder(tiny_net(), PANEL, **options)


@pytest.mark.skipif(not PRETRAINED.exists(), reason="this checkout has no trained checkpoint")
def test_a_network_in_bfloat16_draws_the_same():
    net, rgba = SplatterNet.from_pretrained(), photo(150, 120)
    half = copy.deepcopy(net)
    half.unet.to(torch.bfloat16)
    gaussians = net.predict(rgba)
    rig = frame_photo(gaussians, PANEL)
    images = [encode(g, PANEL, rig) for g in (gaussians, half.predict(rgba))]
    assert psnr_db(*images) > 40


def test_a_rig_of_all_photos_draws_each_by_it():
    net, rgba = tiny_net(), photo(60, 80)
    first = PhotoEncoder(net, PANEL)
    image = first(rgba)
    fixed = PhotoEncoder(net, PANEL, rig=first.rig)
    assert torch.equal(fixed(rgba), image) and fixed.rig is first.rig
    other = photo(80, 40, (0.1, 0.3, 0.8))
    assert torch.equal(fixed(other), encode(net.predict(other), PANEL, first.rig))
    with pytest.raises(InputError, match="look"):
        PhotoEncoder(net, PANEL, rig=first.rig, look=Look(zoom=2.0))
