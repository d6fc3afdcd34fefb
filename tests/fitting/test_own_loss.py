"""A loss and a callback of one's own in `fit`."""

import pytest
import torch
from fit_capture import write_capture

import lightfield_gs as lf
from lightfield_gs import InputError
from lightfield_gs.fitting.photo_loss import photo_loss

QUICK = dict(steps=40, cap_max=200, device="cpu", progress=False, test_every=8)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("fit") / "capture", masked=True)


def usual(images, photos, weights):
    """The usual loss, by autograd."""
    assert photos.dtype == torch.float32 and float(photos.max()) <= 1 and weights is not None
    return photo_loss(images, photos, weights)


def squares(images, photos, weights):
    return ((images - photos).square().mean(-1) * weights).mean((1, 2)).sum()


def test_the_usual_loss_as_ones_own_fits_the_same(capture):
    expected, found = lf.fit(capture, **QUICK), lf.fit(capture, **QUICK, loss=usual)
    torch.testing.assert_close(found.gaussians.means, expected.gaussians.means)
    other = lf.fit(capture, **QUICK, loss=squares)
    assert not torch.allclose(other.gaussians.means, expected.gaussians.means)


def test_callbacks_see_the_fit_now_and_then_and_at_its_end(capture):
    seen = []
    result = lf.fit(capture, **QUICK, callback=seen.append, callback_every=15, evaluate_every=20)
    assert [state.step for state in seen] == [15, 30, 40]
    assert seen[0].scores is None and seen[-1].scores is result.scores
    assert len(seen[-1].gaussians) == len(result.gaussians) and seen[0].loss > seen[-1].loss > 0
    assert not torch.equal(seen[0].gaussians.means[:50], seen[1].gaussians.means[:50])


def test_a_fit_goes_on_with_the_loss_that_it_began_with(capture, tmp_path):
    lf.fit(capture, **QUICK, loss=squares, folder=tmp_path, stop=lambda: True)
    with pytest.raises(InputError, match="other loss"):
        lf.fit(capture, **QUICK, folder=tmp_path)
    stopped, whole = lf.fit(capture, **QUICK, loss=squares, folder=tmp_path), lf.fit(capture, **QUICK, loss=squares)
    assert torch.equal(stopped.gaussians.means, whole.gaussians.means)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"loss": 3}, "loss: expected l1-ssim, wd, or a function"),
        ({"loss": lambda images, photos, weights: 0.0}, r"loss: expected one number .* got 0\.0"),
        ({"loss": lambda images, photos, weights: (images - photos) ** 2}, r"got a tensor \[1, 32, 48, 3\]"),
        ({"callback": "print"}, "callback: expected a function"),
        ({"callback_every": 0}, "callback_every"),
    ],
)
def test_others_are_refused(capture, given, words):
    with pytest.raises(InputError, match=words):
        lf.fit(capture, **QUICK, **given)
