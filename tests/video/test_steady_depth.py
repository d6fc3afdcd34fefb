"""Estimated depths of pictures in a row: still things stay still, moving ones and cuts are kept apart."""

import numpy as np
import pytest
import torch

from lightfield_gs.photo.joint_upsampling import disparities_to_z
from lightfield_gs.photo.steady_depth import PictureEstimate, is_cut, steadied

ROWS, COLUMNS = np.mgrid[:48, :64]
SCENE = np.stack([COLUMNS / 64, ROWS / 48, 0.5 + 0.4 * np.sin(COLUMNS / 5)], 2).astype(np.float32)
DEPTH = torch.from_numpy(ROWS / 48 + 0.5 * np.cos(COLUMNS / 9)).float()
PIXELS = 775 / 2 / np.tan(np.radians(30)) * 1.2 * np.tan(np.radians(20))  # a view of a panel, its outermost eye, by 1/z


def noisy(count: int, seed: int = 0) -> list[tuple[int, PictureEstimate]]:
    """Estimates of a still scene in noise, each with a scale and an offset of its own."""
    random, found = np.random.default_rng(seed), []
    for number in range(count):
        photo = (SCENE + random.normal(0, 0.02, SCENE.shape)).clip(0, 1).astype(np.float32)
        values = DEPTH + torch.from_numpy(random.normal(0, 0.012, DEPTH.shape)).float()
        values += 0.06 * float(random.normal()) * torch.from_numpy(COLUMNS / 64).float()
        found.append((number, PictureEstimate.of(float(random.uniform(0.5, 2)) * values + 3, photo)))
    return found


def change_px(estimates: list[tuple[int, PictureEstimate]]) -> float:
    """Mean change of disparity from one frame to the next, pixels of a panel's view."""
    shifts = [
        PIXELS / disparities_to_z(each.disparities, None, each.limits).z(each.disparities) for _, each in estimates
    ]
    return float(np.mean([float((after - before).abs().mean()) for before, after in zip(shifts, shifts[1:])]))


def test_still_pixels_stay_where_they_are():
    estimates = noisy(24)
    result = list(steadied(estimates, has_scale=False))
    assert [number for number, _ in result] == list(range(24))
    assert change_px(estimates) > 1.2 and change_px(result) <= 0.3


def test_live_pictures_are_steady_without_the_next_and_a_cut_begins_anew_at_once():
    """No picture waits: each is yielded before the next is read."""
    read: list[int] = []

    def numbered(estimates):
        for number, estimate in estimates:
            read.append(number)
            yield number, estimate

    estimates = noisy(24)
    result = []
    for number, estimate in steadied(numbered(estimates), has_scale=False, ahead=0):
        assert read[-1] == number
        result.append((number, estimate))
    assert change_px(estimates) > 1.2 and change_px(result) <= 0.3
    other = [(number + 24, PictureEstimate(9 - each.disparities, 1 - each.colours**2)) for number, each in noisy(3, 1)]
    after = list(steadied([*estimates, *other], has_scale=False, ahead=0))[24:]
    assert all(
        torch.equal(a.disparities, b.disparities) for (_, a), (_, b) in zip(after, steadied(other, False, ahead=0))
    )


def test_an_interrupted_run_goes_on_with_the_same_numbers():
    estimates = noisy(12)
    whole = dict(steadied(estimates, has_scale=False, reach=2))
    later = dict(steadied(estimates[4:], has_scale=False, reach=2))
    assert all(torch.equal(whole[number].disparities, later[number].disparities) for number in range(6, 12))


def test_nothing_is_averaged_across_a_cut():
    other = [(number + 8, PictureEstimate(9 - each.disparities, 1 - each.colours**2)) for number, each in noisy(8, 1)]
    first = noisy(8)
    assert is_cut(first[0][1].colours, other[0][1].colours) and not is_cut(first[0][1].colours, first[1][1].colours)
    both = list(steadied([*first, *other], has_scale=False))
    alone = [*steadied(first, has_scale=False), *steadied(other, has_scale=False)]
    assert all(torch.equal(a.disparities, b.disparities) for (_, a), (_, b) in zip(both, alone))


def test_a_pan_is_no_cut():
    assert not is_cut(torch.from_numpy(SCENE), torch.from_numpy(np.roll(SCENE, 30, 1)))


def test_moving_things_do_not_smear():
    estimates = []
    for number in range(12):
        photo, values = SCENE.copy(), DEPTH.clone()
        photo[10:30, 4 * number : 4 * number + 10] = 1, 0, 0
        values[10:30, 4 * number : 4 * number + 10] = 4
        estimates.append((number, PictureEstimate.of(values, photo)))
    _, middle = list(steadied(estimates, has_scale=False))[6]
    assert float((middle.disparities - estimates[6][1].disparities).abs().median()) < 0.05
    assert float(middle.disparities[14:26, 26:32].min()) > 3 and float(middle.disparities[14:26, 45:60].max()) < 2


def test_scales_of_distances_are_averaged():
    estimates = [
        (number, PictureEstimate.of(DEPTH + 2, SCENE))
        if number % 2
        else (number, PictureEstimate.of(3 * (DEPTH + 2), SCENE))
        for number in range(9)
    ]
    result = [float(each.disparities.mean()) for _, each in steadied(estimates, has_scale=True)]
    assert max(result[3:6]) / min(result[3:6]) == pytest.approx(1, rel=0.1)
