"""Depth maps that telephones put into their HEIC files."""

from pathlib import Path

import numpy as np
import pytest
from command_line import run
from heic_maker import heic
from PIL import Image

import lightfield_gs as lf
from lightfield_gs.io.images import read_picture
from lightfield_gs.photo.embedded_depth import embedded_facts, embedded_notes, find_embedded_depth

pytest.importorskip("pi_heif", reason="needs the package pi-heif")

ROWS, COLUMNS = np.mgrid[:48, :64]
PHOTO = np.stack([4 * COLUMNS, 5 * ROWS, np.full_like(ROWS, 90)], 2).astype(np.uint8)
DEPTH = np.linspace(0, 255, 32).round().astype(np.uint8)[None].repeat(24, 0)  # near on the right
REST = "-o o.png --panel p.yaml --device cpu"
EXIF_6 = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"  # shown after a quarter turn clockwise


def test_disparities_of_a_portrait_photo_become_distances(folder, capsys):
    Path("a.heic").write_bytes(heic(PHOTO, DEPTH, facts={"d_min": 0.5, "d_max": 2.0}))
    inside = find_embedded_depth("a.heic")
    assert inside is not None and (inside.near, inside.far) == (0.5, 2.0)
    out = run(capsys, f"encode a.heic {REST} --save-gaussians g.ply")
    assert "depth inside it (HEIC disparity): disparity turned into z 0.5" in out and "bright is near" in out
    z = lf.Gaussians.load("g.ply").means[: 48 * 64, 2].reshape(48, 64)[20].numpy()
    expected = 1 / (0.5 + 1.5 * ((np.arange(64) + 0.5) / 64))
    assert np.allclose(z[6:-6], expected[6:-6], rtol=0.05)
    assert "depth inside: 32 x 24, HEIC disparity, near 0.5, far 2.0" in run(capsys, "info a.heic")
    assert "is not used" in embedded_notes("a.heic", is_depth_used=False)[0]


@pytest.mark.parametrize("depth_turn, exif", [(None, b""), (0, EXIF_6)])
def test_a_depth_map_is_as_upright_as_its_photo(tmp_path, depth_turn, exif):
    """Turned by the boxes of both, or by those of the photo alone."""
    path = tmp_path / "a.heic"
    path.write_bytes(heic(PHOTO, DEPTH, turn=3, depth_turn=depth_turn, exif=exif))
    photo, inside = read_picture(path), find_embedded_depth(path)
    assert photo.pixels.shape == (64, 48, 3) and photo.orientation == 1 and inside is not None
    assert np.abs(photo.pixels.astype(int) - np.rot90(PHOTO, -1)).mean() < 6
    assert np.abs(inside.numbers(path).values.astype(int) - np.rot90(DEPTH, -1)).max() < 6


@pytest.mark.parametrize(
    "facts, limits, is_inverse",
    [
        ({"z_near": 0.75, "z_far": 3.0, "type": 0}, (0.75, 3.0), True),
        ({"z_near": 0.75, "z_far": 3.0, "type": 2}, (0.75, 3.0), False),
        ({"d_min": 0.0, "d_max": 2.0}, (0.5, 25.0), True),  # down to infinitely far things
        ({"d_min": 2.0, "d_max": 0.5}, (None, None), True),
        ({}, (None, None), True),
        (None, (None, None), True),
    ],
)
def test_limits_are_those_of_the_file(tmp_path, facts, limits, is_inverse):
    path = tmp_path / "a.heic"
    path.write_bytes(heic(PHOTO, DEPTH, facts=facts))
    inside = find_embedded_depth(path)
    assert inside is not None and inside.is_inverse == is_inverse
    found = inside.near, inside.far
    assert found == (limits if limits[0] is None else pytest.approx(limits, rel=1e-5))
    if facts and facts.get("d_min") == 0:
        values = inside.numbers(path).values.astype(float) / 65535
        disparities = 0.04 + 1.96 * values[0]
        assert np.allclose(disparities, np.maximum(DEPTH[0] / 127.5, 0.04), atol=0.03)


def test_a_photo_without_a_depth_map_has_none(tmp_path):
    (tmp_path / "a.heic").write_bytes(heic(PHOTO))
    assert find_embedded_depth(tmp_path / "a.heic") is None and not embedded_facts(tmp_path / "a.heic")
    Image.fromarray(PHOTO).save(tmp_path / "a.avif")
    assert find_embedded_depth(tmp_path / "a.avif") is None
