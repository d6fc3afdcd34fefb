"""Counter-based random numbers: the published vectors of Philox, and the numbers from its words."""

from __future__ import annotations

import math

import pytest
import torch

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.random import normals, uniforms

ONES = 0xFFFFFFFF


@pytest.mark.parametrize(  # philox4x32 10 of Random123's kat_vectors: counter, key, words
    "counter, key, words",
    [
        ([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([ONES] * 4, [ONES] * 2, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            [0xA4093822, 0x299F31D0],
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_known_answers_of_philox(counter, key, words):
    assert _core.philox4x32(counter, key) == words


def test_uniforms_are_the_words_of_their_stream():
    found = uniforms(seed=2**33 + 5, step=7, purpose=3, count=5)
    for i in range(5):
        words = _core.philox4x32([i // 2, 0, 7, 3], [5, 2])
        high, low = words[2 * (i % 2) : 2 * (i % 2) + 2]
        assert found[i] == ((high << 32 | low) >> 11) / 2**53
    assert torch.equal(uniforms(2**33 + 5, 7, 3, 40_001)[:5], found)  # a number depends on its index alone


@pytest.mark.parametrize("change", [dict(seed=1), dict(seed=2**32), dict(step=1), dict(purpose=1)])
def test_other_seeds_steps_and_purposes_have_other_numbers(change):
    stream = dict(seed=0, step=0, purpose=0)
    assert not (uniforms(**stream, count=1000) == uniforms(**stream | change, count=1000)).any()


def test_numbers_are_spread_as_they_should():
    count = 400_000
    flat = uniforms(11, 0, 2, count)
    assert 0 <= flat.min() and flat.max() < 1
    error = (flat.sort().values - torch.arange(count) / count).abs().max()  # Kolmogorov-Smirnov
    assert error < 1.95 / math.sqrt(count)  # of one in a thousand
    for dtype in (torch.float32, torch.float64):
        z = normals(11, 0, 2, count, dtype).double()
        for power, moment in ((1, 0), (2, 1), (3, 0), (4, 3)):
            spread = math.sqrt(math.prod(range(1, 2 * power, 2)) / count)  # of z^power, at most
            assert abs((z**power).mean() - moment) < 4 * spread, power
        pairs = z.view(-1, 2)
        assert abs((pairs[:, 0] * pairs[:, 1]).mean()) < 4 / math.sqrt(count / 2)
        assert z.abs().max() < 6.8
        torch.testing.assert_close(normals(11, 0, 2, 1001, dtype).double(), z[:1001], rtol=0, atol=0)
    torch.testing.assert_close(
        normals(11, 0, 2, 1001), normals(11, 0, 2, 1001, torch.float64).float(), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(seed=-1), "seed must be"),
        (dict(step=2**32), "step must be"),
        (dict(purpose=0.5), "purpose must be a whole number"),
        (dict(count=-1), "count must be"),
    ],
)
def test_what_cannot_be_used_is_said(change, message):
    with pytest.raises(InputError, match=message):
        uniforms(**dict(seed=0, step=0, purpose=0, count=1) | change)
