"""A fit of the real photographs of the small capture in the repository."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

import lightfield_gs as lf
from lightfield_gs.io.captures.capture import read_capture

BANANA = Path(__file__).resolve().parents[2] / "lightfield_gs/data/banana"


@pytest.mark.not_sanitized
def test_a_fit_of_real_photographs_shows_others_better_and_better():
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nothing has to be assumed of the capture
        capture = read_capture(BANANA, longest_px=94)
    assert len(capture.names) == 14 and len(capture.points) > 4000
    result = lf.fit(
        capture, steps=400, cap_max=1500, sh_degree=1, test_every=9, evaluate_every=40, device="cpu", progress=False
    )
    first, last = result.history[0]["psnr_db"], result.history[-1]["psnr_db"]
    assert result.scores is not None and result.scores.names == ["DSC_0427.jpg", "DSC_0438.jpg"]
    assert last > first + 3 and last > 27, result.history
