"""Colours of photos in sRGB, whatever their files say that they are; AVIF and HEIC."""

import struct
import sys
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest
from icc_profile import SRGB_BLUE, SRGB_GREEN, SRGB_RED, matrix_profile
from PIL import Image, ImageCms, features
from plain_photos import HEIGHT, THING, WIDTH, photo, picture, save

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_image, write_image
from lightfield_gs.photo.load import load_photo
from lightfield_gs.show.preview import to_integers

SWAPPED = matrix_profile(SRGB_GREEN, SRGB_RED, SRGB_BLUE, name="swapped")


@pytest.mark.parametrize("suffix, options", [("png", {}), ("jpg", {}), ("tif", {}), ("webp", {"lossless": True})])
def test_an_embedded_profile_is_honoured(tmp_path, suffix, options):
    found = photo(save(tmp_path / f"a.{suffix}", picture(colour=(0.8, 0.3, 0.1)), icc_profile=SWAPPED, **options))
    assert np.abs(found.pixels[130, 170, :3] / 255 - [0.3, 0.8, 0.1])[:2].max() < 0.02
    assert found.messages[1] == "profile 'swapped' converted to sRGB" and found.notes == []


def test_profiles_that_say_srgb_or_nothing(tmp_path):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    values = to_integers(picture(), 8)
    for profile, word in ((srgb, ""), (SWAPPED[:200], "cannot be read"), (b"no profile", "cannot be read")):
        for suffix in ("png", "tif"):
            found = photo(save(tmp_path / f"a.{suffix}", picture(), icc_profile=profile))
            assert np.array_equal(found.pixels[..., :3], values) and len(found.messages) == 1
            assert [word in note for note in found.notes] == ([True] if word else [])


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_a_png_without_a_profile_has_its_gamma_or_a_note(tmp_path):
    stored = save(tmp_path / "a.png", picture(colour=(0.5, 0.1, 0.1))).read_bytes()
    p3 = struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)
    for extra, word in (
        (chunk(b"gAMA", struct.pack(">I", 100000)), ""),
        (chunk(b"cHRM", p3), "other primary colours"),
        (chunk(b"cICP", bytes([9, 16, 0, 1])), "CICP 9/16"),
    ):
        (tmp_path / "a.png").write_bytes(stored[:33] + extra + stored[33:])
        found = photo(tmp_path / "a.png")
        assert [word in note for note in found.notes] == ([True] if word else [])
        assert found.floats()[130, 170, 0] == pytest.approx(0.502 if word else 0.7366, abs=1e-3)
        assert ("linear, encoded as sRGB" in found.messages) == (word == "")


def test_sixteen_bits_with_a_profile_are_converted_in_eight(tmp_path):
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, "uint16")
    spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(SWAPPED)}]"), np.frombuffer(SWAPPED, np.uint8))
    out = oiio.ImageOutput.create(str(tmp_path / "a.png"))
    assert out.open(str(tmp_path / "a.png"), spec)
    assert out.write_image(to_integers(picture(colour=(0.8, 0.3, 0.1)), 16)) and out.close()
    found = photo(tmp_path / "a.png")
    assert (
        np.abs(found.pixels[130, 170, :3] / 255 - [0.3, 0.8, 0.1])[:2].max() < 0.02 and "in 8 bits" in found.messages[1]
    )


@pytest.mark.parametrize("suffix, dtype", [("tif", "uint8"), ("tif", "uint16"), ("exr", "float32")])
def test_associated_alpha_is_undone(tmp_path, suffix, dtype):
    """Of a file that holds colours times alpha, 128 of 255."""
    most = 1 if dtype == "float32" else np.iinfo(dtype).max
    half = 0.5 if most == 1 else 2 * round(most * 64 / 255)
    stored = np.array([[[half, half / 2, 0, half], [0, 0, 0, 0]]], dtype)
    path = str(tmp_path / f"a.{suffix}")
    out = oiio.ImageOutput.create(path)
    assert out.open(path, oiio.ImageSpec(2, 1, 4, dtype)) and out.write_image(stored) and out.close()
    assert np.allclose(read_image(path), [[[1, 0.5, 0, half / most], [0, 0, 0, 0]]], atol=0.003)


def test_linear_files_are_encoded_as_a_photo_is(tmp_path):
    linear = np.where(THING[..., None], [0.5, 0.001, 2.0], 0.8).astype(np.float32)
    write_image(tmp_path / "a.exr", linear)
    found = photo(tmp_path / "a.exr")
    assert np.allclose(found.pixels[130, 170, :3], [0.735357, 0.01292, 1], atol=1e-5)  # IEC 61966-2-1
    assert "linear, encoded as sRGB" in found.messages and "brighter than white" in found.notes[0]


# AVIF and HEIC


@pytest.mark.skipif(not features.check("avif"), reason="this Pillow reads no AVIF")
def test_avif_is_read_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    save(tmp_path / "a.avif", picture(), quality=95, exif=exif)
    found = load_photo(tmp_path / "a.avif")
    assert found.shape == (WIDTH, HEIGHT, 4) and np.abs(found[..., 3] - np.rot90(THING, -1)).mean() < 0.02


def test_heic_takes_a_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    (tmp_path / "a.jpg").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(64))
    with pytest.raises(InputError, match=r"a.jpg is a HEIC image.* pip install .*pi-heif.*PNG or JPEG"):
        load_photo(tmp_path / "a.jpg")


def test_heic_is_read():
    pytest.importorskip("pi_heif")
    from fuzzing.readers import CORPUS

    pixels = read_image(CORPUS / "heif" / "small.heic")
    ramp = np.linspace(0, 1, 12 * 16 * 3).reshape(12, 16, 3)
    assert np.abs(pixels - ramp).max() < 0.05
