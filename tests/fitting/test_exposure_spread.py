"""The spread of exposures, of rendered captures whose exposures are known, and what a fit does with it."""

import numpy as np
import pytest

from benchmarks import make_captures
from benchmarks.capture_stages import Room
from lightfield_gs.fitting.exposure_spread import LEAST_SPREAD, exposure_spread
from lightfield_gs.fitting.fit import fit
from lightfield_gs.io.captures.capture import read_capture

COUNT = 12


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Return a function of a spread: the capture with photographs of that spread, whole round a room with objects."""
    kept = {}

    def made(spread):
        if spread not in kept:
            logs = spread * np.resize([-1.0, 1.0, 0.5, -0.5], COUNT) / np.sqrt(0.625)
            gains = iter(np.exp(logs))
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(
                    make_captures,
                    "_photographed",
                    lambda image, _: np.rint(255 * (next(gains) * image).clip(0, 1)).astype(np.uint8),
                )
                folder = tmp_path_factory.mktemp("captures") / "room"
                make_captures.write_capture(folder, Room(3), "round", make_captures.Shape(COUNT, (160, 120)), 3)
            kept[spread] = folder
        return kept[spread]

    return made


@pytest.mark.parametrize("spread", [0.0, 0.03, 0.1])
def test_the_spread_is_that_of_the_photographs_although_things_hide_points(capture, spread):
    found = exposure_spread(read_capture(capture(spread)), range(COUNT))
    assert found == pytest.approx(spread, abs=LEAST_SPREAD / 2 + 0.1 * spread)


def test_photographs_without_common_points_have_none(capture):
    read = read_capture(capture(0.1))
    assert exposure_spread(read, [0, 1]) is None


def test_a_fit_has_exposures_where_they_differ_unless_told(capture, recwarn):
    small = {"steps": 2, "cap_max": 5000, "device": "cpu", "progress": False, "test_every": None}
    assert [fit(read_capture(capture(spread)), **small).settings.exposure for spread in (0.0, 0.1)] == [False, True]
    told = [str(warning.message) for warning in recwarn if "exposures" in str(warning.message)]
    assert len(told) == 1 and "exposure=False" in told[0]
    assert not fit(read_capture(capture(0.1)), exposure=False, **small).settings.exposure
