"""The script that makes a small capture of a large one."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from fit_capture import write_capture
from PIL import Image

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.capture import read_capture
from training.data.reduce_capture import main, reduce_capture

BANANA = Path(__file__).resolve().parents[2] / "lightfield_gs/data/banana"
LONGEST_PX = 94


def test_a_reduced_capture_is_the_large_one_made_small(tmp_path):
    arguments = ["--source", str(BANANA), "--output", str(tmp_path / "small"), "--longest-px", str(LONGEST_PX)]
    assert main(arguments) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # cameras have the sizes of the photographs
        small = read_capture(tmp_path / "small")
    large = read_capture(BANANA, longest_px=LONGEST_PX)
    assert small.names == large.names and small.sizes_px.tolist() == large.sizes_px.tolist()
    np.testing.assert_allclose(small.world_to_camera, large.world_to_camera, atol=1e-8)
    # One focal length for both axes, though the sizes were rounded
    np.testing.assert_allclose(small.intrinsics, large.intrinsics, rtol=5e-3)
    np.testing.assert_allclose(small.points, large.points, rtol=1e-5)
    np.testing.assert_array_equal(small.colours, large.colours)
    assert small.photographs[0].distortion == large.photographs[0].distortion
    assert np.abs(small.image(4).astype(float) - large.image(4)).mean() < 6  # of 255: JPEG
    with Image.open(tmp_path / "small/images" / small.names[0]) as image:
        assert not image.getexif()


def test_a_capture_that_cannot_be_reduced_is_refused(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").touch()
    with pytest.raises(InputError, match="full exists: remove it"):
        reduce_capture(BANANA, tmp_path / "full")
    with pytest.raises(InputError, match="expected a capture with a COLMAP model"):
        reduce_capture(write_capture(tmp_path / "nerf", 3), tmp_path / "small")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["full", "nerf"]
