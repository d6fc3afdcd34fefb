"""The Morton order, against bits put together one by one."""

from __future__ import annotations

import torch

from lightfield_gs.fitting.density import morton_codes, morton_order


def test_codes_take_the_bits_of_the_axes_by_turns():
    means = torch.rand(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = morton_codes(means).tolist()
    ordered = means.sort(0).values
    low, high = ordered[2], ordered[497]  # 0.5 % of 500 lie beyond either side
    for mean, code in zip(means, found):
        numbers = [min(max(int(n), 0), 2**21 - 1) for n in ((mean - low) / (high - low) * 2**21).tolist()]
        want = sum((number >> bit & 1) << (3 * bit + axis) for axis, number in enumerate(numbers) for bit in range(21))
        assert code == want


def test_equal_places_keep_their_order_and_neighbours_come_together():
    means = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1))
    means[1::2] = means[::2]
    order = morton_order(means)
    assert torch.equal(order.sort().values, torch.arange(4000))
    pairs = order.view(-1, 2)
    assert torch.equal(pairs[:, 1], pairs[:, 0] + 1)  # of two at one place, the first comes first
    steps = means[order].diff(dim=0).norm(dim=1).mean()
    assert steps < 0.2 * means.diff(dim=0).norm(dim=1).mean()


def test_one_place_for_all_is_no_error():
    assert torch.equal(morton_order(torch.ones(7, 3)), torch.arange(7))
